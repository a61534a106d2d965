"""Random contacts to train on: objects of the family, and paths on which they press, shear, twist, roll, leave and return."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.object import CylinderShape, EdgeShape, MeshShape, ObjectSpec, PlaneShape, PrismShape, Shape, SphereShape
from scenes.sensor import SensorSpec
from twin.geometry.shapes import shape_of
from twin.mechanics.path import ContactPath
from twin.objects import ObjectField, build_field
from twin.types import FloatArray

LEGS = 7
"""Number of straight motions of a path after its first indentation."""
DEEPEST_MM = 5.0
"""Largest sampled indentation of the undeformed dome."""
SHALLOWEST_MM = 0.3
"""Smallest sampled indentation of a contact."""
POLAR_DEG = 35.0
"""Largest angle of the first touched place from the dome's apex."""
BESIDE_MM = 9.0
"""Half range along x around the object's origin in which the touched place is drawn; along z it is half as large. Edges then lie within
or near the contact."""
SHEAR_MM = 5.0
"""Largest sideways motion of one leg."""
TURN_DEG = 15.0
"""Largest turn of one leg, about the contact's normal, its place or the dome's centre."""
FRICTION = (0.05, 1.5)
"""Range of the coefficient of friction, uniform in its logarithm."""
FREE, STICKING = 0.0, 3.0
"""Coefficients of friction of a skin that slips at once, and of one that hardly ever slips."""
END_SHARE = 0.08
"""Share of the paths with friction ``FREE``; as many have friction ``STICKING``."""
LEAVE_SHARE = 0.1
"""Share of the legs on which the object leaves the skin and comes back elsewhere."""
BACK_SHARE = 0.2
"""Share of the other legs that go back along the leg before: they show the hysteresis of friction."""
CLEAR_MM = 0.5
"""Distance between skin and object on a leg that leaves."""
LEAST_MM = {"sphere": 4.0, "cylinder": 5.0, "prism": 5.0}
"""Smallest sampled radii of balls and cylinders, and smallest sampled inradius of prisms. Smaller objects fit between two surrogate
nodes."""
LEAST_FILLET_MM = 0.45
"""Smallest sampled fillet of edges. Prisms have a fillet of at least 1 mm."""
_DIRECTIONS = 2000
"""Number of directions, over the whole sphere, at which the dome is sampled."""


@dataclass(frozen=True)
class DrawnPath:
    """One path to simulate: the object's shape, its path, and the coefficient of friction."""

    shape: Shape
    path: ContactPath
    friction: float


