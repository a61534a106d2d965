"""Numbers, addresses and names beyond all bounds: refused at once, with the range or the remedy."""

import re
import socket
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from noisy_camera import NoisyCamera

from hardware.cameras.source import open_camera
from hardware.collect.collect import CollectPlan
from hardware.emulators.camera import CameraEmulator, emulate_camera
from hardware.emulators.magician import MagicianEmulator
from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceError
from hardware.live.studio_mode import require_feed
from hardware.safety.decide import load_limits
from hardware.servo.following import FollowPlan, ServoStudyPlan, folder_name, study_servo
from scenes import SpecError, load_experiment, load_object, load_sensor, load_servo
from scenes.body import MOST_POISSON
from scenes.load import SHIPPED
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from twin.errors import ContactError, FrameError, OptionError, TwinError
from twin.evaluation.degradation.study import load_plan
from twin.frames import open_recording
from twin.frames.forms import form_of
from twin.geometry.solid import Resolution
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.one_contact import render_contact
from twin.pins import Pipeline, load_detector
from twin.types import Form

SENSOR = (SHIPPED / "sensors" / "mg400-127.toml").read_text()


@pytest.mark.parametrize("number", [float("inf"), float("nan"), 0.0, -1.0, 1e9])
def test_rates_that_are_none_are_refused_with_their_range(number):
    with pytest.raises(DeviceError, match="`time_scale` .*: expected 0.001 to 1000"):
        Mg400Emulator(time_scale=number)
    with pytest.raises(DeviceError, match="`time_scale` .*: expected 0.001 to 1000"):
        MagicianEmulator(time_scale=number)
    with pytest.raises(DeviceError, match="`rate` .*: expected 0.1 to 1000 decisions a second"):
        FollowPlan(load_object("can"), load_servo("surface"), stream_hz=number)


@pytest.mark.parametrize("arm", ["mg400", "mg400:127.0.0.1", "mg400-lenient:127.0.0.1", "magician:/dev/ttyUSB0"])
def test_a_real_arm_is_not_moved_by_drawn_frames_unless_that_is_said(arm):
    thing, servo = load_object("can"), load_servo("surface")
    with pytest.raises(OptionError, match="give the sensor's with `camera`"):
        FollowPlan(thing, servo, arm=arm)
    with pytest.raises(DeviceError, match="no arm 'magicain:/dev/ttyUSB0'; there are: mg400"):
        FollowPlan(thing, servo, arm="magicain:/dev/ttyUSB0")
    assert FollowPlan(thing, servo, arm=arm, camera="twin").camera == FollowPlan(thing, servo, arm="simulated:4").camera == "twin"


@pytest.mark.parametrize("count", [0, -1, 2_000_000_000])
def test_steps_and_contacts_beyond_all_bounds_are_refused(count):
    thing, servo = load_object("can"), load_servo("surface")
    with pytest.raises(DeviceError, match=f"`steps` {count}: expected 1 to"):
        FollowPlan(thing, servo, steps=count)
    with pytest.raises(DeviceError, match=f"`count` {count}: a collection has 1 to"):
        how = {"sensor": load_sensor("mg400-127"), "experiment": load_experiment("surface-2d")}
        CollectPlan(thing, servo, **how, camera="twin", arm="simulated", count=count)


NUMBERS = [
    (number, match.span())
    for number, line in enumerate(SENSOR.splitlines())
    for match in re.finditer(r"(?<![\w.\"])-?\d+\.?\d*(?![\w.\"])", line.partition("=")[2] and line)
    if not line.startswith("#") and match.start() > line.index("=")
]


@settings(max_examples=60, deadline=None)
@given(place=st.sampled_from(NUMBERS), value=st.sampled_from(["1e308", "-1e308", "1e-308", "9223372036854775807", "-1", "0", "1e9"]))
def test_any_number_of_a_specification_makes_a_pipeline_or_is_refused(tmp_path_factory, place, value):
    lines = SENSOR.splitlines()
    row, (start, end) = place
    lines[row] = lines[row][:start] + value + lines[row][end:]
    path = tmp_path_factory.mktemp("any") / "mine.toml"
    path.write_text("\n".join(lines))
    try:
        spec = load_sensor(path)
        with np.errstate(all="ignore"):
            Pipeline(spec, Form.RAW)
    except (SpecError, TwinError) as error:
        assert len(str(error).splitlines()) == 1


def test_a_fault_that_is_none_is_told_before_an_arm_is_looked_for():
    with pytest.raises(TwinError, match="no fault 'frosen' .did you mean frozen"):
        emulate_camera(
            "mg400:127.0.0.1:1", load_sensor("mg400-127"), load_object("plane"), load_servo("surface"), plain_light=True, faults=("frosen",)
        )


