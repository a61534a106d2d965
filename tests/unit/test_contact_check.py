"""What ``twin check`` says about the contacts in frames."""

import numpy as np
import pytest

from scenes import load_sensor
from training.studies.contact_check import contact_finding
from twin.errors import TwinError
from twin.frames import evenly_read, open_recording
from twin.pins.check import Grade
from twin.types import Form, Frame


def test_a_sensor_without_weights_has_no_finding():
    assert contact_finding([Frame(np.zeros((480, 640), np.uint8), Form.RAW)], load_sensor("pad-round")) is None


@pytest.mark.real
def test_one_torn_frame_in_twenty_is_named(real_dir):
    frames = evenly_read(open_recording(real_dir / "tac-vgnn-331"), 20)
    assert contact_finding(frames, load_sensor("mg400-331")).verdict is Grade.HEALTHY
    torn = frames[7].image.copy()
    torn[len(torn) // 2 :] = np.roll(torn[len(torn) // 2 :], 4, 1)
    frames[7] = Frame(torn, frames[7].form, frames[7].name)
    found = contact_finding(frames, load_sensor("mg400-331"))
    assert found.verdict is Grade.DEGRADED and f"{frames[7].name}: torn frame" in found.text and "19 of 20" in found.text
    with pytest.raises(TwinError):
        contact_finding(frames, load_sensor("mg400-127"), "mg400-331")
