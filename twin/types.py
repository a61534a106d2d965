"""Frozen types of the data between the stages, with their shapes and units."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from twin.errors import warn_once

FloatArray: TypeAlias = NDArray[np.floating]
IntArray: TypeAlias = NDArray[np.integer]
BoolArray: TypeAlias = NDArray[np.bool_]
ComplexArray: TypeAlias = NDArray[np.complexfloating]
ImageArray: TypeAlias = NDArray[np.uint8]
"""Gray or RGB levels of a frame."""

Quality = Literal["rasterised", "preview", "standard", "high"]
"""Quality of a render: rasterised with exact edges and without noise, or path-traced with an increasing number of samples."""
FORMER_VALUES = {"drawn": "rasterised", "recording": "processed"}
"""Present names of values of options, by their names in version 1."""


def present_value(value: Any) -> Any:
    """The present name of a value of an option; any other value is returned as it is."""
    if not isinstance(value, str) or value not in FORMER_VALUES:
        return value
    warn_once(f"the value {value!r} is now called {FORMER_VALUES[value]!r}; the old name still works")
    return FORMER_VALUES[value]


FINE = 20
"""Number of elements across the skin for calibrations and data sets. In the deepest contacts the displacements of the outer pins differ by
1 % from those with 32 elements."""


# Values of the option --at-rest other than a file with a frame without contact. "first" uses the first frame that is read; "none" measures
# displacements from the specification's layout.
FIRST, NONE = "first", "none"


class ReadableResult:
    """A result in words. Its ``repr`` is the first line, its text all lines."""

    def lines(self) -> Iterable[str]:
        """The result as lines of text."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {next(iter(self.lines()), '')}>"

    def __str__(self) -> str:
        return "\n".join(self.lines())


class Form(StrEnum):
    """The two forms of a sensor's frames."""

    RAW = "raw"  # the camera's own frame
    PROCESSED = "processed"  # cropped, thresholded and resized at capture

    @classmethod
    def _missing_(cls, value: object) -> Any:
        return cls._value2member_map_.get(present_value(value))


@dataclass(frozen=True)
class Frame:
    """One picture of one sensor, which may be rendered, recorded or live.

    Attributes
    ----------
    image : (H, W) or (H, W, 3) uint8
        Gray or RGB levels.
    form : Form
    name : str
        Base name of the file, or a label.
    time_s : float
        Time of exposure; 0 if unknown.
    sequence : int
    """

    image: ImageArray
    form: Form
    name: str = ""
    time_s: float = 0.0
    sequence: int = 0

    def __repr__(self) -> str:
        height, width = self.image.shape[:2]
        return f"<Frame: {width} x {height} px, {self.form}{f', {self.name}' if self.name else ''}>"


def _save(folder: str | Path, name: str, arrays: dict[str, Any]) -> list[Path]:
    Path(folder).mkdir(parents=True, exist_ok=True)
    np.savez_compressed(Path(folder) / name, **arrays)
    return [Path(folder) / name]


def _zeros(*shape: int, kind: type = float) -> Any:
    """Default of an attribute of a data class: zeros of a shape."""
    return field(default_factory=lambda: np.zeros(shape, kind))


class PinState(Protocol):
    """Positions of the pins of a sensor in the sensor frame: at rest, in a contact, or fitted to a frame.

    Attributes
    ----------
    base_mm : (N, 3) float
        Foot of each pin, on the inside of the skin.
    axis : (N, 3) float
        Unit vector from the foot to the cap.
    caps_mm : (N, 3) float
        Centre of each cap.
    """

    @property
    def base_mm(self) -> FloatArray:
        """Feet of the pins on the inside of the skin (N, 3)."""

    @property
    def axis(self) -> FloatArray: ...
    @property
    def caps_mm(self) -> FloatArray:
        """Centres of the caps (N, 3)."""


