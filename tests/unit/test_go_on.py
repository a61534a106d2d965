"""From labels to the experiment that makes such contacts."""

import cv2
import numpy as np
import pytest

from twin.calibration.go_on import experiment_like, whole_sensor
from twin.errors import OptionError


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
    (tmp_path / "mine").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"mine/f{k}.png"), np.tile(np.arange(48, dtype=np.uint8), (40, 1)))
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
