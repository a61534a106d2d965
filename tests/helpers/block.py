"""Small bodies of the skin's and the gel's own elements, slow, obvious ways to assemble them, and a solver that lets look inside."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from scenes.body import MaterialSpec
from scenes.load import load_sensor
from twin.geometry.solid import Basis, Cells, joined_cells, spline_cells
from twin.mechanics import SkinSolver
from twin.mechanics.body.elements import PAIRS, Elements
from twin.mechanics.body.material import law_coefficients

LAWS = {"neo-hookean": {}, "mooney-rivlin": {"second_invariant_share": 0.4}, "yeoh": {"c20_c10": 0.3, "c30_c10": 0.2}}


def material(law: str = "neo-hookean", *, young_mpa: float = 0.7, poisson: float = 0.47, **extra) -> MaterialSpec:
    """A rubber with a law's own parameters set to something."""
    return MaterialSpec(young_modulus_mpa=young_mpa, poisson_ratio=poisson, law=law, **{**LAWS[law], **extra})


@dataclass(frozen=True)
class Block:
    """A body of one kind of elements; its control (d, r, c) lies at depth d, row r and column c.

    Attributes
    ----------
    control_mm : (n, 3) float
    cells : Cells
    index : (layers, side, side) int
    boxes : (m, 4) int
    basis, through : Basis
    """

    control_mm: np.ndarray
    cells: Cells
    index: np.ndarray
    boxes: np.ndarray
    basis: Basis
    through: Basis

    @property
    def inner(self) -> np.ndarray:
        """(n,) bool: not on any of the six faces."""
        out = np.zeros(self.index.shape, bool)
        out[1:-1, 1:-1, 1:-1] = True
        return out.ravel()

    def elements(self, spec: MaterialSpec) -> Elements:
        """The body of a rubber: as skin if it's linear through the depth, else as gel."""
        return Elements(self.cells, law_coefficients(spec, layer=self.through.degree == 1))


def build_block(kind: str, *, breaks=None, depths=None, size_mm=(1.0, 1.0, 1.0), place=lambda at: at) -> Block:
    """A box with its outside in the plane z = 0 and its inside below, or what ``place`` (k, 3) -> (k, 3) makes of it.

    Columns run along x, rows along y. ``kind``: ``skin`` (linear through the depth) or ``gel``.
    """
    basis = Basis(np.linspace(0, 1, 4) if breaks is None else np.asarray(breaks, float))
    through = Basis(np.linspace(0, 1, 2) if depths is None else np.asarray(depths, float), degree=1 if kind == "skin" else 2)
    d, r, c = np.meshgrid(through.greville, basis.greville, basis.greville, indexing="ij")
    wanted = place(np.stack([c, r, -d], axis=-1).reshape(-1, 3) * size_mm).reshape(*d.shape, 3)
    inverse, inverse_d = np.linalg.inv(basis.values(basis.greville)), np.linalg.inv(through.values(through.greville))
    control = np.einsum("ad,br,ce,drex->abcx", inverse_d, inverse, inverse, wanted, optimize=True).reshape(-1, 3)
    index = np.arange(len(control)).reshape(d.shape)
    layers = []
    for e in range(through.elements):
        parts = [(index[e + k], basis) for k in range(through.degree + 1)]
        layers.append(spline_cells(basis, parts, through, e, control))
    row, column = (g.ravel() for g in np.meshgrid(np.arange(basis.elements), np.arange(basis.elements), indexing="ij"))
    boxes = np.tile(np.column_stack([row, row + 1, column, column + 1]), (through.elements, 1))
    return Block(control, joined_cells(layers), index, boxes, basis, through)


def loaded(elements: Elements, given: np.ndarray | None) -> Elements:
    """Elements with a given stress, if there is one."""
    return elements if given is None else replace(elements, stress=given)


def stiffness_blocks(elements: Elements, control_mm: np.ndarray, *, given=None, pressure_mpa: float = 0.0) -> np.ndarray:
    """(m, 6, b, b) of all elements."""
    count, functions = elements.cells.controls.shape
    out = np.full((count, 6, functions, functions), np.nan)
    loaded(elements, given).stiffness(control_mm, pressure_mpa, out)
    return out


def assembled(controls: list[np.ndarray], blocks: list[np.ndarray], count: int) -> sparse.csr_matrix:
    """The matrix (3 count, 3 count) of elements' blocks, direction fastest."""
    rows, columns, values = [], [], []
    for where, block in zip(controls, blocks, strict=True):
        for p, (i, k) in enumerate(PAIRS):
            for transpose in (False, True) if i != k else (False,):
                first, second, value = (k, i, block[:, p].swapaxes(1, 2)) if transpose else (i, k, block[:, p])
                rows.append(np.broadcast_to(3 * where[:, :, None] + first, value.shape).ravel())
                columns.append(np.broadcast_to(3 * where[:, None, :] + second, value.shape).ravel())
                values.append(value.ravel())
    value, row, column = (np.concatenate(part) for part in (values, rows, columns))
    return sparse.csr_matrix((value, (row, column)), shape=(3 * count, 3 * count))


def forces(elements: Elements, control_mm: np.ndarray, *, given=None, pressure_mpa: float = 0.0) -> tuple[float, np.ndarray]:
    """Energy and its gradient (n, 3)."""
    out = np.zeros_like(control_mm)
    return loaded(elements, given).add_forces(control_mm, out, pressure_mpa), out


def rotation(axis, angle_rad: float) -> np.ndarray:
    """Right-handed turn about an axis."""
    axis = np.asarray(axis, float)
    return Rotation.from_rotvec(angle_rad * axis / np.linalg.norm(axis)).as_matrix()


class Watched(SkinSolver):
    """A solver that keeps what a contact state doesn't tell: controls, contact points, material at the last state."""

    def begin(self, *args, **options):
        self._contact = super().begin(*args, **options)
        return self._contact

    @property
    def setting(self):
        return self._contact.setting

    @property
    def state(self):
        return self._contact.load

    def elastic_forces(self) -> np.ndarray:
        """Gradient of the elastic energy of the last state, (n, 3) in N, of an elastic sensor."""
        out = np.zeros_like(self.state.control_mm)
        for number, kind in enumerate(self.setting.body.kinds):
            kind.add_forces(self.state.control_mm, out, self.state.border[1] if number else 0.0)
        return out


def soft_sensor(spec, *, skin=None, gel=None):
    """A sensor with other material values of its skin and gel."""
    changed = {name: {**getattr(spec, name).model_dump(), **(values or {})} for name, values in (("skin", skin), ("gel", gel))}
    return type(spec).model_validate({**spec.model_dump(), **changed})


def usual_sensor():
    """A shipped sensor with fixed material, so that a new calibration moves no test's figures."""
    rubber = {"law": "neo-hookean", "second_invariant_share": 0.0, "c20_c10": 0.0, "c30_c10": 0.0, "relaxation": (), "poisson_ratio": 0.47}
    skin, gel = {**rubber, "young_modulus_mpa": 0.7}, {**rubber, "young_modulus_mpa": 0.02, "sealed": False}
    return soft_sensor(load_sensor("mg400-331"), skin=skin, gel=gel)


def last(path):
    """The state at the end of a path."""
    return list(path)[-1][1]
