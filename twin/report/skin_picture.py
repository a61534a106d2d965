"""The picture of a deformed skin. As a program it draws the surfaces of a folder, for ``SkinPainter``.

PyVista and matplotlib are imported only by the functions that draw with them.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pyvista as pv
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

# Name of the picture in the folder.
DRAWN = "drawn.png"
# Width and height of the picture, px.
WINDOW_PX = (1100, 900)
# Normal and a point (mm) of the plane whose front is cut away, so that the pins are visible.
CUT_NORMAL, CUT_ORIGIN = (0.0, -1.0, 0.0), (0.0, -0.01, 0.0)


def main(folder: Path) -> None:
    """Load VTK, wait for the end of the standard input, and draw the surfaces of a folder."""
    import pyvista as pv

    plotter = pv.Plotter(off_screen=True, window_size=list(WINDOW_PX))  # this loads half of VTK
    plotter.set_background("#0d1117", top="#27313f")  # type: ignore[arg-type]  # its decorator hides self from the checker
    sys.stdin.read()
    skin, pins, touched = (pv.PolyData(str(folder / f"{name}.vtp")) for name in ("skin", "pins", "object"))
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
    plotter.screenshot(folder / DRAWN)


def _clip_surface(surface: "pv.PolyData") -> "pv.PolyData":
    return surface.clip(normal=CUT_NORMAL, origin=CUT_ORIGIN)


def _glow() -> "ListedColormap":
    """Inferno without its black end, which can't be seen on the background."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    return ListedColormap(colormaps["inferno"](np.linspace(0.22, 0.97, 256)))


def plain_figure(skin: "pv.PolyData", touched: "pv.PolyData") -> "Figure":
    """The picture by matplotlib, where VTK can't draw."""
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
    main(Path(sys.argv[1]))
