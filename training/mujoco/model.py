"""TacTips and the models of MuJoCo: a sensor as a part of a robot, and a robot's geoms as the solids that a skin is pressed against (mm).

A sensor is MJCF to attach to a flange or a finger, or URDF. The part's frame lies on its mounting plane with z out of the flange. Skin and
housing are drawn; the housing collides, the soft part does not: its contacts are those of ``training.mujoco.scene``. Mass and inertia are
those of a cylinder of the housing's size.
"""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import trimesh

from scenes.sensor import SensorSpec
from training.surrogate.solids import Drum, Ellipsoid, SweptBox, distances_to
from twin.errors import OptionError
from twin.geometry.mesh import build_mesh, skin_surface
from twin.objects.analytic import CompiledSolid, Plane
from twin.store import write_text, writes
from twin.types import FloatArray

MM = 1e3
"""Millimetres of a MuJoCo model's unit of length, the metre."""
FILLET_MM = 0.45
"""Radius of the rounded edges of boxes and cylinders. The surrogate was trained on no sharper edges."""
LEAST_MM = 4.0
"""Least radius of curvature of balls, capsules, cylinders and ellipsoids, because the nodes of the skin are 2.2 mm apart."""
MESH_OFF_MM = 0.4
"""Largest distance of a mesh's surface from the primitive that replaces it. Rounding takes 0.33 mm off the corner of a box."""
SAMPLES = 2000
Solid = tuple[CompiledSolid, FloatArray]
"""A solid, and its pose (4, 4) in the frame of its geom, mm."""
HOUSING_MM, WALL_MM, MASS_KG = 30.0, 1.0, 0.12
"""Length of the housing behind the skin's rim, how far it stands out beside the skin, and the mass of the whole sensor. They are those of a
usual TacTip; a specification does not contain them."""
FLANGE = "flange"
"""Beginning of the names of sites to which ``load_scene`` attaches sensors."""
SCENES = Path(__file__).parent / "scenes"
SKIN_FILE = "skin.stl"


def skin_mesh(sensor: SensorSpec) -> trimesh.Trimesh:
    """The skin at rest, sensor frame, m."""
    skin = skin_surface(build_mesh(sensor.geometry)).triangulate()
    return trimesh.Trimesh(skin.points / MM, skin.faces.reshape(-1, 4)[:, 1:])


def housing_m(sensor: SensorSpec, length_mm: float = HOUSING_MM) -> tuple[float, float, float]:
    """Radius and length of the housing, and the place of the sensor's origin before the mounting plane, m."""
    nodes = build_mesh(sensor.geometry).nodes_mm
    radius = float(np.linalg.norm(nodes[:, :2], axis=1).max()) + WALL_MM
    return radius / MM, length_mm / MM, (length_mm - float(nodes[:, 2].min())) / MM


def sensor_part(sensor: SensorSpec, *, length_mm: float = HOUSING_MM, mass_kg: float = MASS_KG) -> mujoco.MjSpec:
    """A sensor as MJCF: a body ``tactip`` with drawn skin, colliding housing, and the site ``tactip`` in the sensor's frame."""
    radius, length, origin = housing_m(sensor, length_mm)
    skin, spec, kinds = skin_mesh(sensor), mujoco.MjSpec(), mujoco.mjtGeom
    spec.modelname = sensor.name
    spec.add_mesh(name="skin", uservert=skin.vertices.ravel(), userface=skin.faces.ravel().astype(np.int32))
    body, size = spec.worldbody.add_body(name="tactip"), [radius, length / 2, 0]
    body.add_geom(name="housing", type=kinds.mjGEOM_CYLINDER, size=size, pos=[0, 0, length / 2], mass=mass_kg, rgba=[0.2, 0.2, 0.2, 1])
    drawn = {"contype": 0, "conaffinity": 0, "mass": 0}
    body.add_geom(name="skin", type=kinds.mjGEOM_MESH, meshname="skin", pos=[0, 0, origin], rgba=[0.1, 0.1, 0.1, 1], **drawn)
    body.add_site(name="tactip", pos=[0, 0, origin])
    return spec


