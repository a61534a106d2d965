"""Records opened by the readers of others: LeRobot, Hugging Face's datasets, and the MCAP and ROS 2 readers on PyPI.

``TACTIP_LEROBOT`` names a Python in whose environment ``lerobot`` is installed: it is too heavy to be installed for a test.
"""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from made_records import ABOUT, T_TOOL_SENSOR, made_episode
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from twin.records import CHANNELS, open_writer
from twin.records.record import IMAGE, TIME

EPISODES = [made_episode(seed, 3 + seed) for seed in range(3)]
STEPS = [step for episode in EPISODES for step in episode.steps()]
TASKS = [episode.task for episode in EPISODES for _ in episode.steps()]
INSTALL_S, READ_S = 180, 300


@pytest.fixture(params=[True, False], ids=["a file for each", "files of several"])
def written(request, tmp_path):
    """Writes the episodes in a format; gives the folder."""

    def write(to, **options):
        with open_writer(tmp_path / to, to, ABOUT, 10, at_once=request.param, **options) as writer:
            writer.write(iter(EPISODES))
        return tmp_path / to

    return write


def read_with(python, source, *arguments, tmp_path):
    """What a script of another environment prints as JSON."""
    own = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    home = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hf"), "HOME": str(tmp_path)}
    done = subprocess.run(
        [python, "-c", source, *map(str, arguments)], capture_output=True, text=True, timeout=READ_S, env=own | home, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def lerobot():
    python = os.environ.get("TACTIP_LEROBOT")
    if not python:
        pytest.skip("TACTIP_LEROBOT names no Python with lerobot")
    return python


LEROBOT = """
import json, sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("local/records", root=sys.argv[1], video_backend="pyav", delta_timestamps={"action": [-0.1, 0.0]})
rows = [data[k] for k in range(len(data))]
plain = lambda value: None if not np.isfinite(value) else float(value)
found = {
    "frames": len(data), "episodes": data.num_episodes, "fps": data.fps, "tasks": [row["task"] for row in rows],
    "levels": [float((255 * row["observation.images.tactip"]).round().sum()) for row in rows],
    "numbers": {
        key: [[plain(v) for v in row[key].reshape(-1).tolist()] for row in rows]
        for key in rows[0] if key.startswith("observation.") and "images" not in key
    },
    "action": [[plain(v) for v in row["action"][1].tolist()] for row in rows],
    "before": [bool(row["action_is_pad"][0]) for row in rows],
    "stats": sorted(data.meta.stats),
}
print(json.dumps(found))
"""


@pytest.mark.slow
def test_lerobot_reads_its_own_format(written, lerobot, tmp_path):
    found = read_with(lerobot, LEROBOT, written("lerobot"), tmp_path=tmp_path)
    assert (found["frames"], found["episodes"], found["fps"], found["tasks"]) == (len(STEPS), 3, 10, TASKS)
    assert found["levels"] == [3.0 * step.image.sum() for step in STEPS]
    for name, channel in ((name, CHANNELS[name]) for name in ABOUT.numbers):
        read = found["action"] if name == "action" else found["numbers"][channel.column]
        np.testing.assert_array_equal(np.array(read, float), [step.values[name].ravel() for step in STEPS])
    np.testing.assert_allclose(np.ravel(found["numbers"][TIME]), [step.time_s for step in STEPS], atol=1e-6)  # PyTorch's 32 bits
    assert found["before"] == [k == 0 for episode in EPISODES for k in range(episode.length)]
    assert set(found["stats"]) >= {IMAGE, "action", "observation.state", "timestamp"}


@pytest.mark.slow
def test_lerobot_reads_a_video(written, lerobot, tmp_path):
    found = read_with(lerobot, LEROBOT, written("lerobot", video=True), tmp_path=tmp_path)
    assert found["frames"] == len(STEPS)
    np.testing.assert_allclose(found["levels"], [3.0 * step.image.sum() for step in STEPS], rtol=0.1)


PICTURES = """
import json, sys
import datasets, numpy as np
found = []
for source in (dict(path="imagefolder", data_dir=sys.argv[1] + "/data"), dict(path=sys.argv[1])):
    rows = list(datasets.load_dataset(**source)["train"])
    found.append([{k: v if k != "image" else int(np.asarray(v).astype(int).sum()) for k, v in row.items()} for row in rows])
print(json.dumps(found))
"""


@pytest.mark.slow
def test_datasets_reads_the_pictures_with_their_metadata(written, lerobot, tmp_path):
    for rows in read_with(lerobot, PICTURES, written("huggingface"), tmp_path=tmp_path):
        rows.sort(key=lambda row: (row["episode_index"], row["frame_index"]))
        assert [row["image"] for row in rows] == [int(step.image.sum()) for step in STEPS]
        assert [row["task"] for row in rows] == TASKS
        for name, channel in ((name, CHANNELS[name]) for name in ABOUT.numbers):
            np.testing.assert_array_equal(np.array([row[channel.column] for row in rows], float), [step.values[name] for step in STEPS])


ROSBAGS = """
import json, sys
from pathlib import Path
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
store = get_typestore(Stores.ROS2_HUMBLE)
found = []
with AnyReader([Path(sys.argv[1])]) as bag:
    for connection, time_ns, raw in bag.messages():
        message = store.deserialize_cdr(raw, connection.msgtype)  # by ROS's own definition, not by the file's
        text = {"/tactip/arm_pose": lambda m: [m.twist.linear.x, m.twist.angular.z], "/tactip/wrench": lambda m: [m.wrench.torque.x],
                "/tf": lambda m: [m.transforms[0].transform.translation.x], "/tactip/pins": lambda m: [float(m.data[-1])]}
        if connection.topic in text:
            found.append([connection.topic, time_ns, text[connection.topic](message)])
print(json.dumps(found))
"""


@pytest.mark.slow
def test_rosbags_reads_the_messages_by_ros_own_definitions(tmp_path):
    packages = tmp_path / "packages"
    command = [sys.executable, "-m", "pip", "install", "-q", "--target", str(packages), "rosbags"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALL_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        pytest.skip(f"can't install rosbags: {error}")
    if done.returncode:
        pytest.skip(f"can't install rosbags: {done.stderr.strip().splitlines()[-1:]}")
    with open_writer(tmp_path / "bags", "mcap", ABOUT, 10) as writer:
        writer.write(iter(EPISODES[:1]))
    source = f"import sys; sys.path.insert(0, {str(packages)!r})\n{ROSBAGS}"
    found = read_with(sys.executable, source, tmp_path / "bags" / "episode_000000.mcap", tmp_path=tmp_path)
    steps = list(EPISODES[0].steps())
    for topic, number in {
        "/tactip/arm_pose": lambda step: [step.values["pose"][0], step.values["pose"][5]],
        "/tactip/wrench": lambda step: [step.values["wrench"][3] / 1000],
        "/tf": lambda step: [step.values["pose"][0] / 1000],
        "/tactip/pins": lambda step: [step.values["pins"][-1, -1]],
    }.items():
        read = [(time_ns, values) for name, time_ns, values in found if name == topic]
        assert [time_ns for time_ns, _ in read] == [round(1e9 * EPISODES[0].started_s) + round(1e9 * step.time_s) for step in steps]
        np.testing.assert_allclose([values for _, values in read], [number(step) for step in steps], rtol=1e-6)


def test_the_mcap_and_ros_2_readers_see_frames_and_axes(tmp_path):
    with open_writer(tmp_path / "bags", "mcap", ABOUT, 10) as writer:
        writer.write(iter(EPISODES[:1]))
    (step, *_) = EPISODES[0].steps()
    with (tmp_path / "bags" / "episode_000000.mcap").open("rb") as file:
        messages = {}
        for schema, channel, _, ros in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            messages.setdefault(channel.topic, (schema.name, ros))
    kinds = {topic: kind.rpartition("/")[2] for topic, (kind, _) in messages.items()}
    assert kinds == {
        "/tactip/image/compressed": "CompressedImage",
        "/tactip/pins": "Float32MultiArray",
        "/tactip/arm_pose": "TwistStamped",
        "/tactip/move": "TwistStamped",
        "/tactip/command": "TwistStamped",
        "/tactip/pose": "TwistStamped",
        "/tactip/wrench": "WrenchStamped",
        "/tactip/contact": "Int8",
        **{f"/tactip/{name}": "Float32MultiArray" for name in ("estimate", "estimate_low", "estimate_high")},
        "/tf": "TFMessage",
        "/tf_static": "TFMessage",
    }
    (moving,), (fixed,) = (messages[topic][1].transforms for topic in ("/tf", "/tf_static"))
    frames = [(each.header.frame_id, each.child_frame_id) for each in (moving, fixed)]
    assert frames == [("base", "tactip_tool"), ("tactip_tool", "tactip_sensor")]
    turn = Rotation.from_quat([getattr(fixed.transform.rotation, axis) for axis in "xyzw"])
    np.testing.assert_allclose(turn.as_matrix(), T_TOOL_SENSOR[:3, :3], atol=1e-12)
    place = [getattr(fixed.transform.translation, axis) for axis in "xyz"]
    np.testing.assert_allclose(place, T_TOOL_SENSOR[:3, 3] / 1000)
    turn = Rotation.from_quat([getattr(moving.transform.rotation, axis) for axis in "xyzw"])
    expected = Rotation.from_euler("xyz", step.values["pose"][3:].astype(float), degrees=True)
    np.testing.assert_allclose(turn.as_matrix(), expected.as_matrix(), atol=1e-9)
    pose = messages["/tactip/pose"][1].twist  # depth and shear in mm, as the public stack has them
    assert pose.linear.y == step.values["estimate"][0] and np.isnan(pose.linear.x)
