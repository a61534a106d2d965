"""Layouts are data: any of them has a border, a reference, a graph, and is labelled in frames; missing pins stay missing."""

import os

import numpy as np
import pytest
from drawn_frames import draw_discs, smooth_warp
from scipy.spatial import Delaunay

from scenes import SpecError, load_sensor
from scenes.pins import PinsSpec, layout_from
from twin.geometry.pins import pin_lattice, rest_pins
from twin.pins import Pipeline, make_graph, make_reference, nominal_reference
from twin.types import Form, Frame

LAYOUTS = {
    "rings": PinsSpec(layout="rings", rings=6),
    "rings with pins missing": PinsSpec(layout="rings", rings=6, missing=(0, 30, 100, 126)),
    "hexagon": PinsSpec(layout="hexagon", rings=5),
    "square grid": PinsSpec(layout="grid", columns=9, rows=9),
    "rectangular grid": PinsSpec(layout="grid", columns=8, rows=11, row_distance=1.3, missing=(87,)),
    "positions": PinsSpec(layout="positions", positions=tuple((x + 0.5 * (y % 2), 0.9 * y) for x in range(9) for y in range(8))),
}


def sensor_with(pins):
    """The shipped raw camera with another layout; what was measured of its caps belongs to the other one."""
    spec = load_sensor("ur5-331")
    plain = spec.appearance.model_copy(update={"cap_levels": (), "cap_shapes": (), "cap_offsets": ()})
    return spec.model_copy(update={"pins": pins, "appearance": plain})


@pytest.mark.parametrize("pins", LAYOUTS.values(), ids=LAYOUTS)
def test_a_layout_has_as_many_places_as_pins_and_a_border_around_them(pins):
    lattice = pin_lattice(pins)
    assert len(lattice.places) == pins.count and np.linalg.norm(lattice.places, axis=1).max() == pytest.approx(1)
    border = lattice.places[lattice.outmost]
    x, y = border.T
    turning = np.abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2
    hull = lattice.places[Delaunay(lattice.places).convex_hull]
    assert len(np.unique(lattice.outmost)) == len(lattice.outmost)
    (ax, ay), (bx, by) = (hull - lattice.places.mean(axis=0)).transpose(1, 2, 0)
    covered = np.abs(ax * by - ay * bx).sum() / 2
    assert 0.8 * covered < turning <= covered + 1e-9  # in order around the layout, and nearly all of its hull


def test_missing_pins_leave_the_others_in_their_order():
    whole, less = PinsSpec(rings=4), PinsSpec(rings=4, missing=(3, 20))
    places = np.delete(pin_lattice(whole).places, [3, 20], axis=0)
    assert np.allclose(pin_lattice(less).places, places)
    slots = pin_lattice(less).slots
    assert len(slots) == 61 and slots[3] == slots[20] == -1 and np.array_equal(slots[slots >= 0], np.arange(59))


@pytest.mark.parametrize("pins", LAYOUTS.values(), ids=LAYOUTS)
def test_flips_from_the_rest_layout_find_the_delaunay_triangles(pins):
    """Also where the outline is concave, and where pins on a circle or a line make the triangles ambiguous: Qhull then chooses."""
    rest, rng, found = nominal_reference(sensor_with(pins), Form.RAW), np.random.default_rng(5), 0
    assert rest.net is not None
    for share in (0.0, 0.03, 0.06, 0.1, 0.2, 0.3) * 4:
        nodes = rest.pins_px + rng.normal(0, share * rest.pitch_px, rest.pins_px.shape)
        assert np.array_equal(make_graph("delaunay", nodes, net=rest.net).edges, make_graph("delaunay", nodes).edges)
        found += rest.net.move(nodes) is not None
    assert found >= 8


@pytest.mark.parametrize("pins", LAYOUTS.values(), ids=LAYOUTS)
def test_the_pipeline_labels_any_layout_in_contact(pins):
    sensor = sensor_with(pins)
    rest = nominal_reference(sensor, Form.RAW).pins_px
    truth = smooth_warp(rest, 8.0, np.random.default_rng(1))
    image = draw_discs((640, 480), truth, 5.0, level=(20, 130), blur_px=0.8)
    seen = Pipeline(sensor, Form.RAW)(Frame(image, Form.RAW))
    assert seen.valid and seen.found == seen.expected == pins.count, seen.reason
    assert np.linalg.norm(seen.pins_px - truth, axis=1).max() < 0.5
    assert seen.graph.area_px2.min() > 0