def attach_sensor(robot: mujoco.MjSpec, site: str, sensor: SensorSpec, *, prefix: str, **part: float) -> str:
    """Attach a sensor to a site of a robot, with z out of the flange, and return the name of the sensor's own site.

    ``part`` are the options of ``sensor_part``.

    Raises
    ------
    OptionError
        The robot has no such site.
    """
    place = robot.site(site)
    if place is None:
        raise OptionError(f"the model has no site {site!r}; its sites are {', '.join(each.name for each in robot.sites)}")
    place.attach_body(sensor_part(sensor, **part).body("tactip"), prefix, "")
    return f"{prefix}tactip"


def scene_file(path: str | Path) -> Path:
    """The file of a scene: ``path`` is a file of MJCF, or the name of a scene of this package.

    Raises
    ------
    OptionError
        There is no such scene.
    """
    file = SCENES / f"{path}.xml" if (SCENES / f"{path}.xml").is_file() else Path(path)
    if not file.is_file():
        raise OptionError(f"{path}: no such scene; give a file of MJCF, or {', '.join(sorted(each.stem for each in SCENES.glob('*.xml')))}")
    return file


def load_scene(path: str | Path, sensor: SensorSpec) -> tuple[mujoco.MjSpec, dict[str, SensorSpec]]:
    """A scene with a sensor at every site whose name begins with ``flange``, and the sensors by their sites' names.

    ``path`` is a file of MJCF, or the name of a scene of this package (``gripper``, ``following``).

    Raises
    ------
    OptionError
        There is no such scene, or it has no such site.
    """
    robot = mujoco.MjSpec.from_file(str(scene_file(path)))
    flanges = [each.name for each in robot.sites if each.name.startswith(FLANGE)]
    if not flanges:
        raise OptionError(f"{path}: no site's name begins with {FLANGE!r}; add one for each sensor, with z out of the flange")
    return robot, {attach_sensor(robot, name, sensor, prefix=f"{name.removeprefix(FLANGE).strip('_')}_"): sensor for name in flanges}


@writes("sensor.urdf", SKIN_FILE)
def write_urdf(sensor: SensorSpec, out: Path, *, length_mm: float = HOUSING_MM, mass_kg: float = MASS_KG) -> Path:
    """Write a sensor as ``sensor.urdf`` with the mesh of its skin, and return the file's path.

    The link ``tactip`` lies on the mounting plane, the link ``tactip_sensor`` in the sensor's frame.
    """
    radius, length, origin = housing_m(sensor, length_mm)
    skin_mesh(sensor).export(out / SKIN_FILE)
    across, along = mass_kg * (3 * radius**2 + length**2) / 12, mass_kg * radius**2 / 2
    robot = ElementTree.Element("robot", name=sensor.name)

    def add(parent: ElementTree.Element, kind: str, *, at_m: float | None = None, **values: str | float) -> ElementTree.Element:
        """Add an element with values, and its place along z as an element in it."""
        texts = {key: value if isinstance(value, str) else f"{value:.6g}" for key, value in values.items()}
        part = ElementTree.SubElement(parent, kind, texts)
        if at_m is not None:
            add(part, "origin", xyz=f"0 0 {at_m:.6g}", rpy="0 0 0")
        return part

    link = add(robot, "link", name="tactip")
    add(add(add(link, "visual", at_m=origin), "geometry"), "mesh", filename=SKIN_FILE)
    for kind in ("visual", "collision"):
        add(add(add(link, kind, at_m=length / 2), "geometry"), "cylinder", radius=radius, length=length)
    inertial = add(link, "inertial", at_m=length / 2)
    add(inertial, "mass", value=mass_kg)
    add(inertial, "inertia", ixx=across, iyy=across, izz=along, ixy=0.0, ixz=0.0, iyz=0.0)
    add(robot, "link", name="tactip_sensor")
    joint = add(robot, "joint", name="tactip_mount", type="fixed")
    add(joint, "parent", link="tactip")
    add(joint, "child", link="tactip_sensor")
    add(joint, "origin", xyz=f"0 0 {origin:.6g}", rpy="0 0 0")
    ElementTree.indent(robot)
    return write_text(out / "sensor.urdf", ElementTree.tostring(robot, encoding="unicode") + "\n")


def _refuse(name: str, reason: str) -> OptionError:
    return OptionError(f"geom {name}: {reason}; leave it out by `touchable`, or replace it by a plane, ball, capsule, cylinder or box")