def test_an_address_of_no_machine_here_and_a_port_in_use_have_remedies_of_their_own():
    with pytest.raises(DeviceError, match=r"can't listen on 999\.1\.1\.1:\d+ .*; give an address of this machine with `host`"):
        Mg400Emulator(host="999.1.1.1").start()
    with pytest.raises(DeviceError, match=r"can't listen on 192\.0\.2\.1:\d+ .*; give an address of this machine with `host`"):
        CameraEmulator(NoisyCamera(), host="192.0.2.1").start()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(DeviceError, match=f"can't listen on 127.0.0.1:{port} .*; end what uses the port, or give another `port`"):
            CameraEmulator(NoisyCamera(), port=port).start()


@pytest.mark.parametrize("part", ["skin", "gel"])
def test_the_largest_poisson_ratio_converges_and_a_larger_one_is_refused_with_the_remedy(tmp_path, part):
    path = tmp_path / "mine.toml"
    before, _, after = SENSOR.partition(f"[{part}]")
    line = next(line for line in after.splitlines() if line.startswith("poisson_ratio"))
    for ratio in (MOST_POISSON, 0.4999999):
        path.write_text(f"{before}[{part}]{after.replace(line, f'poisson_ratio = {ratio}', 1)}")
        if ratio == MOST_POISSON:
            spec = load_sensor(path)
    with pytest.raises(SpecError, match=rf"{part}.*poisson_ratio: a contact does not converge above .*got 0.4999999"):
        load_sensor(path)
    state = SkinSolver(spec, resolution=Resolution(6)).press(load_object("plane"), ContactPose(indent_mm=0.5))
    assert state.force_n[2] > 0


@given(st.text(max_size=20) | st.sampled_from(["..", ".", "../x", "a/b", "/etc", "...", ".hidden", "a\\b", "mg400-331", "run.2"]))
def test_a_models_name_is_a_folder_below(label):
    name = folder_name(label)
    assert (PurePosixPath("/out") / name).parent == PurePosixPath("/out") and name not in (".", "..")
    assert (PureWindowsPath("C:/out") / name).parent == PureWindowsPath("C:/out")
    if label in ("mg400-331", "run.2"):
        assert name == label


@pytest.mark.parametrize("name", ["n" * 300, "n" * 5000, "n/" * 3000])
def test_what_is_no_path_at_all_is_not_there(name):
    for load in (load_sensor, load_object, load_experiment, load_servo, load_limits, load_detector, load_plan, open_recording, open_camera):
        for suffix in ("", ".toml", ".stl", ".png"):
            with pytest.raises((SpecError, TwinError)) as caught:
                load(name + suffix if load not in (load_detector, load_plan) else Path(name + suffix))
            assert len(str(caught.value).splitlines()) == 1 and str(caught.value).isprintable()


def test_a_mistyped_run_gets_the_nearest_name(tmp_path):
    (tmp_path / "first_run").mkdir()
    (tmp_path / "first_run" / "config.json").write_text("{}")
    for name, near in (("mg400-13", "mg400-331|mg400-127"), (str(tmp_path / "frist_run"), f"{tmp_path}/first_run")):
        with pytest.raises(TrainingError, match=f"holds no trained model: did you mean '({near})'"):
            PoseEstimator.load(name)
    for name in (tmp_path / "nothing_like_it", tmp_path / "nowhere" / "mg400-127"):
        with pytest.raises(TrainingError, match="'twin train' writes one"):
            PoseEstimator.load(name)


def test_an_object_above_the_sensor_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(ContactError, match="`indent_mm` -1: .*give 0 for no contact"):
        render_contact(load_sensor("mg400-127"), load_object("plane"), ContactPose(indent_mm=-1.0), tmp_path / "out")


def test_a_camera_an_arm_and_a_recording_of_the_studio_are_looked_at_before_its_page_opens(tmp_path):
    spec = load_sensor("mg400-127")
    for asked in (("nowhere", "", ""), ("", "nowhere", ""), ("", "", "nowhere")):
        with pytest.raises(TwinError, match="nowhere"):
            require_feed(*asked, spec)
    require_feed("", "", str(tmp_path), spec)


def test_a_study_of_servos_in_which_nothing_moved_fails_with_the_first_reason(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise ContactError("out of reach")

    monkeypatch.setattr("hardware.servo.following.follow", fail)
    plan = ServoStudyPlan({"a": None}, (load_object("can"), load_object("square")), load_servo("surface"))
    with pytest.raises(TwinError, match="none of 2 runs made a step; the first: out of reach"):
        study_servo(plan, tmp_path / "out")


def test_frames_of_another_form_are_refused_without_the_name_of_an_option():
    with pytest.raises(FrameError, match="f.png: expected 640x480 .raw form. of mg400-127, got 256x256 .processed form.") as caught:
        form_of(np.zeros((256, 256), np.uint8), "f.png", load_sensor("mg400-127"), Form.RAW)
    assert "--" not in str(caught.value), "twin predict has no --form"
