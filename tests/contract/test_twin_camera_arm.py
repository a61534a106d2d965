"""What the servo's twin shows is the contact that its sensor's rig makes of the arm's pose."""

import time

import numpy as np
import pytest

from hardware.arms.arm import SimulatedArm
from hardware.cameras.twin import TwinCamera
from hardware.rig.geometry import PlacedObject, shift_in_tool
from scenes import PlacementSpec, load_experiment, load_object, load_sensor
from twin.mechanics.follow import SETTLED_MM
from twin.rig.contact import contact_law
from twin.rig.kinematics import Mounting
from twin.types import Form

DRAG_MM = 2.0  # along the plate: friction then acts across the sensor


@pytest.mark.parametrize(
    "rig", [{}, {"compliance_mm_per_n": 0.2, "turn_compliance_deg_per_n": 2.0}], ids=["as shipped", "an arm that gives way"]
)
def test_the_object_is_where_the_arms_force_leaves_it_and_rubs_as_the_rig_does(rig):
    spec = load_sensor("mg400-331")
    spec = spec.model_copy(update={"rig": spec.rig.model_copy(update={"friction": 0.2, **rig})})
    mounting, plate = Mounting.of(spec, load_experiment("surface-2d")), load_object("plane")
    placed = PlacedObject(plate, PlacementSpec(), mounting)
    start = placed.start_pose(2.0)
    arm = SimulatedArm(axes=6, pose=start, time_scale=np.inf)
    arm.connect()
    arm.enable()
    camera = TwinCamera(spec, placed, arm.state, Form.PROCESSED, on_demand=True)
    with camera:
        camera.read(timeout_s=camera.first_frame_s)
        arm.move_linear(shift_in_tool(start, DRAG_MM * mounting.across))
        camera.read_after(arm.state().time_s, timeout_s=camera.first_frame_s)
        state = camera.state
    commanded = placed.object_from(arm.state().pose)
    law = contact_law(spec.rig, mounting, plate)
    held = law.pose(commanded, state.force_n)
    held[2, 3] += spec.rig.compliance_mm_per_n * state.force_n[2]
    np.testing.assert_allclose(state.T_sensor_object, held, atol=SETTLED_MM)
    rubbed = np.linalg.norm(state.tangential_n, axis=1)
    assert (rubbed <= 0.2 * state.normal_n * (1 + 1e-9)).all() and state.slipping.mean() > 0.5
    assert np.abs(held - commanded).max() > SETTLED_MM


def test_a_picture_that_took_long_to_compute_is_shown(monkeypatch):
    """On a slow or busy machine a contact takes seconds. That is no fault of a clock."""
    spec = load_sensor("mg400-127")
    placed = PlacedObject(load_object("plane"), PlacementSpec(), Mounting.of(spec, load_experiment("surface-2d")))
    arm = SimulatedArm(axes=6, pose=placed.start_pose(-5.0), time_scale=np.inf)
    arm.connect()
    late_s = 0.1
    with TwinCamera(spec, placed, arm.state, Form.PROCESSED, on_demand=True) as camera:
        camera.read(timeout_s=camera.first_frame_s)
        move = camera._world.move
        monkeypatch.setattr(camera._world, "move", lambda *told: time.sleep(2 * late_s) or move(*told))
        monkeypatch.setattr("hardware.cameras.reader.LATE_S", late_s)
        for _ in range(2):
            camera.read_after(time.monotonic(), timeout_s=camera.first_frame_s)
