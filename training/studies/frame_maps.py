"""Files of the contact maps of a frame: arrays, and a picture of pressure and shear over the frame and on the deformed skin."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from training.estimate.estimator import PoseEstimator
from twin.camera.projection import project_in_form
from twin.mechanics.skin_map import ContactMaps
from twin.report.charts import ink, save_figure, sequential, sized_figure
from twin.store import write_npz
from twin.types import FloatArray, Frame, ImageArray

ARROW_MM = 1e-3
"""Length, mm, of the vector by which the direction of a shear traction is projected into the frame."""
SIZE_INCH = (12.0, 5.2)
"""Width and height of the picture, inch."""
SHOWN_SHARE = 0.02
"""Share of the largest pressure above which a place is coloured over the frame."""
ARROW_EVERY = 2
"""Number of grid nodes in each direction for one arrow of shear."""
ARROW_SHARE = 0.06
"""Length of the longest arrow, as a share of the frame's width."""


def write_frame_maps(folder: Path, estimator: PoseEstimator, frame: Frame, maps: ContactMaps) -> list[Path]:
    """Write the contact maps of one frame: arrays as ``NAME.npz``, a picture as ``NAME.png``. NAME is the frame's name without suffix.

    The arrays are ``nodes_mm`` (G, 3), ``nodes_px`` (G, 2) in the frame, ``area_mm2`` (G,), ``force_n`` (G, 3), ``pressure_mpa`` (G,),
    ``traction_mpa`` (G, 3) and ``patch`` (G,), of the grid's nodes, and ``resultant_n`` (3,) and ``torque_z_nmm``. The picture shows
    pressure (colour), shear (arrows) and patch (line) over the frame, and the pressure on the deformed skin.
    """
    spec, name = estimator.sensor, Path(frame.name).stem
    along = maps.traction_mpa / np.maximum(np.linalg.norm(maps.traction_mpa, axis=1, keepdims=True), 1e-12)
    nodes_px = project_in_form(spec, estimator.form, maps.nodes_mm)
    ends_px = project_in_form(spec, estimator.form, maps.nodes_mm + ARROW_MM * along)
    arrays = {key: getattr(maps, key) for key in ("nodes_mm", "area_mm2", "force_n", "pressure_mpa", "traction_mpa", "patch")}
    totals = {"resultant_n": maps.resultant_n, "torque_z_nmm": np.array(maps.torque_z_nmm)}
    write_npz(folder / f"{name}.npz", arrays | totals | {"nodes_px": nodes_px})
    force = ", ".join(f"{axis} {value:.2f}" for axis, value in zip("xyz", maps.resultant_n, strict=True))
    figure, (over, _) = sized_figure(SIZE_INCH, 2)
    figure.axes[1].remove()
    _draw_over(over, frame.image, maps, nodes_px, ends_px)
    _draw_skin(figure, maps)
    figure.suptitle(f"{frame.name}: force {force} N")
    save_figure(folder / f"{name}.png", figure, dpi=100)
    return [folder / f"{name}.npz", folder / f"{name}.png"]


def _on_grid(*values: FloatArray) -> list[FloatArray]:
    """Values (S^2,) of the nodes as squares (S, S)."""
    side = int(np.sqrt(len(values[0])))
    return [each.reshape(side, side) for each in values]


def _draw_over(axes: Axes, image: ImageArray, maps: ContactMaps, nodes_px: FloatArray, ends_px: FloatArray) -> None:
    """Draw over the frame: nodes (G, 2), and the same places a little farther along the shear traction (``ARROW_MM``)."""
    height, width = image.shape[:2]
    axes.imshow(image, cmap="gray")
    largest = max(float(maps.pressure_mpa.max()), 1e-9)
    x, y, pressure = _on_grid(*nodes_px.T, maps.pressure_mpa)
    seen = np.ma.masked_less(pressure, SHOWN_SHARE * largest)
    axes.pcolormesh(x, y, seen, shading="nearest", cmap=sequential(), vmin=0, vmax=largest, alpha=0.55, linewidth=0)
    if maps.least_mpa < largest:
        axes.contour(x, y, pressure, [maps.least_mpa], colors="white", linewidths=1.2)
    way = ends_px - nodes_px
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
    shear = np.linalg.norm(maps.traction_mpa, axis=1)
    length = shear / max(float(shear.max()), 1e-9) * ARROW_SHARE * width
    chosen = np.zeros(pressure.shape, bool)
    chosen[::ARROW_EVERY, ::ARROW_EVERY] = True
    chosen = chosen.ravel() & (maps.pressure_mpa >= SHOWN_SHARE * largest)
    at, arrow = nodes_px[chosen], (way * length[:, None])[chosen]
    axes.quiver(*at.T, *arrow.T, angles="xy", scale_units="xy", scale=1, color="white", width=0.004)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), title="over the frame; arrows: shear on the object")
    axes.grid(visible=False)


def _draw_skin(figure: Figure, maps: ContactMaps) -> None:
    axes = figure.add_subplot(1, 2, 2, projection="3d")
    x, y, z, pressure = _on_grid(*maps.nodes_mm.T, maps.pressure_mpa)
    largest = max(float(pressure.max()), 1e-9)
    axes.plot_surface(x, y, z, facecolors=sequential()(pressure / largest), rcount=len(x), ccount=len(x), linewidth=0, shade=True)
    axes.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm", aspect="equal", title=f"on the skin; largest pressure {largest:.3g} N/mm²")
    axes.view_init(elev=35, azim=-60)
    axes.tick_params(colors=ink())