def _require_curvature(name: str, radius_mm: float) -> float:
    if radius_mm < LEAST_MM:
        raise _refuse(name, f"a radius of curvature of {radius_mm:.2g} mm is too small for the surrogate (at least {LEAST_MM:g} mm)")
    return radius_mm


def _box(name: str, size: FloatArray) -> CompiledSolid:
    fillet = min(FILLET_MM, *size)
    x, y, z = (size - fillet).tolist()
    return SweptBox(x, y, z, fillet)


def _cylinder(name: str, size: FloatArray) -> CompiledSolid:
    fillet = min(FILLET_MM, size[1])
    return Drum(_require_curvature(name, size[0]) - fillet, size[1] - fillet, fillet)


def _ellipsoid(name: str, size: FloatArray) -> CompiledSolid:
    _require_curvature(name, size.min() ** 2 / size.max())
    return Ellipsoid(*size.tolist())


_KINDS: dict[int, Callable[[str, FloatArray], CompiledSolid]] = {
    mujoco.mjtGeom.mjGEOM_PLANE: lambda name, size: Plane(),
    mujoco.mjtGeom.mjGEOM_SPHERE: lambda name, size: SweptBox(0.0, 0.0, 0.0, _require_curvature(name, size[0])),
    mujoco.mjtGeom.mjGEOM_CAPSULE: lambda name, size: SweptBox(0.0, 0.0, size[1], _require_curvature(name, size[0])),
    mujoco.mjtGeom.mjGEOM_CYLINDER: _cylinder,
    mujoco.mjtGeom.mjGEOM_BOX: _box,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: _ellipsoid,
}
"""How each type of geom becomes a solid, from its name and its sizes in mm."""


def solid_of(model: mujoco.MjModel, geom: int) -> Solid:
    """The solid of a geom.

    Raises
    ------
    OptionError
        The geom is of a type that no skin can be pressed against, is too sharp, or is a mesh that no primitive replaces.
    """
    name, kind, size, pose = model.geom(geom).name or str(geom), int(model.geom_type[geom]), MM * model.geom_size[geom], np.eye(4)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _of_mesh(model, geom, name)
    if kind not in _KINDS:
        raise _refuse(name, f"a geom of type {mujoco.mjtGeom(kind).name.removeprefix('mjGEOM_').lower()} can't be touched")
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        pose[:3, :3] = np.diag([1.0, -1.0, -1.0])  # z points out of MuJoCo's plane, and into the twin's
    return _KINDS[kind](name, size), pose


def _of_mesh(model: mujoco.MjModel, geom: int, name: str) -> Solid:
    """The box, cylinder or ball that is nearest to a mesh."""
    number = int(model.geom_dataid[geom])
    at, count = model.mesh_vertadr[number], model.mesh_vertnum[number]
    faces = model.mesh_face[model.mesh_faceadr[number] :][: model.mesh_facenum[number]]
    mesh = trimesh.Trimesh(MM * model.mesh_vert[at : at + count], faces)
    points, _ = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    points = np.concatenate([points, mesh.vertices])
    box, drum, ball = mesh.bounding_box_oriented.primitive, mesh.bounding_cylinder.primitive, mesh.bounding_sphere.primitive
    kinds, found = mujoco.mjtGeom, []
    for kind, size, pose in (
        (kinds.mjGEOM_BOX, box.extents / 2, np.asarray(box.transform)),
        (kinds.mjGEOM_CYLINDER, np.array([drum.radius, drum.height / 2]), np.asarray(drum.transform)),
        (kinds.mjGEOM_SPHERE, np.array([ball.radius]), trimesh.transformations.translation_matrix(ball.center)),
    ):
        with suppress(OptionError):  # its radius of curvature is too small
            thing = _KINDS[kind](name, size)
            inside = (points - pose[:3, 3]) @ pose[:3, :3]
            found.append((float(np.abs(distances_to(inside, thing.kind, np.array(thing.sizes))[0]).max()), thing, pose))
    off, thing, pose = min(found, key=lambda each: each[0])
    if off > MESH_OFF_MM:
        raise _refuse(name, f"its mesh is {off:.2f} mm off the nearest box, cylinder or ball (at most {MESH_OFF_MM:g} mm)")
    return thing, pose
