"""What assumed numbers cost: how far estimates of depth and tilt move if a number of the specification is wrong.

A twin with the assumed numbers presses a plate in nine ways; its displacements of the pins are a function of depth and tilt, quadratic
in each. A twin with another number, whose camera is fitted to the same pins at rest, presses it too. The depth and tilt whose
displacements are most like those of the other twin, less the true ones, are the cost of the assumption.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import least_squares

from scenes import load_object
from scenes.sensor import SensorSpec
from twin.calibration.camera_pose import FREE, fit_camera
from twin.calibration.size import of_radius
from twin.camera.projection import project
from twin.errors import ContactError, FrameError
from twin.geometry.solid import Resolution
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.pins.labelling.reference import project_rest
from twin.progress import Step
from twin.types import FloatArray, Form

SPARSE = Resolution(across=8)
"""Elements of these simulations, in which only differences count."""
DEPTHS, TILTS_DEG = (0.05, 0.1, 0.15), (-10.0, 0.0, 10.0)
"""Depths, in radii of the tip, and tilts about x of the nine contacts."""
SIZES = np.array([DEPTHS[1], TILTS_DEG[2]])
"""A usual depth and tilt, by which they are divided."""
PROBES = ((0.08, -5.0), (0.12, 5.0))
"""Depth and tilt of the contacts of the other twins."""
MORE, TURN_DEG, STIFFER = 1.1, 5.0, 1.5
"""Changes: of a length, of the angle of the outermost pins, and of a modulus."""


@dataclass(frozen=True)
class AssumptionCost:
    """What an assumption costs.

    Attributes
    ----------
    assumed, change : str
        The number, and by how much it is changed.
    depth_share : float
        Mean change of an estimated depth, as a share of the depth.
    tilt_deg : float
        Mean change of an estimated tilt of 5 deg, away from 0.
    """

    assumed: str
    change: str
    depth_share: float
    tilt_deg: float

    def line(self) -> str:
        """The cost as a line of text."""
        return f"{self.assumed}: {self.change} moves depths by {100 * self.depth_share:+.0f} %, a tilt of 5 deg by {self.tilt_deg:+.1f} deg"


def _with(spec: SensorSpec, section: str, key: str, change: Callable[[float], float]) -> SensorSpec:
    """The specification with one number changed."""
    return spec.alter(**{section: {key: change(getattr(getattr(spec, section), key))}})


def _changes(spec: SensorSpec) -> dict[tuple[str, str], tuple[SensorSpec, str]]:
    """Specifications with another number, by its name and change; and the key that a fit of the camera then holds."""
    skin, longer, stiffer = spec.skin, f"{MORE - 1:+.0%}", f"times {STIFFER:g}"
    return {
        (f"radius of the tip, {skin.outer_radius_mm:g} mm", longer): (of_radius(spec, MORE * skin.outer_radius_mm), ""),
        (f"thickness of the skin, {skin.thickness_mm:g} mm", longer): (_with(spec, "skin", "thickness_mm", lambda mm: MORE * mm), ""),
        (f"length of the pins, {spec.pins.length_mm:g} mm", longer): (_with(spec, "pins", "length_mm", lambda mm: MORE * mm), ""),
        (f"angle of the outermost pins, {spec.pins.max_polar_deg:g} deg", f"{TURN_DEG:+g} deg"): (
            _with(spec, "pins", "max_polar_deg", lambda deg: deg + TURN_DEG),
            "max_polar_deg",
        ),
        (f"distance of the camera, {spec.camera.distance_mm:.1f} mm", longer): (
            _with(spec, "camera", "distance_mm", lambda mm: MORE * mm),
            "distance_mm",
        ),
        ("stiffness of the skin", stiffer): (_with(spec, "skin", "young_modulus_mpa", lambda mpa: STIFFER * mpa), ""),
        ("stiffness of the gel", stiffer): (_with(spec, "gel", "young_modulus_mpa", lambda mpa: STIFFER * mpa), ""),
    }


def cost_of_assumptions(spec: SensorSpec, *, progress: Step | None = None) -> list[AssumptionCost]:
    """The costs of a specification's assumed numbers, the largest first. One with which a contact fails is left out.

    Parameters
    ----------
    spec : SensorSpec
        Of a sensor with a dome.
    progress : callable, optional
        Called with (contacts done, contacts wanted).
    """
    radius_mm, plate = spec.skin.outer_radius_mm, load_object("plane")
    grid, changes, found, done = list(product(DEPTHS, TILTS_DEG)), _changes(spec), [], 0

    def displacements(sensor: SensorSpec, contacts: Sequence[tuple[float, float]]) -> FloatArray:
        """Displacements (contacts, 2 N) of the pins of a sensor, px."""
        nonlocal done
        solver, rows = SkinSolver(sensor, resolution=SPARSE), []
        rest = project(sensor.view, solver.rest().caps_mm)
        for depth, tilt_deg in contacts:
            state = solver.press(plate, ContactPose(depth * radius_mm, (tilt_deg, 0.0)))
            rows.append((project(sensor.view, state.caps_mm) - rest).ravel())
            done += 1
            if progress is not None:
                progress(done, len(grid) + (1 + len(changes)) * len(PROBES))
        return np.array(rows)

    def powers(depth: float, tilt_deg: float) -> FloatArray:
        a, b = np.array([depth, tilt_deg]) / SIZES
        return np.outer([1, a, a * a], [1, b, b * b]).ravel()

    moved, truth = displacements(spec, [*grid, *PROBES]), np.array(PROBES)
    table = np.linalg.solve(np.array([powers(*each) for each in grid]), moved[: len(grid)])

    def estimate(seen: FloatArray) -> FloatArray:
        """Depths and tilts (probes, 2) that the assumed numbers give to displacements (probes, 2 N)."""
        pairs = zip(seen, truth / SIZES, strict=True)
        fits = [least_squares(lambda x, row=row: powers(*x * SIZES) @ table - row, start).x for row, start in pairs]
        return np.array(fits) * SIZES

    own, rest_px = estimate(moved[len(grid) :]), project_rest(spec, Form.RAW)  # the table's error, with the right numbers
    for (assumed, change), (other, held) in changes.items():
        try:
            if held:  # the others leave the pins at rest where they are seen
                other, _ = fit_camera(other, rest_px, free=tuple(key for key in FREE if key != held), named=True)
            depth, tilt = ((estimate(displacements(other, PROBES)) - own) * np.sign(truth)).T
        except (ContactError, FrameError):
            continue
        found.append(AssumptionCost(assumed, change, float(np.mean(depth / truth[:, 0])), float(np.mean(tilt))))
    return sorted(found, key=lambda cost: -abs(cost.depth_share) - abs(cost.tilt_deg) / 5.0)
