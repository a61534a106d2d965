"""A package of someone else adds a part of each kind by its entry points: built as a wheel, installed into a folder, and used."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import twin
from hardware.workcell.build import RigPlan, build_rig
from scenes import load_servo

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "tests" / "helpers" / "example_parts"
PARTS = 14  # that the package offers; one raises, and one has the name of another


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder into which the wheel is installed."""
    work = tmp_path_factory.mktemp("plugin")
    shutil.copytree(EXAMPLE, work / "source")  # a build leaves files beside its sources
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", work, work / "source"], check=True)
    (wheel,) = work.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--no-index", "--target", work / "site", wheel], check=True)
    return work / "site"


def run(installed: Path, *arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    path = os.pathsep.join(map(str, (installed, ROOT, ROOT / "tests" / "helpers")))
    return subprocess.run([sys.executable, *arguments], cwd=cwd, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)


FIRST = "import tactip_example.task, tactip_example.model, tactip_example.condition, tactip_example.arm"
PRESS = """
import numpy as np, twin
simulator = twin.Simulator(twin.load_sensor("example-tip"), quality="rasterised")
state = simulator.press(twin.load_object("example-ball"), twin.ContactPose(1.0))
simulator.render(state).save("frames")
print("force", state.force_n[2] > 0)
print("spiral", simulator.spec.pins.in_words(), len(state.caps_mm))
camera = twin.open_camera("example:frames", simulator.spec, twin.Form.RAW)
with camera: print("camera", camera.read().image.shape)

from hardware.workcell.build import RigPlan, build_rig
from scenes import load_servo
plan = RigPlan(twin.load_object("plane"), load_servo("surface"), camera="example:frames", arm="example:here")
rig = build_rig(plan, simulator.spec, twin.load_experiment("surface-2d"), form=twin.Form.RAW)
print("guard", type(rig.arm).__name__, rig.arm.name)
from hardware.servo.grip import GripPlan
from training.environments.grasp import load_grasp_policy
plan = GripPlan(simulator.spec, gripper="example:there", left="example:frames", right="example:frames", arm="example:here")
print("gripper", plan.build().gripper.name, load_grasp_policy("example-grip")({"tactile": np.zeros((2, 2, 331, 2))}))
try: twin.open_arm("nobody:")
except twin.errors.TwinError as error: print("arms", "example" in str(error))
"""
LEARN = """
made = twin.make_dataset(experiment="surface-2d", sensor="mg400-127", count=8, images="none", states="all", across=8, workers=1, out="sim")
print("model", twin.train(model="example-mean", sensor="mg400-127", data="sim", split=-1, out="run").finished)
"""
TASK = """
try: twin.train(model="example-mean", sensor="mg400-127", data="none", out="runs")
except twin.errors.TwinError as error: print("data", "none" in str(error))
twin.register_environments()
import gymnasium
print("task", gymnasium.make("tactip/ExamplePress-v0", sensor="mg400-127", observation="oracle").reset(seed=0)[0]["goal"].shape)
"""


COMMANDS = """
from core_alone import run
for command in ("doctor", "new frames --layout star:4 --out made.toml", "sensors", "robustness --list"):
    print("\\0" + "".join(run(command)[1:]), end="")
"""


@pytest.mark.parametrize(("first", "learns"), [("", True), (FIRST, False)])
def test_each_part_is_used_whatever_is_imported_first(first, learns, installed, tmp_path):
    """A model learns in one of them only. The other one has no data, and asks the commands, of which the doctor names the broken part."""
    done = run(installed, "-c", first + PRESS + (LEARN if learns else "") + TASK + ("" if learns else COMMANDS), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    used, *told = done.stdout.split("\0")
    assert used.splitlines() == [
        "force True",
        "spiral 61 pins on a spiral 61",
        "camera (320, 320)",
        "guard SafeArm example arm at here",
        "gripper example gripper at there [0.1]",
        "arms True",
        *(["model True"] if learns else []),
        "data True",
        "task (1,)",
    ]
    assert "objects of tactip-example 0.1: 'ball-10' is left out (there is another 'ball-10')" in done.stderr
    assert "'broken' is left out (RuntimeError: its maker has left)" in done.stderr
    if not learns:
        doctor, unknown, sensors, conditions = told
        parts = doctor.split("Parts of other packages\n")[1].split("\n\n")[0].splitlines()
        assert len(parts) == PARTS and sum("LEFT OUT" in line for line in parts) == 2
        assert "  arms: broken of tactip-example 0.1; LEFT OUT: RuntimeError: its maker has left" in parts
        assert "example-spiral:91" in unknown and "example-tip" in sensors and "example-haze" in conditions


def test_an_arm_without_limits_is_refused(monkeypatch):
    """An arm of another package is always behind the guard, even one that is a simulated arm."""
    monkeypatch.setattr("scenes.plugins._found", {"arms": {"bare": lambda rest: twin.open_arm("simulated")}})
    how = twin.load_experiment("surface-2d")
    with pytest.raises(twin.errors.TwinError, match="no limits are called 'bare'"):
        plan = RigPlan(twin.load_object("plane"), load_servo("surface"), camera="twin", arm="bare:here")
        build_rig(plan, twin.load_sensor("mg400-127"), how)
