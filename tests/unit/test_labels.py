"""Labels of flat-surface recordings and the displacement table made from them."""

import numpy as np
import pytest

from training.displacement import displacement_by_depth
from training.labels import read_surface_labels
from twin.errors import FrameError

TARGETS = "image_name,pose_2,pose_6,move_1,move_6\nframe_0.png,-3.5,10,1,2\nframe_1.png,-0.5,-5,-2,1\n"


def test_a_move_that_was_not_executed_is_taken_out_of_the_angle(tmp_path):
    (tmp_path / "targets.csv").write_text(TARGETS)
    (tmp_path / "move_executed.csv").write_text("image_name,executed_estimate\nframe_0.png,0\nframe_1.png,1\n")
    labels = read_surface_labels(tmp_path)
    assert labels.angle_deg.tolist() == [8, -5]
    assert labels.shear_mm.tolist() == [0, -2]
    assert labels.depth_mm.tolist() == [-3.5, -0.5]


def test_without_the_estimate_labels_are_as_published(tmp_path):
    (tmp_path / "targets.csv").write_text(TARGETS)
    assert read_surface_labels(tmp_path).angle_deg.tolist() == [10, -5]


def test_a_missing_column_is_named(tmp_path):
    (tmp_path / "targets.csv").write_text("image_name,pose_2\nframe_0.png,-1\n")
    with pytest.raises(FrameError, match="pose_6"):
        read_surface_labels(tmp_path)
    with pytest.raises(FrameError, match="no such file"):
        read_surface_labels(tmp_path / "missing")


def test_displacement_is_binned_by_depth_over_pure_presses_only(tmp_path):
    rows = ["image_name,pose_2,pose_6,move_1,move_6"]
    rows += [f"f{i}.png,{depth},0,{shear},0" for i, (depth, shear) in enumerate([(-3.5, 0), (-2.5, 0), (-1.5, 0), (-0.5, 0), (-0.5, 4)])]
    (tmp_path / "targets.csv").write_text("\n".join(rows) + "\n")
    rest = np.zeros((7, 2))
    pins = np.stack([rest + [scale, 0] for scale in (1.0, 2.0, 3.0, 4.0, 99.0)])
    pins[0, 3] = np.nan  # a lost pin does not count
    assert displacement_by_depth(read_surface_labels(tmp_path), pins, rest).tolist() == [1, 2, 3, 4]
