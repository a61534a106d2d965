"""A LeRobot data set is a recording: its tables are the labels, and its pictures, in tables or videos, the frames."""

import json
from unittest.mock import patch

import numpy as np
import pytest
from made_records import ABOUT, COLOUR, made_episode

from twin.errors import FrameError, TwinError
from twin.frames import frames_at, open_recording
from twin.records import open_writer

STEPS = 3


def written(folder, about=ABOUT, **options):
    episodes = [made_episode(seed, STEPS, about) for seed in range(2)]
    with open_writer(folder, "lerobot", about, 10, **options) as writer:
        writer.write(iter(episodes))
    return folder, [step for episode in episodes for step in episode.steps()]


@pytest.mark.parametrize("about", [ABOUT, COLOUR], ids=["gray", "colour"])
@pytest.mark.parametrize("at_once", [True, False])
def test_frames_and_labels_are_those_that_were_written(tmp_path, about, at_once):
    folder, steps = written(tmp_path / "set", about, at_once=at_once)
    found = open_recording(folder)
    assert len(found) == 2 * STEPS and found.size_px == about.size_px and found.names[STEPS] == "episode-000001-frame-000000"
    for frame, step in zip(found, steps, strict=True):
        np.testing.assert_array_equal(frame.image, step.image)
    np.testing.assert_array_equal(found.read(4).image, steps[4].image)
    assert any(np.array_equal(found.reference.image, made_episode(seed, STEPS, about).rest) for seed in range(2))
    for k in range(6):
        np.testing.assert_allclose(found.labels[f"pose_{k + 1}"], [step.values["pose"][k] for step in steps])
        if "move" in about.numbers:
            np.testing.assert_allclose(found.labels[f"move_{k + 1}"], [step.values["move"][k] for step in steps])


def test_pictures_in_videos_are_read_too(tmp_path):
    folder, steps = written(tmp_path / "set", video=True)
    found = open_recording(folder)
    images = [frame.image.astype(float) for frame in found.some({1, STEPS + 1})]
    for image, step in zip(images, (steps[1], steps[STEPS + 1]), strict=True):
        gray = image if image.ndim == 2 else image.mean(axis=2)
        assert np.corrcoef(gray.ravel(), step.image.ravel())[0, 1] > 0.9  # a video loses detail


def test_what_cannot_be_read_says_so(tmp_path):
    folder, _ = written(tmp_path / "set")
    with patch.dict("sys.modules", {"pyarrow": None, "pyarrow.parquet": None}), pytest.raises(TwinError, match="pip install"):
        open_recording(folder)
    other = tmp_path / "labels.csv"
    other.write_text("image_name,pose_1\na.png,1\n")
    with pytest.raises(FrameError, match="holds its own labels"):
        open_recording(frames_at(folder, other))
    assert len(open_recording(frames_at(folder, folder))) == 2 * STEPS, "the data set may be named as the table, too"
    info = json.loads((folder / "meta" / "info.json").read_text())
    for changed, message in (
        ({"codebase_version": "v2.1"}, "only version 3"),
        ({"features": {}}, "without pictures"),
        ({"total_episodes": 0}, "without frames"),
    ):
        (folder / "meta" / "info.json").write_text(json.dumps(info | changed))
        with pytest.raises(FrameError, match=message):
            open_recording(folder)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    (data,) = folder.glob("data/*/*.parquet")
    data.write_bytes(data.read_bytes()[:200])
    with pytest.raises(FrameError, match="damaged"):
        open_recording(folder)
