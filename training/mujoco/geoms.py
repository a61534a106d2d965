"""Geoms of a MuJoCo model as the solids that a skin is pressed against (mm)."""

from collections.abc import Callable

import mujoco
import numpy as np
import trimesh

from training.surrogate.solids import Drum, Ellipsoid, SweptBox, distances_to
from twin.errors import OptionError
from twin.objects.analytic import CompiledSolid, Plane
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
    tried: list[tuple[Callable[[], CompiledSolid], FloatArray]] = [
        (lambda: _box(name, box.extents / 2), np.asarray(box.transform)),
        (lambda: _cylinder(name, np.array([drum.radius, drum.height / 2])), np.asarray(drum.transform)),
        (lambda: SweptBox(0.0, 0.0, 0.0, _require_curvature(name, ball.radius)), trimesh.transformations.translation_matrix(ball.center)),
    ]
    found = []
    for make, pose in tried:
        inside = (points - pose[:3, 3]) @ pose[:3, :3]
        try:
            thing = make()
        except OptionError:
            continue
        found.append((float(np.abs(distances_to(inside, thing.kind, np.array(thing.sizes))[0]).max()), thing, pose))
    off, thing, pose = min(found, key=lambda each: each[0])
    if off > MESH_OFF_MM:
        raise _refuse(name, f"its mesh is {off:.2f} mm off the nearest box, cylinder or ball (at most {MESH_OFF_MM:g} mm)")
    return thing, pose
