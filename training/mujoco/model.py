"""A TacTip as a part of a robot model: MJCF to attach to a flange or a finger, or URDF.

The part's frame lies on its mounting plane with z out of the flange. Skin and housing are drawn; the housing collides, the soft part does
not: its contacts are those of ``training.mujoco.scene``. Mass and inertia are those of a cylinder of the housing's size.
"""

from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import trimesh

from scenes.sensor import SensorSpec
from training.mujoco.geoms import MM
from twin.errors import OptionError
from twin.geometry.mesh import build_mesh, skin_surface
from twin.store import write_text, writes

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
    skin, spec = skin_mesh(sensor), mujoco.MjSpec()
    spec.modelname = sensor.name
    spec.add_mesh(name="skin", uservert=skin.vertices.ravel(), userface=skin.faces.ravel().astype(np.int32))
    body = spec.worldbody.add_body(name="tactip")
    middle = [0.0, 0.0, length / 2]
    body.add_geom(
        name="housing", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[radius, length / 2, 0], pos=middle, mass=mass_kg, rgba=[0.2, 0.2, 0.2, 1]
    )
    body.add_geom(
        name="skin",
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname="skin",
        pos=[0, 0, origin],
        contype=0,
        conaffinity=0,
        mass=0,
        rgba=[0.1, 0.1, 0.1, 1],
    )
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
    link = ElementTree.SubElement(robot, "link", name="tactip")
    for kind, place, shape in (
        ("visual", origin, ("mesh", {"filename": SKIN_FILE})),
        ("visual", length / 2, ("cylinder", {"radius": f"{radius:.6g}", "length": f"{length:.6g}"})),
        ("collision", length / 2, ("cylinder", {"radius": f"{radius:.6g}", "length": f"{length:.6g}"})),
        ("inertial", length / 2, None),
    ):
        part = ElementTree.SubElement(link, kind)
        ElementTree.SubElement(part, "origin", xyz=f"0 0 {place:.6g}", rpy="0 0 0")
        if shape is not None:
            ElementTree.SubElement(ElementTree.SubElement(part, "geometry"), shape[0], shape[1])
            continue
        ElementTree.SubElement(part, "mass", value=f"{mass_kg:.6g}")
        diagonal = {"ixx": across, "iyy": across, "izz": along, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
        ElementTree.SubElement(part, "inertia", {name: f"{value:.6g}" for name, value in diagonal.items()})
    ElementTree.SubElement(robot, "link", name="tactip_sensor")
    joint = ElementTree.SubElement(robot, "joint", name="tactip_mount", type="fixed")
    ElementTree.SubElement(joint, "parent", link="tactip")
    ElementTree.SubElement(joint, "child", link="tactip_sensor")
    ElementTree.SubElement(joint, "origin", xyz=f"0 0 {origin:.6g}", rpy="0 0 0")
    ElementTree.indent(robot)
    return write_text(out / "sensor.urdf", ElementTree.tostring(robot, encoding="unicode") + "\n")
