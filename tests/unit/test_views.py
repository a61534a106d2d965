"""Pictures: drawn with or without VTK's offscreen rendering, never ending the program."""

import cv2
import numpy as np
import pyvista as pv

from scenes import load_sensor
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.objects import build_field
from twin.report import skin3d
from twin.report.charts import ENLARGEMENTS, area_surface_figure, draw_area_change, draw_displacement, enlargement, new_figure


def test_a_vtk_that_is_killed_gives_a_plain_picture_and_a_reason(tmp_path, monkeypatch):
    dying = tmp_path / "python"
    dying.write_text("#!/bin/sh\nkill -SEGV $$\n")
    dying.chmod(0o755)
    monkeypatch.setattr(skin3d.sys, "executable", str(dying))
    skin = pv.Sphere()
    skin["displacement_mm"] = np.linspace(0, 1, skin.n_points)
    with skin3d.SkinPainter() as painter:
        painter.draw(skin, pv.Sphere(), pv.Sphere(center=(0, 0, 1)))
        reason = painter.save(tmp_path / "skin.png")
    assert "libegl1" in reason
    assert cv2.imread(str(tmp_path / "skin.png")) is not None


def test_pictures_need_no_display(monkeypatch):
    """VTK is tried in a process of its own, so that here nothing can end: the answer is a reason, empty where it works."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert isinstance(skin3d.probe_offscreen(), str)


def test_the_object_is_drawn_where_its_pose_puts_it():
    from scenes import load_object

    T = np.eye(4)
    T[:3, 3] = [1, 2, 15]
    surface = skin3d.object_surface(build_field(load_object("sphere")).distance, T, bounds_mm=skin3d.SCENE_BOUNDS_MM)
    radius = np.linalg.norm(surface.points - [1, 2, 25], axis=1)
    assert np.abs(radius - 10).max() < 0.1


def test_the_skin_file_carries_displacement():
    from scenes import load_object

    solver = SkinSolver(load_sensor("mg400-127"))
    state = solver.press(load_object("plane"), ContactPose(indent_mm=1.0))
    skin = skin3d.displaced_skin(solver.mesh, state)
    assert 0.8 < skin["displacement_mm"].max() < 1.3 and skin["displacement_xyz_mm"].shape == (skin.n_points, 3)
    assert skin3d.pins_surface(load_sensor("mg400-127").pins, state).n_points > 127


def test_area_pictures_take_any_graph():
    from twin.pins import make_graph

    rng = np.random.default_rng(0)
    rest = make_graph("voronoi", rng.uniform(0, 100, (40, 2)))
    moved = make_graph("voronoi", rest.nodes_px + rng.normal(0, 1, (40, 2)))
    figure, (ax,) = new_figure(1)
    draw_area_change(ax, moved, rest.area_px2, "change")
    assert len(ax.collections[0].get_paths()) == 40
    assert len(area_surface_figure(rest, moved).axes) == 6  # three surfaces, each with its scale


def test_enlarged_arrows_stay_between_their_pins_and_say_so():
    grid_px = 10.0 * np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), -1).reshape(-1, 2)
    for moved_px, wanted in ((0.9, 10.0), (1.1, 5.0), (30.0, 1.0), (1e-6, ENLARGEMENTS[-1])):
        assert enlargement(grid_px, grid_px + [moved_px, 0.0]) == wanted
    figure, (ax,) = new_figure(1)
    draw_displacement(ax, grid_px, grid_px + [0.9, 0.0], "pins", enlarged=10.0)
    (arrows,) = [part for part in ax.collections if hasattr(part, "U")]
    assert arrows.scale == 0.1 and np.allclose(arrows.get_array(), 0.9)
    assert "arrows 10 times" in figure.axes[1].get_ylabel()
