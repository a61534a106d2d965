"""Pictures of the deformed skin in 3D, drawn by PyVista in a separate process.

VTK kills the whole process if it finds neither a display nor EGL. Therefore it runs in a child process. If the child ends with an error,
matplotlib draws a simpler picture, and the caller gets the reason.

PyVista and matplotlib are imported only by the functions that draw with them. The import takes half a second, and many users of this module
do not draw.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenes.sensor import PinsSpec
from twin.geometry.mesh import SensorMesh, skin_surface
from twin.objects import ObjectField
from twin.store import write_bytes, write_text
from twin.types import ContactState

if TYPE_CHECKING:
    import pyvista as pv
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

# Box of the sensor frame that the picture shows: x0, x1, y0, y1, z0, z1, mm.
SCENE_BOUNDS_MM = (-24.0, 24.0, -24.0, 24.0, -2.0, 32.0)
# Width and height of the picture, px.
WINDOW_PX = (1100, 900)
# Time after which the child process is ended, s.
CHILD_TIMEOUT_S = 120
# Normal and a point (mm) of the plane whose front is cut away, so that the pins are visible.
CUT_NORMAL, CUT_ORIGIN = (0.0, -1.0, 0.0), (0.0, -0.01, 0.0)
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


def draw_contact_skin(mesh: SensorMesh, pins: PinsSpec, state: ContactState, field: ObjectField, path: Path) -> str:
    """Draw a contact: skin, pins and the object's surface near it (see ``draw_skin``)."""
    surface = object_surface(field.distance, state.T_sensor_object, bounds_mm=SCENE_BOUNDS_MM)
    return draw_skin(displaced_skin(mesh, state), pins_surface(pins, state), surface, path)


def draw_skin(skin: "pv.PolyData", pins: "pv.PolyData", touched: "pv.PolyData", path: Path) -> str:
    """Write a picture of the skin, coloured by ``displacement_mm`` and cut open, with pins and object.

    Returns
    -------
    str
        "" if PyVista drew it, else the reason why matplotlib drew a simpler picture.
    """
    with tempfile.TemporaryDirectory() as folder:
        for name, surface in (("skin", skin), ("pins", pins), ("object", touched)):
            write_surface(Path(folder) / f"{name}.vtp", surface)
        drawn = Path(folder) / "drawn.png"
        reason = _run_child(folder, str(drawn))
        if not reason:
            write_bytes(path, drawn.read_bytes())
    if reason:
        from twin.report.charts import save_figure

        save_figure(path, _plain_figure(skin, touched), dpi=100)
    return reason


def probe_offscreen() -> str:
    """Empty if VTK can draw without a window on this machine, else the reason why not."""
    import pyvista as pv

    with tempfile.TemporaryDirectory() as folder:
        for name in ("skin", "pins", "object"):
            write_surface(Path(folder) / f"{name}.vtp", pv.Sphere())
        return _run_child(folder, str(Path(folder) / "probe.png"))


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
    in_object = grid.points @ T_object_sensor[:3, :3].T + T_object_sensor[:3, 3]
    grid["distance_mm"] = distance(in_object)
    return grid.contour([0.0], scalars="distance_mm")


def _run_child(folder: str, path: str) -> str:
    command = [sys.executable, "-m", "twin.report.skin3d", folder, path]
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=CHILD_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return f"the 3D picture took more than {CHILD_TIMEOUT_S} s"
    if done.returncode == 0 and Path(path).is_file():
        return ""
    return f"VTK can't draw offscreen here (exit {done.returncode}); {REMEDY}"


def _draw_with_pyvista(folder: Path, path: str) -> None:
    import pyvista as pv

    skin, pins, touched = (pv.PolyData(str(folder / f"{name}.vtp")) for name in ("skin", "pins", "object"))
    plotter = pv.Plotter(off_screen=True, window_size=list(WINDOW_PX))
    plotter.set_background("#0d1117", top="#27313f")  # type: ignore[arg-type]  # its decorator hides self from the checker
    scalars = "displacement_mm" if "displacement_mm" in skin.point_data else None
    plotter.add_mesh(
        _clip_surface(skin),
        scalars=scalars,
        cmap=_glow(),
        ambient=0.2,
        smooth_shading=True,
        scalar_bar_args={
            "title": "skin displacement, mm\n",  # the line keeps it off the numbers
            "color": "white",
            "fmt": "%.1f",
            "n_labels": 4,
            "position_x": 0.25,
            "position_y": 0.04,
        },
    )
    plotter.add_mesh(_clip_surface(pins), color="#f2f7ff", smooth_shading=True, split_sharp_edges=True, specular=0.3)
    if touched.n_points:
        plotter.add_mesh(_clip_surface(touched), color="#8fb8e8", opacity=0.5, smooth_shading=True, split_sharp_edges=True)
    plotter.camera_position = [(22.0, -84.0, 30.0), (0.0, 0.0, 12.5), (0.0, 0.0, 1.0)]
    plotter.enable_anti_aliasing("ssaa")
    plotter.screenshot(path)


def _clip_surface(surface: "pv.PolyData") -> "pv.PolyData":
    return surface.clip(normal=CUT_NORMAL, origin=CUT_ORIGIN)


def _glow() -> "ListedColormap":
    """Inferno without its black end, which can't be seen on the background."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    return ListedColormap(colormaps["inferno"](np.linspace(0.22, 0.97, 256)))


def _plain_figure(skin: "pv.PolyData", touched: "pv.PolyData") -> "Figure":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WINDOW_PX[0] / 100, WINDOW_PX[1] / 100), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    half = _clip_surface(skin).triangulate()
    triangles = half.regular_faces
    shell = axes.plot_trisurf(*half.points.T, triangles=triangles, cmap=_glow())
    if "displacement_mm" in half.point_data:
        shell.set_array(half["displacement_mm"][triangles].mean(axis=1))
        shell.set_clim(0, half["displacement_mm"].max())
        figure.colorbar(shell, ax=axes, shrink=0.6, label="skin displacement, mm")
    if touched.n_points:
        axes.plot_trisurf(*touched.points.T, triangles=touched.triangulate().regular_faces, color="#7aa7d9", alpha=0.3)
    axes.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm", aspect="equal")
    axes.view_init(elev=15, azim=-75)
    return figure


if __name__ == "__main__":
    _draw_with_pyvista(Path(sys.argv[1]), sys.argv[2])
