"""``lerobot-record`` itself on the emulated rig: ten episodes, and the data set loads.

``TACTIP_LEROBOT`` names a Python in whose environment ``lerobot`` is installed: it is too heavy to be installed for a test.
"""

import json
import os
import subprocess
import sysconfig
from pathlib import Path

import numpy as np
import pytest
from endurance import SENSOR, Bench

from scenes import load_sensor
from twin.frames.forms import frame_size
from twin.types import Form

EPISODES, RATE_HZ, EPISODE_S = 10, 10, 1.5
RECORD_S = 500
START_MM, SWING_MM = (250.0, 0.0, 0.0, 0.0), 20.0  # where the arm is led, and how far to each side

# A plug-in as LeRobot finds them: a distribution whose name begins with lerobot_robot_. It only registers what the project has.
PLUGIN = """
import math, time
from dataclasses import dataclass, field
from lerobot.robots import RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from hardware.live.lerobot import LeRobotArm, LeRobotArmConfig

@RobotConfig.register_subclass("tactip_arm")
@dataclass(kw_only=True)
class TactipArmConfig(RobotConfig):
    arm: str
    camera: str
    sensor: str

class TactipArm(LeRobotArm):
    def __init__(self, config):
        cameras = {{"tactip": config.camera}}
        super().__init__(LeRobotArmConfig(arm=config.arm, cameras=cameras, sensor=config.sensor, max_age_ms=5000, id=config.id))

@TeleoperatorConfig.register_subclass("swing")
@dataclass(kw_only=True)
class SwingConfig(TeleoperatorConfig):
    pass

class Swing(Teleoperator):
    config_class, name = SwingConfig, "swing"
    action_features = dict.fromkeys(("x", "y", "z", "rz"), float)
    feedback_features, is_connected, is_calibrated = {{}}, True, True
    def connect(self, calibrate=True): pass
    def calibrate(self): pass
    def configure(self): pass
    def send_feedback(self, feedback): pass
    def disconnect(self): pass
    def get_action(self):
        x, y, z, rz = {start}
        return {{"x": x, "y": y + {swing} * math.sin(2 * time.monotonic()), "z": z, "rz": rz}}
"""
MAIN = """
import site, sys
site.addsitedir({libraries!r})  # what the project needs; LeRobot's own versions come first
from lerobot.scripts.lerobot_record import main
main()
"""
READ = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("local/swing", root=sys.argv[1], video_backend="pyav")
rows = [data[k] for k in range(len(data))]
print(json.dumps({
    "episodes": data.num_episodes, "lengths": list(data.meta.episodes["length"]), "shape": list(rows[0]["observation.images.tactip"].shape),
    "state": [row["observation.state"].tolist() for row in rows], "action": [row["action"].tolist() for row in rows],
    "names": data.meta.features["observation.state"]["names"], "levels": [float(row["observation.images.tactip"].std()) for row in rows],
}))
"""


@pytest.mark.slow
def test_lerobot_record_makes_ten_episodes_on_the_emulated_rig(tmp_path):
    python = os.environ.get("TACTIP_LEROBOT")
    if not python:
        pytest.skip("TACTIP_LEROBOT names no Python with lerobot")
    plugin = tmp_path / "plugin"
    (plugin / "lerobot_robot_tactip-1.0.dist-info").mkdir(parents=True)
    (plugin / "lerobot_robot_tactip-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: lerobot_robot_tactip\nVersion: 1.0\n"
    )
    (plugin / "lerobot_robot_tactip.py").write_text(PLUGIN.format(start=START_MM, swing=SWING_MM))
    home = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hf"), "HOME": str(tmp_path)}
    environment = os.environ | home | {"PYTHONPATH": os.pathsep.join([str(plugin), str(Path(__file__).parents[2])])}
    with Bench(0) as bench:
        dataset = {
            "repo_id": "local/swing",
            "root": str(tmp_path / "data"),
            "single_task": "swing",
            "fps": RATE_HZ,
            "num_episodes": EPISODES,
            "episode_time_s": EPISODE_S,
            "reset_time_s": 0.2,
            "video": "true",  # with false it leaves the pictures out
            "vcodec": "h264",
            "push_to_hub": "false",
        }
        options = [f"--dataset.{key}={value}" for key, value in dataset.items()]
        robot = [f"--robot.arm={bench.address}", f"--robot.camera={bench.url}", f"--robot.sensor={SENSOR}"]
        main = MAIN.format(libraries=sysconfig.get_paths()["purelib"])
        command = [python, "-c", main, "--robot.type=tactip_arm", *robot, "--teleop.type=swing", "--play_sounds=false", *options]
        done = subprocess.run(command, capture_output=True, text=True, timeout=RECORD_S, env=environment, cwd=tmp_path)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    read = subprocess.run([python, "-c", READ, tmp_path / "data"], capture_output=True, text=True, timeout=RECORD_S, env=os.environ | home)
    assert read.returncode == 0, read.stderr[-3000:]
    found = json.loads(read.stdout.splitlines()[-1])
    width, height = frame_size(load_sensor(SENSOR), Form.RAW)
    assert found["episodes"] == EPISODES and min(found["lengths"]) >= 3 and found["shape"] == [3, height, width]
    assert found["names"][:4] == ["x", "y", "z", "rz"] and min(found["levels"]) > 0.01
    y_mm = np.array(found["state"])[:, 1]
    assert np.ptp(y_mm) > SWING_MM and np.abs(y_mm).max() < 1.1 * SWING_MM  # the arm follows
    assert np.ptp(np.array(found["action"])[:, 1]) > SWING_MM
