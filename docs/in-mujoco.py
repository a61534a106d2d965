"""A TacTip in MuJoCo: a plate is laid onto the sensor and pushed aside; the sensor feels it, carries it and rubs against it.

    pip install mujoco tactip-twin
    python in-mujoco.py

At each step the plate's pose goes into the surrogate, and the force of the skin goes back onto the plate. Lengths in MuJoCo are m,
in the twin mm.
"""

import mujoco
import numpy as np

from scenes import load_object, load_sensor
from training.surrogate.contacts import SurrogateContacts
from training.surrogate.model import surrogate_of
from training.surrogate.reading import EpisodeContact
from twin.mechanics.law import ContactLaw

WORLD = """
<mujoco>
  <option timestep="0.002" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="plate" pos="0 0 0.0205">
      <joint type="slide" axis="0 0 1" damping="4"/>
      <joint type="slide" axis="1 0 0" damping="4"/>
      <geom type="box" size="0.05 0.05 0.005" pos="0 0 0.005" mass="0.1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
STEPS = 1500
PUSH_FROM_S, PUSH_N = 1.0, 0.3  # sideways

sensor, plane = load_sensor("mg400-331"), load_object("plane")
skin = SurrogateContacts(surrogate_of(sensor), sensor, 1)
skin.begin(0, EpisodeContact(sensor, plane, ContactLaw.of_object(plane)))
model = mujoco.MjModel.from_xml_string(WORLD)
data = mujoco.MjData(model)
body = model.body("plate").id
mujoco.mj_forward(model, data)

for step in range(STEPS):
    T = np.eye(4)  # the sensor lies at the world's origin with its tip up; the plate's frame has its origin on the face that is touched
    T[:3, :3] = data.xmat[body].reshape(3, 3)
    T[:3, 3] = 1e3 * data.xpos[body]
    skin.move(np.zeros(1, int), T[None], np.array([data.time]))
    felt = skin.felt
    if felt.lost[0]:
        raise SystemExit(felt.lost[0])
    data.xfrc_applied[body, :3] = felt.force_n[0] + [PUSH_N * (data.time > PUSH_FROM_S), 0.0, 0.0]
    mujoco.mj_step(model, data)
    if step % 250 == 249:
        moved = np.linalg.norm(felt.caps_mm[0] - skin.caps_at_rest_mm, axis=1).max()
        place = f"{20.0 - T[2, 3]:.2f} mm deep, {T[0, 3]:+.2f} mm aside"
        print(f"{data.time:.1f} s: {place}, force {felt.force_n[0].round(2)} N, largest motion of a pin {moved:.2f} mm")
