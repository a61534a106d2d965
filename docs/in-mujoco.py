"""A TacTip in MuJoCo: a ball falls onto the sensor, which feels it and carries it.

    pip install mujoco tactip-twin
    python in-mujoco.py

At each step the ball's pose goes into the surrogate, and the force of the skin goes back onto the ball. Lengths in MuJoCo are m,
in the twin mm.
"""

import mujoco
import numpy as np

from scenes import load_object, load_sensor
from training.surrogate.contacts import SurrogateContacts
from training.surrogate.felt import Contact
from training.surrogate.model import surrogate_of
from twin.mechanics.law import ContactLaw

WORLD = """
<mujoco>
  <option timestep="0.002" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="ball" pos="0 0 0.0415">
      <freejoint/>
      <geom type="sphere" size="0.02" mass="0.05" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
STEPS = 1500
DAMPING_N_S_PER_M = 0.6  # of the gel, which the quasi-static skin does not have

sensor, ball = load_sensor("mg400-331"), load_object("ball-40")
skin = SurrogateContacts(surrogate_of(sensor), sensor, 1)
skin.begin(0, Contact(sensor, ball, ContactLaw.of_object(ball)))
model = mujoco.MjModel.from_xml_string(WORLD)
data = mujoco.MjData(model)
body = model.body("ball").id
mujoco.mj_forward(model, data)

for step in range(STEPS):
    # the sensor lies at the origin, its tip up; the object's origin is the ball's pole, which faces the sensor
    turn, middle = data.xmat[body].reshape(3, 3), 1e3 * data.xpos[body]
    T = np.eye(4)
    T[:3, :3] = turn
    T[:3, 3] = middle - 20.0 * turn[:, 2]
    skin.move(np.zeros(1, int), T[None], np.array([data.time]))
    felt = skin.felt
    if felt.lost[0]:
        raise SystemExit(felt.lost[0])
    force, torque = felt.force_n[0], 1e-3 * felt.torque_nmm[0]
    arm = 1e-3 * middle
    pressing = bool(np.linalg.norm(force) > 0)
    data.xfrc_applied[body, :3] = force - pressing * DAMPING_N_S_PER_M * data.qvel[:3]
    data.xfrc_applied[body, 3:] = torque - np.cross(arm, force)
    mujoco.mj_step(model, data)
    if step % 300 == 299:
        pins = np.linalg.norm(felt.caps_mm[0] - skin.caps_at_rest_mm, axis=1)
        print(f"{data.time:.2f} s: ball at {middle[2]:.2f} mm, force {force[2]:.2f} N, largest motion of a pin {pins.max():.2f} mm")
