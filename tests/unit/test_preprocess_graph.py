"""Laws of the graphs: the cells tile their region, edges are what geometry says, no node's order matters."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import Voronoi

from scenes import load_sensor
from twin.frames.forms import from_raw, recording_to_raw
from twin.pins import make_graph, node_features, nominal_reference
from twin.pins.detectors.detector import LEGACY, legacy_graph
from twin.pins.voronoi import directed_edges, triangulate, voronoi
from twin.types import Form

TILING = 1e-9  # relative: rounding of some hundred polygon cuts
EDGES = {"rings": (1986, 1860), "hexagon": (762, 744)}  # 6 N; 2 (3 N - 3 - hull)


def shoelace(polygon):
    x, y = (polygon - polygon.mean(axis=0)).T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


def node_sets():
    rng = np.random.default_rng(3)
    line = np.linspace(0, 1, 9)[:, None] * [30.0, 40.0]
    grid = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    random = rng.uniform(0, 300, (200, 2))
    return {
        "one": np.array([[3.0, 4.0]]),
        "two": np.array([[0.0, 0.0], [5.0, 1.0]]),
        "coincident": np.ones((4, 2)),
        "collinear": line,
        "grid": grid,
        "far from the origin": random + 1e5,
        "random": random,
        "with duplicates": np.concatenate([random, random[:20]]),
        "nearly collinear": line + rng.normal(0, 1e-7, line.shape),
    }


@pytest.mark.parametrize("name", node_sets())
def test_cells_tile_the_region(name):
    nodes = node_sets()[name]
    cells = voronoi(nodes)
    assert np.isfinite(cells.area_px2).all() and (cells.area_px2 >= 0).all()
    assert cells.area_px2.sum() == pytest.approx(shoelace(cells.region_px), rel=TILING)


def test_sensor_cells_tile_the_enlarged_outline(sensor):
    rest = nominal_reference(sensor, Form.RAW)
    rng = np.random.default_rng(0)
    nodes = rest.pins_px + rng.normal(0, 0.15 * rest.spacing_px.mean(), rest.pins_px.shape)
    cells = voronoi(nodes, outmost=rest.outmost)
    outline = nodes[rest.outmost]
    assert shoelace(cells.region_px) == pytest.approx(1.05**2 * abs(shoelace(outline)), rel=1e-9)
    assert cells.area_px2.sum() == pytest.approx(shoelace(cells.region_px), rel=TILING)
    assert (cells.area_px2 > 0).all()


def test_inner_cells_are_those_of_the_plain_tessellation():
    nodes = np.random.default_rng(1).uniform(0, 100, (120, 2))
    cells = voronoi(nodes)
    diagram = Voronoi(nodes)
    center, reach = nodes.mean(axis=0), 25.0
    for i in np.flatnonzero(np.linalg.norm(nodes - center, axis=1) < reach):
        polygon = diagram.vertices[diagram.regions[diagram.point_region[i]]]
        around = polygon - polygon.mean(axis=0)
        assert cells.area_px2[i] == pytest.approx(abs(shoelace(polygon[np.argsort(np.arctan2(around[:, 1], around[:, 0]))])), rel=1e-9)


def test_edges_of_the_rest_layout(sensor):
    rest = nominal_reference(sensor, Form.RAW)
    knn, delaunay = EDGES[sensor.pins.layout]
    assert len(make_graph("knn", rest.pins_px).edges) == knn
    assert len(make_graph("delaunay", rest.pins_px).edges) == delaunay
    assert len(make_graph("voronoi", rest.pins_px, outmost=rest.outmost).edges) == delaunay


def test_edges_are_every_triangle_side_both_ways():
    nodes = np.random.default_rng(2).uniform(0, 100, (60, 2))
    triangles = triangulate(nodes)
    expected = {pair for simplex in triangles.tolist() for pair in itertools.permutations(simplex, 2)}
    edges = directed_edges(triangles, len(nodes))
    assert {tuple(edge) for edge in edges.tolist()} == expected and len(edges) == len(expected)


def test_node_order_only_permutes_the_graph():
    rng = np.random.default_rng(4)
    nodes = rng.uniform(0, 100, (80, 2))
    order = rng.permutation(len(nodes))
    plain, shuffled = make_graph("voronoi", nodes), make_graph("voronoi", nodes[order])
    np.testing.assert_allclose(shuffled.area_px2, plain.area_px2[order], rtol=1e-9)
    assert {tuple(order[e]) for e in shuffled.edges} == {tuple(e) for e in plain.edges}


def test_relative_features_don_t_know_the_scale(sensor):
    if sensor.recording is None:
        pytest.skip("has one form only")
    rest = nominal_reference(sensor, Form.PROCESSED)
    scaled = replace(rest, pins_px=2 * rest.pins_px, spacing_px=2 * rest.spacing_px, area_px2=4 * rest.area_px2)
    moved = rest.pins_px + np.random.default_rng(0).normal(0, 1, rest.pins_px.shape)
    small, large = (make_graph("voronoi", scale * moved, outmost=rest.outmost) for scale in (1, 2))
    np.testing.assert_allclose(node_features(small, rest), node_features(large, scaled), rtol=1e-9, atol=1e-9)
    assert node_features(small, rest).shape == (sensor.pins.count, 5)
    assert node_features(small, rest, "pixels").shape == (sensor.pins.count, 3)
    with pytest.raises(ValueError, match="they are of two sensors; give the reference of the Pipeline"):
        node_features(small, nominal_reference(load_sensor("mg400-331" if sensor.pins.count == 127 else "mg400-127"), Form.RAW))


def test_at_rest_the_relative_features_say_so(sensor):
    rest = nominal_reference(sensor, Form.RAW)
    columns = node_features(make_graph("voronoi", rest.pins_px, outmost=rest.outmost), rest)
    np.testing.assert_allclose(columns[:, 2:4], 0, atol=1e-12)
    np.testing.assert_allclose(columns[:, 4], 1, rtol=1e-12)


def test_published_edge_counts(sensor):
    if sensor.recording is None:
        pytest.skip("the published method takes recordings")
    rest = nominal_reference(sensor, Form.PROCESSED).pins_px
    size = LEGACY[sensor.pins.layout].size_px
    nodes = rest * size / sensor.recording.width_px
    graph = legacy_graph(nodes - np.median(nodes), LEGACY[sensor.pins.layout])
    assert len(graph.edges) == {"rings": 1860, "hexagon": 684}[sensor.pins.layout]
    assert np.isfinite(graph.area_px2).all()


def test_forms_are_inverse(sensor):
    if sensor.recording is None:
        pytest.skip("has one form only")
    raw = np.random.default_rng(0).uniform(0, 400, (50, 2))
    np.testing.assert_allclose(recording_to_raw(sensor.recording, from_raw(sensor.recording, Form.PROCESSED, raw)), raw, atol=1e-9)
    x0, y0, x1, y1 = sensor.recording.crop_px
    corners = from_raw(sensor.recording, Form.PROCESSED, np.array([[x0 - 0.5, y0 - 0.5], [x1 - 0.5, y1 - 0.5]]))
    np.testing.assert_allclose(corners, [[-0.5, -0.5], [sensor.recording.width_px - 0.5, sensor.recording.height_px - 0.5]], atol=1e-9)


@pytest.mark.parametrize("kind", ["knn", "delaunay", "voronoi"])
def test_a_single_node_has_no_edges(kind):
    graph = make_graph(kind, np.array([[3.0, 4.0]]))
    assert graph.edges.shape == (0, 2)
