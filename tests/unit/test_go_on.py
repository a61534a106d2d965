"""From labels to the experiment that makes such contacts, and from a live camera to a folder of frames."""

import cv2
import numpy as np
import pytest

from hardware.collect.gather import gather_frames
from hardware.errors import DeviceError
from twin.calibration.go_on import experiment_like, whole_sensor
from twin.errors import OptionError
from twin.frames import open_recording
from twin.types import Form, Frame


def varying(*names: str, count: int = 20) -> dict[str, np.ndarray]:
    """A table in which these labels vary and all others are zero."""
    every = [f"{kind}_{axis}" for kind in ("pose", "move") for axis in range(1, 7)]
    return {name: np.linspace(-2, 2, count) if name in names else np.zeros(count) for name in every}


@pytest.mark.parametrize(
    ("labels", "name"),
    [
        (("pose_2", "pose_6", "move_1", "move_6"), "surface-2d"),
        (("pose_3", "pose_4", "pose_5"), "surface-3d"),
        (("pose_3", "pose_4", "pose_5", "move_1", "move_2", "move_6"), "surface-3d-tool"),
        (("pose_3", "pose_4", "pose_5", "move_1", "move_2", "move_4", "move_5", "move_6"), "surface-3d-sheared"),
    ],
)
def test_a_table_tells_how_its_contacts_were_made(labels, name):
    assert experiment_like(varying(*labels)).name == name


def test_a_table_like_no_experiment_is_refused_with_the_labels_that_vary():
    with pytest.raises(OptionError, match="pose_1, pose_4.*`experiment`"):
        experiment_like(varying("pose_1", "pose_4"))
    with pytest.raises(OptionError, match="no label of a contact varies"):
        experiment_like(varying())


def test_labels_of_unknown_contacts_are_refused_before_anything_is_written(tmp_path):
    Frames(tmp_path / "mine").written(3)
    (tmp_path / "mine" / "labels.csv").write_text("image_name,pose_1,pose_4\nf0.png,1,2\nf1.png,2,3\nf2.png,3,1\n")
    with pytest.raises(OptionError, match="no experiment has contacts"):
        whole_sensor(tmp_path / "mine", tmp_path / "mine.toml", labels=tmp_path / "mine" / "labels.csv")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine"]


def test_light_is_not_sought_in_thresholded_frames(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    for k in range(2):
        cv2.imwrite(str(folder / f"f{k}.png"), np.where(np.indices((60, 80)).sum(axis=0) % 9 < 3, 255, 0).astype(np.uint8))
    with pytest.raises(OptionError, match="thresholded frames.*leave out `optics`"):
        whole_sensor(folder, tmp_path / "mine.toml", optics=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine"]


class Frames:
    """A camera whose picture changes with each frame, or stays."""

    name, form = "a camera", Form.RAW

    def __init__(self, folder, *, frozen: bool = False) -> None:
        self.folder, self._frozen, self.read_frames, self.open = folder, frozen, 0, False

    def connect(self) -> None:
        self.open = True

    def disconnect(self) -> None:
        self.open = False

    def read(self, *, timeout_s: float = 1.0) -> Frame:
        assert self.open
        self.read_frames += 1
        shift = 0 if self._frozen else self.read_frames
        return Frame(np.roll(np.tile(np.arange(48, dtype=np.uint8), (40, 1)), shift, axis=1), Form.RAW)

    def written(self, count: int) -> None:
        from twin.frames.images import write_image

        self.connect()
        self.folder.mkdir()
        for k in range(count):
            write_image(self.folder / f"f{k}.png", self.read().image)


def test_a_camera_s_frames_become_a_recording_with_its_no_contact_frame(tmp_path):
    source, told, slept = Frames(tmp_path), [], []
    folder = gather_frames(source, tmp_path / "mine-frames", count=5, every_s=0.5, say=told.append, sleep=slept.append)
    recording = open_recording(folder)
    assert len(recording) == 4 and recording.reference is not None and recording.reference.name == "init_0.png"
    assert not source.open and slept == [1.0, 0.5, 0.5, 0.5, 0.5]
    assert "free of contact" in told[0] and "press" in told[1]
    gather_frames(source, folder, count=3, say=told.append, sleep=slept.append)
    assert len(open_recording(folder)) == 2  # not mixed with those of before


def test_a_frozen_camera_is_named_and_let_go(tmp_path):
    source = Frames(tmp_path, frozen=True)
    with pytest.raises(DeviceError, match="all 3 frames of the camera are the same"):
        gather_frames(source, tmp_path / "mine-frames", count=3, say=lambda line: None, sleep=lambda s: None)
    assert not source.open
