"""Signed-distance fields: unit gradients and Hessians that are derivatives, and meshes that help when they are bad."""

import numpy as np
import pytest
import trimesh

from scenes.load import list_specifications, load_object
from scenes.object import MeshShape, ObjectSpec, PrismShape, TextureSpec
from twin.errors import MeshError
from twin.objects import build_field, mesh_field
from twin.objects.analytic import Cylinder, Edge, Plane, Prism, Sphere
from twin.objects.build import WireMesh
from twin.objects.mesh_field import MeshField, place_mesh, read_mesh, sample_mesh, signed_distance

STEP_MM = 1e-5
EXACT = {
    "plane": Plane(),
    "ball": Sphere(10.0),
    "cylinder": Cylinder(8.0),
    "edge": Edge(3.0),
    "sharp edge": Edge(0.0),
    "prism": Prism(6, 9.0, 2.0, 0.0),
    "sharp prism": Prism(3, 5.0, 0.0, 0.0),
    "tapered prism": Prism(5, 9.0, 2.0, np.radians(8)),
}


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setenv("TACTIP_CACHE", "off")


@pytest.fixture(scope="module")
def egg() -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=6.0)
    mesh.apply_scale([1.0, 1.5, 0.8])
    return place_mesh(mesh)


@pytest.fixture(scope="module")
def fields(egg) -> dict:
    """Fields that are no exact distances."""
    wires = {f"wires on a {name}": WireMesh(field, 4.0, 1.0) for name, field in EXACT.items() if "sharp" not in name}
    egg = sample_mesh(egg)
    return {"mesh": egg, "wires on a mesh": WireMesh(egg, 4.0, 1.0), **wires}


@pytest.fixture
def points():
    return np.random.default_rng(4).uniform([-25, -25, -4], [25, 25, 6], (2000, 3))


def differences(field, at, *, gradient=False):
    """Central differences of the distance, or of the gradient; the last axis is the direction."""

    def of(places):
        return field.probe(places)[1] if gradient else field.distance(places)

    return np.stack([(of(at + STEP_MM * e) - of(at - STEP_MM * e)) / (2 * STEP_MM) for e in np.eye(3)], axis=-1)


def hessian_errors(gradient, hessian, turning):
    """Largest entries of H - H^T, H n and H - dn/dx."""
    asymmetry = np.abs(hessian - hessian.transpose(0, 2, 1)).max()
    along_normal = np.abs(np.einsum("kij,kj->ki", hessian, gradient)).max()
    return asymmetry, along_normal, np.abs(hessian - turning).max()


@pytest.mark.parametrize("name", EXACT)
def test_hessian_of_an_exact_distance_is_the_derivative_of_the_gradient(name, points):
    field = EXACT[name]
    distance, gradient, hessian = field.probe(points)
    assert np.array_equal(distance, field.distance(points))
    asymmetry, along_normal, error = hessian_errors(gradient, hessian, differences(field, points, gradient=True))
    assert asymmetry == 0
    assert along_normal < 1e-9
    assert error < 1e-7  # none of the points is next to a crease
    assert (hessian != 0).any() == (name != "plane")


@pytest.mark.parametrize("name", ["mesh", "wires on a mesh", *(f"wires on a {name}" for name in EXACT if "sharp" not in name)])
def test_hessian_of_any_field_is_how_its_gradient_turns_along_the_surface(name, fields, points):
    field = fields[name]
    at = points[np.abs(field.distance(points)) < 3]
    distance, gradient, hessian = field.probe(at)
    assert np.allclose(distance, field.distance(at), rtol=0, atol=1e-12)
    along = np.eye(3) - gradient[:, :, None] * gradient[:, None, :]
    asymmetry, along_normal, error = hessian_errors(gradient, hessian, differences(field, at, gradient=True) @ along)
    assert asymmetry == 0
    assert along_normal < 1e-9
    # under wires on a mesh the base's unit gradient stands for its slope, which differs by the spline's error
    assert error < (0.1 if name == "wires on a mesh" else 1e-4)
    assert np.abs(hessian).max() > 0.01


