"""How late and how often the streamed loop decides on the emulated rig, against an older version of this program in the same run.

Run ``python tests/bench/bench_servo_timing.py [--baseline FOLDER]`` with the project on the path; FOLDER is a checkout of the version to
compare with, such as ``git worktree add /tmp/before 1266b7c``, the last one before arms were watched while the loop works. With --ros2
frames and estimates are published as ROS 2 topics, and another process reads all of them (set ROS_LOCALHOST_ONLY=1). Both emulators
are in processes of their own. The estimator answers at once, so what is measured is the loop, the drivers and the two streams. The two
versions take turns, so that other work on the machine meets both.
"""

import argparse
import json
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np

ROOT = Path(__file__).parents[2]
STEPS, RATE_HZ, CAMERA_HZ = 80, 30.0, 60.0
TURNS = 4  # of each version
ARM = """
import sys
from hardware.emulators.mg400 import Mg400Emulator
with Mg400Emulator(port_offset=None, time_scale=4.0) as arm:
    print(*(arm.ports[port] for port in (29999, 30003, 30004, 30005)), flush=True)
    sys.stdin.read()
"""
CAMERA = f"""
import sys
from hardware.emulators.camera import CameraEmulator
from noisy_camera import NoisyCamera
with CameraEmulator(NoisyCamera(fps={CAMERA_HZ}, color=True)) as camera:
    print(camera.url, flush=True)
    sys.stdin.read()
"""

READER = """
from threading import Thread
from hardware.ros2.dds import Participant
from hardware.workcell.ros2 import SENSOR_TOPICS, TOPICS
participant = Participant()
def read(reader):
    while True:
        reader.take()
for topic, kind in (SENSOR_TOPICS | TOPICS).items():
    Thread(target=read, args=(participant.reader(topic if topic[0] == "/" else f"/bench/{topic}", kind),)).start()
print("reading", flush=True)
"""


def once(ros2: bool = False) -> dict[str, float]:
    """Run the loop of the version that is on the path."""
    from hardware.arms.mg400 import MG400, Mg400Ports
    from hardware.cameras.mjpeg import MjpegCamera
    from hardware.rig.geometry import PlacedObject
    from hardware.safety.decide import load_limits
    from hardware.safety.safe_arm import SafeArm
    from hardware.servo.loop import LoopHooks, LoopSettings, ServoLoop
    from hardware.workcell.build import Rig
    from scenes import load_experiment, load_object, load_sensor, load_servo
    from twin.pins import Pipeline
    from twin.rig.kinematics import Mounting
    from twin.types import Form

    servo = load_servo("surface")
    placed = PlacedObject(load_object("plane"), servo.placement, Mounting.of(load_sensor("mg400-331"), load_experiment(servo.experiment)))
    mounting = placed.mounting
    value = np.array(mounting.labels(servo.indent_mm, servo.angle_deg))
    names = (mounting.depth_label, mounting.angle_label)

    def estimator(frame: object) -> SimpleNamespace:
        return SimpleNamespace(names=names, value=value, low=value, high=value, units=("mm", "deg"), valid=True, reason="", seen=None)

    codes = (ARM, CAMERA, READER) if ros2 else (ARM, CAMERA)
    children = [subprocess.Popen([sys.executable, "-c", code], stdin=-1, stdout=-1, text=True) for code in codes]
    try:
        ports, url, *_ = (child.stdout.readline().split() for child in children)
        dashboard, motion, *feedback = map(int, ports)
        arm = SafeArm(MG400("127.0.0.1", ports=Mg400Ports(dashboard, motion, tuple(feedback))), load_limits("mg400"))
        with Rig(MjpegCamera(url[0], None, Form.RAW), arm, placed, True) as rig:
            rig.source.read(timeout_s=10.0)
            settings = LoopSettings(STEPS, blocking=False, period_s=1.0 / RATE_HZ)
            loop = ServoLoop(rig, servo, estimator, settings)
            with ExitStack() as opened:
                if ros2:
                    publish = opened.enter_context(rig.publishing("bench", Pipeline(load_sensor("mg400-331"), Form.RAW)))
                    loop.hooks = LoopHooks(on_estimate=publish)
                timing = loop.run(placed.start_pose(servo.indent_mm))
    finally:
        for child in children:
            child.kill()
            child.wait()
    late, age = timing.latency_s, timing.age_s
    return {"median_ms": 1e3 * late.p50, "p95_ms": 1e3 * late.p95, "age_ms": 1e3 * age.p50, "decided_hz": timing.decided_hz}


def run_of(folder: Path, *more: str) -> dict[str, float]:
    """``once`` with the version in a folder."""
    path = os.pathsep.join(str(folder / part) for part in ("", "tests", "tests/helpers"))
    command = [sys.executable, str(Path(__file__).resolve()), "--once", *more]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False, cwd=folder)
    if done.returncode:
        raise SystemExit(f"{folder}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure, and print a table with the ratio to the baseline."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--baseline", type=Path, help="checkout of the version to compare with")
    options.add_argument("--once", action="store_true", help="one run of the version on the path, as JSON")
    options.add_argument("--ros2", action="store_true", help="publish ROS 2 topics, which another process reads")
    given = options.parse_args()
    if given.once:
        print(json.dumps(once(given.ros2)))
        return
    versions = {"now": ROOT} | ({"baseline": given.baseline} if given.baseline else {})
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in versions}
    for _ in range(TURNS):
        for name, folder in versions.items():
            runs[name].append(run_of(folder, *(["--ros2"] if given.ros2 and folder == ROOT else [])))
    found = {name: {key: float(np.median([run[key] for run in each])) for key in each[0]} for name, each in runs.items()}
    print(f"{STEPS} steps asked for at {RATE_HZ:g} Hz, camera {CAMERA_HZ:g} Hz; medians of {TURNS} runs each, taking turns")
    for name, each in found.items():
        said = f"exposure to command {each['median_ms']:.1f} ms (median), {each['p95_ms']:.1f} ms (95 %)"
        print(f"{name}: {said}; age at the decision {each['age_ms']:.1f} ms; {each['decided_hz']:.1f} decisions/s")
    if given.baseline:
        print("ratio: " + ", ".join(f"{key} {found['now'][key] / found['baseline'][key]:.2f}" for key in found["now"]))


if __name__ == "__main__":
    main()
