"""Signed-distance fields: unit gradients that are the distance's derivative, and meshes that help when they are bad."""

import numpy as np
import pytest
import trimesh

from scenes.load import list_objects, load_object
from scenes.object import MeshShape, ObjectSpec, PrismShape, TextureSpec
from twin.errors import MeshError
from twin.stimulus import build_stimulus
from twin.stimulus.analytic import Prism, Sphere
from twin.stimulus.mesh_field import place_mesh, read_mesh

STEP_MM = 1e-5


@pytest.fixture
def points():
    return np.random.default_rng(4).uniform([-25, -25, -4], [25, 25, 6], (2000, 3))


def differences(field, at):
    return np.stack([(field.distance(at + STEP_MM * e) - field.distance(at - STEP_MM * e)) / (2 * STEP_MM) for e in np.eye(3)], axis=1)


@pytest.mark.parametrize("name", list_objects())
def test_gradient_is_unit_and_the_derivative_of_the_distance(name, points):
    spec = load_object(name)
    field = build_stimulus(spec)
    gradient = field.gradient(points)
    assert np.abs(np.linalg.norm(gradient, axis=1) - 1).max() < 1e-9
    slope = differences(field, points)
    if spec.texture:  # joints and bent wires are no exact distances: only the direction is kept
        slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    # creases (a set of no volume) are crossed by some differences
    assert np.quantile(np.linalg.norm(gradient - slope, axis=1), 0.99) < 1e-6


@pytest.mark.parametrize("name", [name for name in list_objects() if name != "edge" and name != "mesh-can"])
def test_surface_passes_through_the_origin_with_the_object_behind_it(name):
    field = build_stimulus(load_object(name))
    z = np.array([[0, 0, -0.5], [0, 0, 0], [0, 0, 0.5]])
    distance = field.distance(z)
    assert distance[0] > 0 > distance[2]
    assert abs(distance[1]) < 1e-12


def test_filleted_edge_is_a_quarter_space_with_a_rounded_corner():
    field = build_stimulus(load_object("edge"))
    at = np.array([[5.0, 1.0, -2.0], [-2.0, 3.0, 5.0], [0.0, 0.0, 0.0]])
    assert np.allclose(field.distance(at), [2.0, 2.0, 0.5 * (np.sqrt(2) - 1)])


def test_prism_of_many_sides_is_a_cylinder(points):
    prism, cylinder = Prism(64, 33.0, 0.0, 0.0), build_stimulus(load_object("can"))
    sagitta_mm = 33.0 * (1 / np.cos(np.pi / 64) - 1)
    assert np.abs(prism.distance(points) - cylinder.distance(points)).max() < sagitta_mm


def test_prism_fillet_and_taper_against_a_dense_sampling_of_the_surface():
    """Sphere tracing from the outside ends on the surface: distance there is zero, and never overshoots."""
    field = Prism(4, 10.0, 2.0, np.radians(8))
    generator = np.random.default_rng(1)
    start = generator.uniform([-30, -5, -20], [30, 5, 40], (500, 3))
    start = start[field.distance(start) > 0.1]
    at = start - field.distance(start)[:, None] * field.gradient(start)
    assert np.abs(field.distance(at)).max() < 1e-9


def test_positive_taper_narrows_towards_y():
    field = build_stimulus(ObjectSpec(name="p", description="", shape=PrismShape(kind="prism", sides=6, inradius_mm=40.0, taper_deg=8.0)))
    low, high = field.distance(np.array([[0, -10, -1.0], [0, 10, -1.0]]))
    assert high - low == pytest.approx(2 * 10 * np.sin(np.radians(8)))


def test_wires_stand_on_the_surface_at_their_pitch():
    spec = load_object("plane").model_copy(update={"texture": TextureSpec(kind="wire-mesh", pitch_mm=4.0, wire_diameter_mm=1.0)})
    field = build_stimulus(spec)
    tops = np.array([[0, 2, -1.0], [4, 2, -1.0], [2, 8, -1.0]])
    between = np.array([[2, 2, 0.0], [6, -2, 0.0]])
    assert np.abs(field.distance(tops)).max() < 1e-9
    assert np.abs(field.distance(between)).max() < 1e-9


def test_mesh_of_a_ball_is_nearly_the_ball(tmp_path, points):
    trimesh.creation.icosphere(subdivisions=4, radius=6.0).export(tmp_path / "ball.stl")
    field = build_stimulus(load_object(tmp_path / "ball.stl"))
    near = points[np.abs(Sphere(6.0).distance(points)) < 2]
    facets_mm = 0.02
    assert np.abs(field.distance(near) - Sphere(6.0).distance(near)).max() < facets_mm
    assert np.median(np.linalg.norm(field.gradient(near) - differences(field, near), axis=1)) < 0.01
    far = np.array([[0, 0, -80.0], [90.0, 0, 0]])
    slope = differences(field, far)
    assert np.allclose(field.gradient(far), slope / np.linalg.norm(slope, axis=1, keepdims=True), atol=1e-6)
    assert (field.distance(far) > 60).all()


def test_mesh_units_rotation_and_placement(tmp_path):
    trimesh.creation.box((0.02, 0.04, 0.06)).export(tmp_path / "block.ply")
    mesh = place_mesh(read_mesh(str(tmp_path / "block.ply"), unit="m"), rotation_deg=(90.0, 0.0, 0.0))
    assert np.allclose(mesh.bounds, [[-10, -30, 0], [10, 30, 40]])
    ring = trimesh.creation.torus(10, 2)
    assert place_mesh(ring).bounds[0, 2] == pytest.approx(0)


@pytest.mark.parametrize("kind", ["open", "metre", "huge", "empty", "text", "missing"])
def test_a_bad_mesh_says_what_is_wrong_and_what_to_do(tmp_path, kind):
    path, unit = tmp_path / f"{kind}.stl", "mm"
    box = trimesh.creation.box((80, 80, 80))
    if kind == "open":
        box.update_faces(np.arange(11))
    elif kind == "metre":
        box.apply_scale(1e-3)
    elif kind == "huge":
        unit = "m"
    if kind == "text":
        path.write_text("hello")
    elif kind == "empty":
        path.write_text("solid x\nendsolid x\n")
    elif kind != "missing":
        box.export(path)
    wanted = {"open": "not watertight: 3 open edges", "metre": "too small; scale the file to mm", "huge": "too large; scale the file to mm"}
    with pytest.raises(MeshError, match=wanted.get(kind, path.name)) as caught:
        build_stimulus(ObjectSpec(name="x", description="", shape=MeshShape(kind="mesh", file=str(path), unit=unit)))
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_same_mesh_is_sampled_once(tmp_path):
    trimesh.creation.box((8, 8, 8)).export(tmp_path / "box.stl")
    spec = load_object(tmp_path / "box.stl")
    assert build_stimulus(spec) is build_stimulus(spec)