def test_there_is_no_curvature_on_creases():
    edge, prism, ball = Edge(0.0), Prism(4, 10.0, 0.0, 0.0), Sphere(10.0)
    for field, at in (
        (edge, [[0.0, 1.0, 0.0], [2.0, 0.0, 2.0], [-1e-4, 0.0, -1e-4]]),
        (prism, [[0.0, 3.0, 10.0], [10.0, 0.0, 0.0]]),
        (ball, [[0.0, 0.0, 10.0]]),
    ):
        _, gradient, hessian = field.probe(np.array(at))
        assert not hessian.any()
        assert np.allclose(np.linalg.norm(gradient, axis=1), 1)


@pytest.mark.parametrize("order", ["fortran", "strided", "single", "none"])
def test_points_may_come_in_any_layout(order, points, fields):
    wanted = points[::2]
    given = {"fortran": np.asfortranarray(wanted), "strided": wanted, "single": wanted.astype("f4"), "none": wanted[:0]}[order]
    for field in (Sphere(10.0), fields["mesh"], WireMesh(Prism(6, 9.0, 2.0, 0.1), 4.0, 1.0)):
        for got, full in zip(field.probe(given), field.probe(np.array(given, float, order="C")), strict=True):
            assert np.array_equal(got, full)


@pytest.mark.parametrize("name", list_specifications("objects"))
def test_gradient_is_unit_and_the_derivative_of_the_distance(name, points):
    spec = load_object(name)
    field = build_field(spec)
    gradient = field.probe(points)[1]
    assert np.abs(np.linalg.norm(gradient, axis=1) - 1).max() < 1e-9
    slope = differences(field, points)
    if spec.texture:  # joints and bent wires are no exact distances: only the direction is kept
        slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    # creases (a set of no volume) are crossed by some differences
    assert np.quantile(np.linalg.norm(gradient - slope, axis=1), 0.99) < 1e-6


@pytest.mark.parametrize("name", [name for name in list_specifications("objects") if name != "edge" and name != "mesh-can"])
def test_surface_passes_through_the_origin_with_the_object_behind_it(name):
    field = build_field(load_object(name))
    z = np.array([[0, 0, -0.5], [0, 0, 0], [0, 0, 0.5]])
    distance = field.distance(z)
    assert distance[0] > 0 > distance[2]
    assert abs(distance[1]) < 1e-12


def test_filleted_edge_is_a_quarter_space_with_a_rounded_corner():
    field = build_field(load_object("edge"))
    at = np.array([[5.0, 1.0, -2.0], [-2.0, 3.0, 5.0], [0.0, 0.0, 0.0]])
    assert np.allclose(field.distance(at), [2.0, 2.0, 0.5 * (np.sqrt(2) - 1)])


def test_prism_of_many_sides_is_a_cylinder(points):
    prism, cylinder = Prism(64, 33.0, 0.0, 0.0), build_field(load_object("can"))
    sagitta_mm = 33.0 * (1 / np.cos(np.pi / 64) - 1)
    assert np.abs(prism.distance(points) - cylinder.distance(points)).max() < sagitta_mm


def test_prism_fillet_and_taper_against_a_dense_sampling_of_the_surface():
    """Sphere tracing from the outside ends on the surface: distance there is zero, and never overshoots."""
    field = Prism(4, 10.0, 2.0, np.radians(8))
    generator = np.random.default_rng(1)
    start = generator.uniform([-30, -5, -20], [30, 5, 40], (500, 3))
    start = start[field.distance(start) > 0.1]
    at = start - field.distance(start)[:, None] * field.probe(start)[1]
    assert np.abs(field.distance(at)).max() < 1e-9


def test_positive_taper_narrows_towards_y():
    field = build_field(ObjectSpec(name="p", description="", shape=PrismShape(kind="prism", sides=6, inradius_mm=40.0, taper_deg=8.0)))
    low, high = field.distance(np.array([[0, -10, -1.0], [0, 10, -1.0]]))
    assert high - low == pytest.approx(2 * 10 * np.sin(np.radians(8)))


