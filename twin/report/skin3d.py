"""Pictures of the deformed skin in 3D, drawn by PyVista in a separate process.

VTK kills the whole process if it finds neither a display nor EGL. Therefore it runs in a child process. If the child ends with an error,
matplotlib draws a simpler picture, and the caller gets the reason.

PyVista is imported only by the functions that draw with it. The import takes half a second, and many users of this module do not draw.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from scenes.sensor import PinsSpec
from twin.geometry.mesh import SensorMesh, skin_surface
from twin.objects import ObjectField
from twin.report.skin_picture import DRAWN, plain_figure
from twin.store import write_bytes, write_text
from twin.types import ContactState

if TYPE_CHECKING:
    import pyvista as pv

# Box of the sensor frame that the picture shows: x0, x1, y0, y1, z0, z1, mm.
SCENE_BOUNDS_MM = (-24.0, 24.0, -24.0, 24.0, -2.0, 32.0)
# Time after which the child process is ended, s.
CHILD_TIMEOUT_S = 120
# Remedy in the message that VTK can't draw.
REMEDY = "install libegl1 and libgl1 (apt-get install libegl1 libgl1) for shaded 3D pictures"


def displaced_skin(mesh: SensorMesh, state: ContactState) -> "pv.PolyData":
    """The deformed skin with point data ``displacement_mm`` (n,) and ``displacement_xyz_mm`` (n, 3)."""
    moved = state.nodes_mm - mesh.nodes_mm
    data = {"displacement_mm": np.linalg.norm(moved, axis=1), "displacement_xyz_mm": moved}
    return skin_surface(mesh, nodes_mm=state.nodes_mm, point_data=data)


def write_surface(path: Path, surface: "pv.PolyData") -> Path:
    """Write a surface and its data as a ``.vtp`` file, and return the path.

    VTK gives the content as text and writes no file itself, because on a full disk it kills the whole process.

    Raises
    ------
    StoreError
        The file cannot be written.
    """
    import pyvista as pv

    writer = pv.XMLPolyDataWriter(path, surface)
    writer.data_format = "binary"  # base64
    writer.writer.WriteToOutputStringOn()
    writer.write()
    return write_text(path, writer.writer.GetOutputString())


def pins_surface(pins: PinsSpec, state: ContactState) -> "pv.PolyData":
    """Stems and caps of all pins as tubes."""
    import pyvista as pv

    parts = []
    stem_end = state.caps_mm - state.axis * pins.cap_height_mm / 2
    for start, end, diameter_mm in (
        (state.base_mm + 0.1 * (stem_end - state.base_mm), stem_end, pins.diameter_mm),  # begins slightly above the skin's flat facets
        (stem_end, state.caps_mm + state.axis * pins.cap_height_mm / 2, pins.cap_diameter_mm),
    ):
        count = len(start)
        lines = np.column_stack([np.full(count, 2), np.arange(count), np.arange(count) + count])
        parts.append(pv.PolyData(np.vstack([start, end]), lines=lines.ravel()).tube(radius=diameter_mm / 2, n_sides=16, capping=True))
    return pv.merge(parts)


class SkinPainter:
    """Draws a contact in a process of its own, beside what the caller does. The process starts at once, and loads VTK meanwhile.

    It is a context: at its end the process is stopped if it still draws.
    """

    def __enter__(self) -> Self:
        self._folder = tempfile.TemporaryDirectory()
        self._surfaces: dict[str, pv.PolyData] = {}
        command = [sys.executable, "-m", "twin.report.skin_picture", self._folder.name]
        self._child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        return self

    def __exit__(self, *error: object) -> None:
        self._child.kill()
        self._child.communicate()
        self._folder.cleanup()

    def draw_contact(self, mesh: SensorMesh, pins: PinsSpec, state: ContactState, field: ObjectField) -> None:
        """Begin to draw a contact: skin, pins and the object's surface near it."""
        touched = object_surface(field.distance, state.T_sensor_object, bounds_mm=SCENE_BOUNDS_MM)
        self.draw(displaced_skin(mesh, state), pins_surface(pins, state), touched)

    def draw(self, skin: "pv.PolyData", pins: "pv.PolyData", touched: "pv.PolyData") -> None:
        """Begin to draw the skin, coloured by ``displacement_mm`` and cut open, with pins and object."""
        self._surfaces = {"skin": skin, "pins": pins, "object": touched}
        for name, surface in self._surfaces.items():
            write_surface(Path(self._folder.name) / f"{name}.vtp", surface)
        assert self._child.stdin is not None
        with suppress(BrokenPipeError):  # it has died; ``save`` gives the reason
            self._child.stdin.close()  # the child waits for this

    def save(self, path: Path) -> str:
        """Write the picture that was begun.

        Returns
        -------
        str
            "" if PyVista drew it, else the reason why matplotlib drew a simpler picture.
        """
        reason = self.wait()
        if not reason:
            write_bytes(path, self._drawn.read_bytes())
            return ""
        from twin.report.charts import save_figure

        save_figure(path, plain_figure(self._surfaces["skin"], self._surfaces["object"]), dpi=100)
        return reason

    def wait(self) -> str:
        """Wait for the picture that was begun; "" if PyVista drew it, else the reason why not."""
        try:
            code = self._child.wait(CHILD_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            return f"the 3D picture took more than {CHILD_TIMEOUT_S} s"
        if code == 0 and self._drawn.is_file():
            return ""
        return f"VTK can't draw offscreen here (exit {code}); {REMEDY}"

    @property
    def _drawn(self) -> Path:
        return Path(self._folder.name) / DRAWN


def draw_contact_skin(mesh: SensorMesh, pins: PinsSpec, state: ContactState, field: ObjectField, path: Path) -> str:
    """Draw a contact, and return what ``SkinPainter.save`` returns."""
    with SkinPainter() as painter:
        painter.draw_contact(mesh, pins, state, field)
        return painter.save(path)


def probe_offscreen() -> str:
    """Empty if VTK can draw without a window on this machine, else the reason why not."""
    import pyvista as pv

    with SkinPainter() as painter:
        painter.draw(pv.Sphere(), pv.Sphere(), pv.Sphere())
        return painter.wait()


def object_surface(
    distance: Callable[[np.ndarray], np.ndarray], T_sensor_object: np.ndarray, *, bounds_mm: Sequence[float], samples: int = 100
) -> "pv.PolyData":
    """The surface of an object inside a box of the sensor frame: the zero level of its signed distance.

    Parameters
    ----------
    distance : callable
        Function from points (k, 3) in the object frame, mm, to signed distances (k,), mm.
    T_sensor_object : (4, 4) float
    bounds_mm : (6,) float
        x0, x1, y0, y1, z0, z1 of the box.
    """
    import pyvista as pv

    low, high = np.array(bounds_mm[::2], float), np.array(bounds_mm[1::2], float)
    grid = pv.ImageData(dimensions=(samples,) * 3, spacing=tuple((high - low) / (samples - 1)), origin=tuple(low))
    T_object_sensor = np.linalg.inv(T_sensor_object)
    along = np.linspace(low, high, samples)
    x, y, z = (along[:, [k]] * T_object_sensor[:3, k] for k in range(3))
    in_object = z[:, None, None] + y[:, None] + x + T_object_sensor[:3, 3]
    grid["distance_mm"] = distance(in_object.reshape(-1, 3))
    return grid.contour([0.0], scalars="distance_mm")