@dataclass(frozen=True)
class ContactState:
    """A converged state of the sensor pressed against an object (sensor frame). By default nothing is in contact.

    Attributes
    ----------
    nodes_mm : (n, 3) float
        Deformed positions of the volume mesh's nodes, in the order of ``SensorMesh.nodes_mm``.
    base_mm, axis, caps_mm : (N, 3) float
        Pin feet, unit axes (foot to cap) and cap centres.
    force_n, torque_nmm : (3,) float
        Total contact force of the *skin on the object* and its torque about the sensor's origin.
    area_mm2 : float
        Contact area on the outer skin at rest: the area of the skin within 0.05 mm of the object. It is 0 if no point is pressed.
    contact_mm : (c, 3) float
        Positions of the contact points on the outer skin. Each represents an area ``point_area_mm2 (c,)`` of the skin at rest.
    contact_place : (c,) complex
        Places of the same points on the skin (see ``twin.geometry.shapes``).
    normal : (c, 3) float
        The object's outward unit normal at each contact point.
    normal_n : (c,) float
        Magnitude of the normal force at each contact point. Divided by the area it is ``pressure_mpa``.
    tangential_n : (c, 3) float
        Friction force of the skin on the object at each contact point. Divided by the area it is ``traction_mpa``. The sum of
        ``tangential_n - normal_n normal`` is ``force_n``.
    slipping : (c,) bool
        Whether the point slips; otherwise it sticks.
    T_sensor_object : (4, 4) float
        The object's pose.
    elastic_nmm : float
        Energy stored in skin and gel, N mm. For a viscoelastic sensor: the potential of its last load step.
    dissipated_nmm : float
        Energy dissipated by friction in the last load step, N mm.
    residual : float
        Norm of the force residual relative to the contact force (N/N).
    """

    nodes_mm: FloatArray
    base_mm: FloatArray
    axis: FloatArray
    caps_mm: FloatArray
    force_n: FloatArray = _zeros(3)
    torque_nmm: FloatArray = _zeros(3)
    area_mm2: float = 0.0
    contact_mm: FloatArray = _zeros(0, 3)
    contact_place: ComplexArray = _zeros(0, kind=complex)
    point_area_mm2: FloatArray = _zeros(0)
    normal: FloatArray = _zeros(0, 3)
    normal_n: FloatArray = _zeros(0)
    tangential_n: FloatArray = _zeros(0, 3)
    slipping: BoolArray = _zeros(0, kind=bool)
    T_sensor_object: FloatArray = field(default_factory=lambda: np.eye(4))
    elastic_nmm: float = 0.0
    dissipated_nmm: float = 0.0
    residual: float = 0.0

    def __repr__(self) -> str:
        x, y, z = self.force_n.round(2) + 0.0  # 0.0 turns negative zeros into positive ones
        return f"<ContactState: force {x:+.2f} {y:+.2f} {z:+.2f} N, contact area {self.area_mm2:.1f} mm2>"

    def to_table(self) -> dict[str, np.ndarray]:
        """Columns with a row for each contact point (sensor frame): ``pandas.DataFrame(state.to_table())``."""
        names = [(f"{axis}_mm", self.contact_mm[:, k]) for k, axis in enumerate("xyz")]
        names += [(f"traction_{axis}_mpa", self.traction_mpa[:, k]) for k, axis in enumerate("xyz")]
        return dict(names) | {"area_mm2": self.point_area_mm2, "pressure_mpa": self.pressure_mpa, "slipping": self.slipping}

    def save(self, folder: str | Path) -> list[Path]:
        """Write ``state.npz``, which holds all attributes, into a folder, made if missing. Returns the files."""
        return _save(folder, "state.npz", vars(self))

    @classmethod
    def load(cls, folder: str | Path) -> "ContactState":
        """The state that ``save`` wrote into a folder."""
        with np.load(Path(folder) / "state.npz") as kept:
            return cls(**{name: kept[name] if kept[name].ndim else kept[name].item() for name in kept})

    @property
    def pressure_mpa(self) -> FloatArray:
        """Normal pressure (c,) at each contact point, relative to the skin's area at rest."""
        return self.normal_n / self.point_area_mm2

    @property
    def traction_mpa(self) -> FloatArray:
        """Friction traction (c, 3) of the skin on the object at each contact point, relative to the skin's area at rest."""
        return self.tangential_n / self.point_area_mm2[:, None]

    @property
    def slip_share(self) -> float:
        """Fraction of the pressed area that slips, 0 to 1; 0 without contact."""
        return float(self.point_area_mm2[self.slipping].sum() / max(self.point_area_mm2.sum(), 1e-9))

    @classmethod
    def undeformed(
        cls, nodes_mm: FloatArray, base_mm: FloatArray, axis: FloatArray, caps_mm: FloatArray, *, T_sensor_object: FloatArray | None = None
    ) -> "ContactState":
        """The state of the undeformed sensor without contact."""
        state = cls(nodes_mm, base_mm, axis, caps_mm)
        return state if T_sensor_object is None else replace(state, T_sensor_object=T_sensor_object)