def test_wires_stand_on_the_surface_at_their_pitch():
    spec = load_object("plane").model_copy(update={"texture": TextureSpec(kind="wire-mesh", pitch_mm=4.0, wire_diameter_mm=1.0)})
    field = build_field(spec)
    tops = np.array([[0, 2, -1.0], [4, 2, -1.0], [2, 8, -1.0]])
    between = np.array([[2, 2, 0.0], [6, -2, 0.0]])
    assert np.abs(field.distance(tops)).max() < 1e-9
    assert np.abs(field.distance(between)).max() < 1e-9


def test_mesh_of_a_ball_is_nearly_the_ball(tmp_path, points):
    trimesh.creation.icosphere(subdivisions=4, radius=6.0).export(tmp_path / "ball.stl")
    field = build_field(load_object(tmp_path / "ball.stl"))
    near = points[np.abs(Sphere(6.0).distance(points)) < 2]
    facets_mm = 0.02
    assert np.abs(field.distance(near) - Sphere(6.0).distance(near)).max() < facets_mm
    assert np.median(np.linalg.norm(field.probe(near)[1] - differences(field, near), axis=1)) < 0.01
    far = np.array([[0, 0, -80.0], [90.0, 0, 0]])
    slope = differences(field, far)
    assert np.allclose(field.probe(far)[1], slope / np.linalg.norm(slope, axis=1, keepdims=True), atol=1e-6)
    assert (field.distance(far) > 60).all()


def test_mesh_far_outside_its_grid_still_has_derivatives(fields):
    field = fields["mesh"]
    far = np.random.default_rng(2).uniform(-60, 60, (500, 3))
    far = far[field.distance(far) > 20]
    turning = differences(field, far, gradient=True)
    _, gradient, hessian = field.probe(far)
    along = np.eye(3) - gradient[:, :, None] * gradient[:, None, :]
    assert np.abs(hessian - turning @ along).max() < 1e-4


def distance_by_brute_force(mesh, at):
    """Nearest point among all triangles, sign by the winding number."""
    to = mesh.triangles[None] - at[:, None, None]
    triangles = np.broadcast_to(mesh.triangles, (len(at), *mesh.triangles.shape)).reshape(-1, 3, 3)
    nearest = trimesh.triangles.closest_point(triangles, np.repeat(at, len(mesh.faces), axis=0)).reshape(len(at), -1, 3)
    distance = np.linalg.norm(nearest - at[:, None], axis=2).min(axis=1)
    a, b, c = np.moveaxis(to, 2, 0)
    la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
    volume = np.einsum("kfi,kfi->kf", a, np.cross(b, c))
    dot = {"ab": (a * b).sum(2), "bc": (b * c).sum(2), "ca": (c * a).sum(2)}
    angle = 2 * np.arctan2(volume, la * lb * lc + dot["ab"] * lc + dot["bc"] * la + dot["ca"] * lb)
    return np.where(angle.sum(axis=1) > 2 * np.pi, -distance, distance)


@pytest.mark.parametrize("kind", ["egg", "box", "ring", "spike", "sliver fan"])
def test_mesh_distance_is_that_of_all_triangles_and_the_winding_number(kind, egg):
    mesh = {
        "egg": egg,
        "box": trimesh.creation.box((8.0, 8.0, 8.0)),
        "ring": trimesh.creation.torus(5, 2, major_sections=24, minor_sections=12),
        "spike": trimesh.creation.cone(0.5, 8.0, sections=5),
        "sliver fan": trimesh.creation.cylinder(4.0, 0.5, sections=200),
    }[kind]
    at = np.random.default_rng(5).uniform(mesh.bounds[0] - 2, mesh.bounds[1] + 2, (300, 3))
    assert np.abs(signed_distance(mesh, at) - distance_by_brute_force(mesh, at)).max() < 1e-9


def test_triangles_without_area_do_not_matter():
    box = trimesh.creation.box((8.0, 8.0, 8.0))
    box.invert()  # a hole: where an edge is nearest, the solid is, and a normal of zero would say outside
    ends = box.edges
    middles = box.vertices[ends].mean(axis=1)
    flat = np.column_stack([ends[:, 0], 8 + np.arange(len(ends)), ends[:, 1]])
    split = trimesh.Trimesh(np.vstack([box.vertices, middles]), np.vstack([flat, box.faces]), process=False)
    at = np.random.default_rng(6).uniform(-6, 6, (300, 3))
    assert np.abs(signed_distance(split, at) - signed_distance(box, at)).max() < 1e-12