def draw_shape(rng: np.random.Generator) -> Shape:
    """A solid of random kind and size, in the range of the shipped objects and somewhat beyond."""

    def draw_size(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    kind = rng.choice(["plane", "sphere", "cylinder", "edge", "prism"], p=[0.2, 0.2, 0.2, 0.25, 0.15])
    if kind == "plane":
        return PlaneShape(kind="plane")
    if kind == "sphere":
        return SphereShape(kind="sphere", radius_mm=draw_size(LEAST_MM["sphere"], 45.0))
    if kind == "cylinder":
        return CylinderShape(kind="cylinder", radius_mm=draw_size(LEAST_MM["cylinder"], 45.0))
    if kind == "edge":
        return EdgeShape(kind="edge", fillet_mm=draw_size(LEAST_FILLET_MM, 3.0))
    fillet = draw_size(1.0, 8.0)
    sides, inradius_mm = int(rng.integers(3, 7)), max(fillet, draw_size(LEAST_MM["prism"], 45.0))
    return PrismShape(kind="prism", sides=sides, inradius_mm=inradius_mm, fillet_mm=fillet)


def unlike_drawn(obj: ObjectSpec) -> str:
    """The reason why an object does not belong to the sampled family; "" for one that does.

    Objects larger than the sampled ones are flatter, so they count as members of the family.
    """
    shape = obj.shape
    if obj.texture is not None:
        return f"{obj.name} has a texture, which lies between the surrogate's nodes"
    match shape:
        case MeshShape():
            return f"{obj.name} is a mesh, and no mesh was trained"
        case SphereShape() | CylinderShape() if shape.radius_mm < LEAST_MM[shape.kind]:
            return f"{obj.name} has a radius of {shape.radius_mm:g} mm, at least {LEAST_MM[shape.kind]:g} was trained"
        case PrismShape() if shape.inradius_mm < LEAST_MM[shape.kind]:
            return f"{obj.name} has an inradius of {shape.inradius_mm:g} mm, at least {LEAST_MM[shape.kind]:g} was trained"
        case EdgeShape() | PrismShape() if shape.fillet_mm < LEAST_FILLET_MM:
            return f"{obj.name} is rounded by {shape.fillet_mm:g} mm, at least {LEAST_FILLET_MM:g} was trained"
    return ""


def draw_path(sensor: SensorSpec, rng: np.random.Generator) -> DrawnPath:
    """A random object, and a random path of it over the sensor's dome."""
    shape = draw_shape(rng)
    field = build_field(ObjectSpec(name="drawn", description="", shape=shape))
    radius = sensor.skin.outer_radius_mm
    shape_of_skin = shape_of(sensor.skin)
    dome = shape_of_skin.outside(shape_of_skin.even(_DIRECTIONS))
    place, normal = _place_on(field, rng)
    toward = _direction(np.radians(rng.uniform(0, POLAR_DEG)), rng.uniform(0, 2 * np.pi))
    T = np.eye(4)
    T[:3, :3] = _turn_between(normal, -toward) @ Rotation.from_rotvec(rng.uniform(0, 2 * np.pi) * normal).as_matrix()
    T[:3, 3] = radius * toward - T[:3, :3] @ place
    poses = [at_depth(field, dome, T, 0.0)]
    poses.append(at_depth(field, dome, poses[0], _depth(rng)))
    for _ in range(LEGS):
        if rng.random() < LEAVE_SHARE:
            free = at_depth(field, dome, poses[-1], -CLEAR_MM)
            beside = at_depth(field, dome, _move_object(field, dome, free, rng), -CLEAR_MM)
            poses += [free, beside, at_depth(field, dome, beside, _depth(rng))]
        elif rng.random() < BACK_SHARE:
            poses.append(ContactPath(np.stack(poses[-2:])).at(1.0 - rng.uniform(0.3, 1.0)))
        else:
            depth = _depth(rng) if rng.random() < 0.5 else _deep(field, dome, poses[-1])[0]
            poses.append(at_depth(field, dome, _move_object(field, dome, poses[-1], rng), float(np.clip(depth, SHALLOWEST_MM, DEEPEST_MM))))
    return DrawnPath(shape, ContactPath(np.stack(poses)), _friction(rng))


def at_depth(field: ObjectField, dome_mm: FloatArray, T: FloatArray, depth_mm: float) -> FloatArray:
    """The pose at which the object is ``depth_mm`` inside the undeformed dome: it moves along the dome's normal at the deepest place."""
    T = T.copy()
    for _ in range(6):
        deep, where = _deep(field, dome_mm, T)
        T[:3, 3] += (deep - depth_mm) * where
    return T


def _deep(field: ObjectField, dome_mm: FloatArray, T: FloatArray) -> tuple[float, FloatArray]:
    """Depth of the object inside the undeformed dome, and the direction (3,) of the deepest place."""
    gap = field.distance((dome_mm - T[:3, 3]) @ T[:3, :3])
    weights = np.exp(-(gap - gap.min()) / 0.2)  # a soft minimum: the direction moves smoothly with the pose
    where = weights @ dome_mm
    return -float(gap.min()), where / np.linalg.norm(where)


def _friction(rng: np.random.Generator) -> float:
    share = rng.random()
    if share < 2 * END_SHARE:
        return FREE if share < END_SHARE else STICKING
    return float(np.exp(rng.uniform(*np.log(FRICTION))))


def _depth(rng: np.random.Generator) -> float:
    return float(rng.uniform(SHALLOWEST_MM, DEEPEST_MM))


def _move_object(field: ObjectField, dome_mm: FloatArray, T: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The object after one leg's sideways motion, twist, tilt or roll; several at once in a third of the legs."""
    _, toward = _deep(field, dome_mm, T)
    beside = np.cross(toward, rng.normal(size=3))
    beside /= np.linalg.norm(beside)
    there = float(np.linalg.norm(dome_mm[0])) * toward
    what = rng.choice(["shear", "twist", "tilt", "roll", "all"], p=[0.35, 0.1, 0.1, 0.15, 0.3])
    everything = what == "all"
    T = T.copy()
    if what == "shear" or everything:
        T[:3, 3] += rng.uniform(0.3, SHEAR_MM) * beside
    for kind, axis, centre in (("twist", toward, there), ("tilt", beside, there), ("roll", beside, np.zeros(3))):
        if what == kind or everything:
            size = TURN_DEG * (0.5 if everything else 1.0)
            turn = Rotation.from_rotvec(np.radians(rng.uniform(-size, size)) * axis).as_matrix()
            T[:3, :3] = turn @ T[:3, :3]
            T[:3, 3] = centre + turn @ (T[:3, 3] - centre)
    return T


def _place_on(field: ObjectField, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """A random place (3,) on the object's surface near its origin, and the outward normal (3,) there."""
    place = rng.uniform(-BESIDE_MM, BESIDE_MM, (1, 3)) * [1.0, 0.0, 0.5]
    for _ in range(20):
        distance, normal, _ = field.probe(place)
        place = place - distance[:, None] * normal
    return place[0], normal[0]


def _direction(polar: float, azimuth: float) -> FloatArray:
    return np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])


def _turn_between(start: FloatArray, stop: FloatArray) -> FloatArray:
    """The shortest turn (3, 3) from one unit vector to another."""
    axis, cosine = np.cross(start, stop), float(start @ stop)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3) if cosine > 0 else Rotation.from_rotvec(np.pi * np.array([1.0, 0, 0])).as_matrix()
    return Rotation.from_rotvec(np.arctan2(sine, cosine) * axis / sine).as_matrix()
