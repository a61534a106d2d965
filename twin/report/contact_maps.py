"""Draws pressure and shear on the skin: over the frame, and on the deformed skin."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from twin.report.charts import ink, save_figure, sequential, sized_figure
from twin.types import FloatArray, ImageArray

SIZE_INCH = (12.0, 5.2)
"""Width and height of the picture, inch."""
SHOWN_SHARE = 0.02
"""Share of the largest pressure above which a place is coloured over the frame."""
ARROW_EVERY = 2
"""Number of grid nodes in each direction for one arrow of shear."""
ARROW_SHARE = 0.06
"""Length of the longest arrow, as a share of the frame's width."""


@dataclass(frozen=True)
class SkinPicture:
    """The data to draw: values on a square grid of S x S nodes of the skin, row by row.

    Attributes
    ----------
    image : (H, W) or (H, W, 3) uint8
        The frame.
    nodes_px, ends_px : (S^2, 2) float
        The nodes in the frame, and the same places a little farther along the shear traction (a thousandth of a millimetre).
    nodes_mm : (S^2, 3) float
        The nodes on the deformed skin, sensor frame.
    pressure_mpa : (S^2,) float
    shear_mpa : (S^2,) float
        Size of the shear traction.
    least_mpa : float
        Pressure at the border of the contact patch.
    """

    image: ImageArray
    nodes_px: FloatArray
    ends_px: FloatArray
    nodes_mm: FloatArray
    pressure_mpa: FloatArray
    shear_mpa: FloatArray
    least_mpa: float


def draw_contact_maps(path: Path, shown: SkinPicture, title: str) -> Path:
    """Draw pressure (colour), shear (arrows) and patch (line) over the frame, and the pressure on the deformed skin; a PNG file."""
    side = int(np.sqrt(len(shown.pressure_mpa)))
    figure, (over, _) = sized_figure(SIZE_INCH, 2)
    figure.axes[1].remove()
    _draw_over(over, shown, side)
    _draw_skin(figure, shown, side)
    figure.suptitle(title)
    return save_figure(path, figure, dpi=100)


def _draw_over(axes, shown: SkinPicture, side: int) -> None:  # type: ignore[no-untyped-def]  # matplotlib's axes have no type to name
    height, width = shown.image.shape[:2]
    axes.imshow(shown.image, cmap="gray")
    largest = max(float(shown.pressure_mpa.max()), 1e-9)
    x, y = (shown.nodes_px[:, k].reshape(side, side) for k in (0, 1))
    seen = np.ma.masked_less(shown.pressure_mpa.reshape(side, side), SHOWN_SHARE * largest)
    axes.pcolormesh(x, y, seen, shading="nearest", cmap=sequential(), vmin=0, vmax=largest, alpha=0.55, linewidth=0)
    if shown.least_mpa < largest:
        axes.contour(x, y, shown.pressure_mpa.reshape(side, side), [shown.least_mpa], colors="white", linewidths=1.2)
    way = shown.ends_px - shown.nodes_px
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
    length = shown.shear_mpa / max(float(shown.shear_mpa.max()), 1e-9) * ARROW_SHARE * width
    chosen = np.zeros((side, side), bool)
    chosen[::ARROW_EVERY, ::ARROW_EVERY] = True
    chosen = chosen.ravel() & (shown.pressure_mpa >= SHOWN_SHARE * largest)
    at, arrow = shown.nodes_px[chosen], (way * length[:, None])[chosen]
    axes.quiver(*at.T, *arrow.T, angles="xy", scale_units="xy", scale=1, color="white", width=0.004)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), title="over the frame; arrows: shear on the object")
    axes.grid(visible=False)


def _draw_skin(figure: Figure, shown: SkinPicture, side: int) -> None:
    axes = figure.add_subplot(1, 2, 2, projection="3d")
    x, y, z = (shown.nodes_mm[:, k].reshape(side, side) for k in range(3))
    largest = max(float(shown.pressure_mpa.max()), 1e-9)
    colours = sequential()(shown.pressure_mpa.reshape(side, side) / largest)
    axes.plot_surface(x, y, z, facecolors=colours, rcount=side, ccount=side, linewidth=0, shade=True)
    axes.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm", aspect="equal", title=f"on the skin; largest pressure {largest:.3g} N/mm²")
    axes.view_init(elev=35, azim=-60)
    axes.tick_params(colors=ink())
