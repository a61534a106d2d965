"""No model is sure of a wrong pose: real frames changed as cameras, cables and hands change them, given to the shipped weights.

Small changes must stay valid and right: ``changed_views``.
"""

import pytest
from changed_views import CASES, FRAMES, count_changes

MOST_WRONG = 1  # of FRAMES, for every change
LEAST_RIGHT = 0.95  # valid and not confidently wrong, for small changes
KNOWN_FAILURES = {
    ("331, no frame at rest", "flipped"): "by contacts alone a mirrored picture looks like another unit: 4 of 30; a note says so",
    ("plate", "keystone"): "2 of 30",
    ("plate, shear", "mirrored frame"): "3 of 30: a mirrored contact is one that the plate makes, too",
    ("edge", "hole"): "a hole where the edge is: 2 of 30",
    ("plate, shear", "view 2 px"): "frames of 128 px that are interpolated again: 2 of 30 are refused",
    ("plate, shear", "view 1 %"): "the same: 6 of 30",
    ("edge", "view 1 %"): "the same: 2 of 30",
    ("edge, shear", "view 1 %"): "the same: 3 of 30",
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_no_changed_frame_gets_a_narrow_wrong_pose(case, real_dir):
    failed = []
    for name, change, found in count_changes(case, real_dir):
        bad = found.wrong > MOST_WRONG or (change.small and found.right < LEAST_RIGHT * FRAMES)
        if bad and (case, name) not in KNOWN_FAILURES:
            failed.append((name, found))
    assert not failed