@dataclass(frozen=True)
class PinGraph:
    """A graph over the N pins of a sensor, in the specification's pin order.

    Attributes
    ----------
    nodes_px : (N, 2) float
        Pin positions in px of the input frame (a lost pin's node is its predicted position).
    edges : (E, 2) int
        Directed edges, both directions present.
    area_px2 : (N,) float
        Voronoi cell areas (NaN for kinds without a tessellation).
    cells : sequence of (k, 2) float
        Cell polygons (empty for kinds without a tessellation).
    """

    kind: str
    nodes_px: FloatArray
    edges: IntArray
    area_px2: FloatArray
    cells: Sequence[FloatArray] = ()

    def __repr__(self) -> str:
        return f"<PinGraph: {self.kind}, {len(self.nodes_px)} nodes, {len(self.edges)} edges>"


@dataclass(frozen=True)
class Observation:
    """Result of the pipeline for one frame.

    Attributes
    ----------
    pins_px : (N, 2) float
        Positions of the found pins in px of the input frame, in the specification's order; NaN for a pin without its own blob.
    predicted_px : (N, 2) float
        Predictions of the motion model for the lost pins; NaN for the found pins.
    found : int
        Number of pins that were found.
    expected : int
        Number of pins that should be visible: all except those that the frame's border cuts off.
    valid : bool
    reason : str
        Reason if the result is not valid, else "".
    graph : PinGraph or None
        None if the result is not valid.
    extra_px : (K, 2) float
        Rejected blobs (glints, bubbles).
    ms : dict of str to float
        Time of each stage.
    """

    pins_px: FloatArray
    predicted_px: FloatArray
    found: int
    expected: int
    valid: bool
    reason: str
    graph: PinGraph | None
    extra_px: FloatArray
    ms: dict[str, float]

    def __repr__(self) -> str:
        return f"<Observation: {self.found} of {self.expected} pins found, {'valid' if self.valid else self.reason}>"

    def to_table(self) -> dict[str, np.ndarray]:
        """Columns with a row for each pin, in the specification's order: ``pandas.DataFrame(observation.to_table())``."""
        found, count = np.isfinite(self.pins_px[:, 0]), len(self.pins_px)
        places = np.where(found[:, None], self.pins_px, self.predicted_px)
        area = np.full(count, np.nan) if self.graph is None else self.graph.area_px2
        return {"pin": np.arange(count), "x_px": places[:, 0], "y_px": places[:, 1], "found": found, "area_px2": area}

    def save(self, folder: str | Path) -> list[Path]:
        """Write ``pins.npz``, which holds the columns of ``to_table``, into a folder, made if missing. Returns the files."""
        return _save(folder, "pins.npz", self.to_table())

    @property
    def complete(self) -> bool:
        """Whether the result is valid and all pins that should be visible were found."""
        return self.valid and self.found == self.expected