def test_a_grid_bends_over_the_dome_as_spacing_says():
    plan = sensor_with(PinsSpec(layout="grid", columns=5, rows=5, spacing="plan"))
    feet = rest_pins(plan.geometry).base_mm
    steps = np.diff(feet.reshape(5, 5, 3)[:, :, 0], axis=1)
    assert np.allclose(steps, steps[0, 0])  # even, seen along the axis


def test_measured_places_at_rest_take_the_place_of_projected_ones():
    sensor = sensor_with(PinsSpec(rings=3))
    rest = nominal_reference(sensor, Form.RAW).pins_px + [5.0, -2.0]
    raw = sensor.pipeline.raw.model_copy(update={"rest_px": tuple(map(tuple, rest.tolist()))})
    moved = sensor.model_copy(update={"pipeline": sensor.pipeline.model_copy(update={"raw": raw})})
    assert np.allclose(nominal_reference(moved, Form.RAW).pins_px, rest)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("rings:0", "greater than or equal to 1"),
        ("rings:x", "rings:10"),
        ("rings", "the number of rings is missing"),
        ("grid:9", "grid:9x7"),
        ("grid:9xb", "columns and rows are missing or no numbers"),
        ("cubes:3", "not known"),
        ("positions:nowhere.csv", "nowhere.csv"),
    ],
)
def test_a_layout_that_cannot_be_is_refused_in_words(text, said):
    with pytest.raises(SpecError, match=said):
        layout_from(text)


@pytest.mark.parametrize(
    "text", ["\ufeffx;y\n0;0\n1;0\n0;2\n", "# pins of the dome\nx,y\n0,0\n1,0\n0,2\n"], ids=["semicolons", "a comment before the header"]
)
def test_positions_come_from_a_file_with_or_without_a_header(tmp_path, text):
    file = tmp_path / "pins.csv"
    file.write_text(text, encoding="utf-8")
    assert layout_from(f"positions:{file}").positions == ((0.0, 0.0), (1.0, 0.0), (0.0, 2.0))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x,y\nmm,mm\n0,0\n1,0\n0,2\n", "line 2"),
        ("1.0,2.O\n0,0\n1,0\n0,2\n", "line 1"),
        ("0,0\n1,1\n2,2\n", "on one line"),
        ("1e308,1e308\n-1e308,1e308\n1,1\n0,0\n", "less than or equal to 1000000000"),
        ("0,0\n1,one\n", "line 2"),
    ],
)
def test_a_file_that_holds_no_positions_is_refused_by_its_line(tmp_path, text, said):
    file = tmp_path / "pins.csv"
    file.write_text(text)
    with pytest.raises(SpecError, match=said):
        layout_from(f"positions:{file}")


@pytest.mark.parametrize("place", ["/dev/zero", "/", "pipe"])
def test_places_of_pins_are_read_from_a_file_alone(tmp_path, place):
    if place == "pipe":
        place = str(tmp_path / "pipe")
        os.mkfifo(place)
    with pytest.raises(SpecError, match=f"^{place}: can't be read .*give a CSV file"):
        layout_from(f"positions:{place}")


@pytest.mark.parametrize(
    "wrong",
    [
        {"layout": "grid", "columns": 5},
        {"layout": "rings"},
        {"rings": 3, "columns": 4},
        {"rings": 3, "missing": (37,)},
        {"rings": 3, "missing": (1, 1)},
        {"layout": "positions", "positions": ((0.0, 0.0), (0.0, 0.0), (1.0, 0.0))},
    ],
)
def test_an_impossible_layout_is_refused(wrong):
    with pytest.raises(ValueError):
        PinsSpec(**wrong)


def test_references_of_rings_know_their_rings_and_grids_have_one():
    rings, grid = PinsSpec(rings=3), PinsSpec(layout="grid", columns=4, rows=4)
    assert make_reference(100 * pin_lattice(rings).places, rings).ring_ends.tolist() == [1, 7, 19, 37]
    assert make_reference(100 * pin_lattice(grid).places, grid).ring_ends.tolist() == [0, 16]
