"""A TacTip in MuJoCo: a plate is laid onto the sensor and pushed aside; the sensor feels it, carries it and rubs against it.

pip install 'tactip-twin[models,mujoco]'
python in-mujoco.py
"""

import mujoco
import numpy as np

import twin

WORLD = """
<mujoco>
  <worldbody>
    <body name="tip"><site name="tip"/></body>
    <body name="plate" pos="0 0 .0255">
      <joint type="slide" axis="0 0 1"/>
      <joint type="slide" axis="1 0 0"/>
      <geom name="plate" type="box" size=".05 .05 .005" mass=".1" friction=".5"/>
    </body>
  </worldbody>
</mujoco>
"""
PUSH_FROM_S, PUSH_N = 1.0, 0.3  # sideways

scene = twin.TactileScene(mujoco.MjModel.from_xml_string(WORLD), {"tip": "mg400-331"})
for _ in range(6):
    for _ in range(250):
        scene.data.qfrc_applied[1] = PUSH_N * (scene.data.time > PUSH_FROM_S)
        scene.step()
    felt = scene.read("tip")
    moved = np.linalg.norm(felt.pins_px - scene.pipeline("tip").reference.pins_px, axis=1).max()
    print(
        f"{scene.data.time:.1f} s: {felt.geom} {felt.depth_mm:.2f} mm deep, {1e3 * scene.data.qpos[1]:+.2f} mm aside, "
        f"force {felt.force_n.round(2)} N, {felt.slip:.0%} slips, largest motion of a pin {moved:.1f} px"
    )