def test_a_mesh_wound_inwards_is_the_same_solid(tmp_path):
    """Its file's normals look inwards too."""
    box = trimesh.creation.box((8.0, 8.0, 8.0))
    box.export(tmp_path / "box.stl")
    inward = trimesh.Trimesh(box.vertices, box.faces[:, ::-1])
    assert inward.volume < 0
    inward.export(tmp_path / "inward.stl")
    at = np.random.default_rng(7).uniform(-6, 6, (300, 3))
    found, wanted = (signed_distance(read_mesh(str(tmp_path / f"{name}.stl")), at) for name in ("inward", "box"))
    assert np.abs(found - wanted).max() < 1e-6  # an STL holds single precision


def test_mesh_units_rotation_and_placement(tmp_path):
    trimesh.creation.box((0.02, 0.04, 0.06)).export(tmp_path / "block.ply")
    mesh = place_mesh(read_mesh(str(tmp_path / "block.ply"), unit="m"), rotation_deg=(90.0, 0.0, 0.0))
    assert np.allclose(mesh.bounds, [[-10, -30, 0], [10, 30, 40]])
    ring = trimesh.creation.torus(10, 2)
    assert place_mesh(ring).bounds[0, 2] == pytest.approx(0)


@pytest.mark.parametrize("kind", ["open", "metre", "huge", "thin", "empty", "text", "missing"])
def test_a_bad_mesh_says_what_is_wrong_and_what_to_do(tmp_path, kind):
    path, unit = tmp_path / f"{kind}.stl", "mm"
    box = trimesh.creation.box((80, 80, 80))
    if kind == "open":
        box.update_faces(np.arange(11))
    elif kind == "metre":
        box.apply_scale(1e-3)
    elif kind == "huge":
        unit = "m"
    elif kind == "thin":
        box = trimesh.creation.box((20, 20, 0.5))
    if kind == "text":
        path.write_text("hello")
    elif kind == "empty":
        path.write_text("solid x\nendsolid x\n")
    elif kind != "missing":
        box.export(path)
    wanted = {
        "open": "not watertight: 3 open edges",
        "metre": "too small; scale the file to mm",
        "huge": "too large; scale the file to mm",
        "thin": r"walls are 0\.48 mm thick.*solid, or thicker",
    }
    with pytest.raises(MeshError, match=wanted.get(kind, path.name)) as caught:
        build_field(ObjectSpec(name="x", description="", shape=MeshShape(kind="mesh", file=str(path), unit=unit)))
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture
def sampled(monkeypatch) -> list:
    """One entry for each mesh that is really sampled."""
    calls = []
    real = sample_mesh
    monkeypatch.setattr(mesh_field, "sample_mesh", lambda mesh: calls.append(mesh) or real(mesh))
    return calls


def test_the_same_mesh_is_sampled_once(tmp_path):
    trimesh.creation.box((8, 8, 8)).export(tmp_path / "box.stl")
    spec = load_object(tmp_path / "box.stl")
    assert build_field(spec) is build_field(spec)


def test_a_sampled_mesh_is_kept_on_disk_by_content_and_placement(tmp_path, monkeypatch, sampled):
    monkeypatch.setenv("TACTIP_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "box.stl"

    def load(**changes) -> MeshField:
        mesh_field._sample_field.cache_clear()  # as a new process would start
        return build_field(ObjectSpec(name="x", description="", shape=MeshShape(kind="mesh", file=str(path), **changes)))

    trimesh.creation.box((7, 8, 9)).export(path)
    first = load()
    path.touch()
    again = load()
    assert len(sampled) == 1
    assert again.spacing_mm == first.spacing_mm
    assert np.array_equal(again.corner_mm, first.corner_mm)
    assert np.array_equal(again.coefficients, first.coefficients)
    load(rotation_deg=(90.0, 0.0, 0.0))
    load(unit="cm")
    assert len(sampled) == 3
    monkeypatch.setattr(mesh_field, "_NODES", 30_000)
    load()
    trimesh.creation.box((7, 8, 10)).export(path)
    load()
    assert len(sampled) == 5
