"""The same presses by a robot scene and by the finite elements, for each kind of geom: errors of force and pins.

Run: PYTHONPATH=. python tests/bench/bench_geoms.py. The finite elements press the geom's own shape as a fine mesh, so the rounded edges of
boxes and cylinders count as errors of the scene.
"""

import tempfile
from pathlib import Path

import mujoco
import numpy as np
import trimesh

from scenes import ObjectSpec, load_sensor
from scenes.object import MeshShape, PlaneShape
from training.mujoco import TactileScene
from twin.geometry.pins import rest_pins
from twin.mechanics.path import ContactPose
from twin.simulator import Simulator

SENSOR = "mg400-331"
DEPTH_MM, STEP_MM, FRICTION = 2.5, 0.1, 0.5
LYING = "euler='90 0 0'"


def lying(mesh):
    """The mesh with its axis along y."""
    return mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))


def box():
    """Half sizes 8, 8, 10 mm."""
    return trimesh.creation.box([16, 16, 20]).subdivide_to_size(2.0)


def kinds():
    """By kind: the geom in MJCF, the height of its middle above its lowest point, mm, and its mesh in mm (None: a plane)."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    corners = " ".join(f"{x} {y} {z}" for x in (-0.008, 0.008) for y in (-0.008, 0.008) for z in (-0.01, 0.01))
    return {
        "plane": ("type='plane' size='.05 .05 .01' euler='180 0 0'", 0.0, None),
        "sphere": ("type='sphere' size='.01'", 10.0, ball.copy().apply_scale(10)),
        "capsule": (f"type='capsule' size='.008 .015' {LYING}", 8.0, lying(trimesh.creation.capsule(30.0, 8.0, count=[96, 96]))),
        "cylinder": (f"type='cylinder' size='.01 .02' {LYING}", 10.0, lying(trimesh.creation.cylinder(10.0, 40.0, sections=256))),
        "ellipsoid": ("type='ellipsoid' size='.015 .012 .01'", 10.0, ball.copy().apply_scale([15, 12, 10])),
        "box": ("type='box' size='.008 .008 .01'", 10.0, box()),
        "mesh": ("type='mesh' mesh='m'", 10.0, box()),
    }, f"<asset><mesh name='m' vertex='{corners}'/></asset>"


def errors(simulator, geom, height_mm, mesh, assets, folder):
    """Force of the finite elements, N; error of the force as a share of it; mean error of the pins and their mean motion, mm."""
    shape = PlaneShape(kind="plane")
    if mesh is not None:
        mesh.export(folder / "geom.stl")
        shape = MeshShape(kind="mesh", file=str(folder / "geom.stl"))
    state = simulator.press(ObjectSpec(name="geom", description="", shape=shape), ContactPose(indent_mm=DEPTH_MM), friction=FRICTION)
    start = (20.0 + height_mm + 1.0) / 1e3
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco>{assets}<worldbody><body name='tip'><site name='tip'/></body>"
        f"<body name='geom' pos='0 0 {start}' mocap='true'><geom name='geom' {geom} friction='{FRICTION}'/></body></worldbody></mujoco>"
    )
    scene = TactileScene(model, {"tip": SENSOR}, touchable=["geom"])
    for moved in np.linspace(0, 1.0 + DEPTH_MM, round((1.0 + DEPTH_MM) / STEP_MM) + 1):
        scene.data.mocap_pos[0, 2] = start - moved / 1e3
        scene.step()
    scene.step()  # at rest: without the loss of a moving skin
    seen, rest = scene.read("tip"), rest_pins(load_sensor(SENSOR).geometry).caps_mm
    force = float(np.linalg.norm(state.force_n))
    off, moved = (float(np.linalg.norm(each, axis=1).mean()) for each in (seen.caps_mm - state.caps_mm, state.caps_mm - rest))
    return force, float(np.linalg.norm(seen.force_n - state.force_n)) / force, off, moved


def measured():
    """``errors`` by kind."""
    simulator, (of, assets) = Simulator(load_sensor(SENSOR)), kinds()
    with tempfile.TemporaryDirectory() as folder:
        return {kind: errors(simulator, *given, assets if kind == "mesh" else "", Path(folder)) for kind, given in of.items()}


if __name__ == "__main__":
    for kind, (force, share, off, moved) in measured().items():
        print(f"{kind:10} force {force:.2f} N, error {share:.1%}; pins {off:.3f} mm off, of {moved:.2f} mm")
