"""An arm's pose from its feedback port alone, while a driver holds the other ports."""

import numpy as np
import pytest

from hardware.arms.mg400_wire import FEEDBACK_PERIOD_S
from hardware.emulators.camera import FeedbackPose
from hardware.emulators.mg400 import Mg400Emulator
from hardware.errors import DeviceError
from twin.errors import OptionError


@pytest.mark.parametrize("faults", [(), ("no-fast-feedback",)])
def test_the_pose_is_the_arms_and_another_port_serves_as_well(faults):
    with (
        Mg400Emulator(port_offset=None, faults=faults) as arm,
        FeedbackPose("127.0.0.1", tuple(arm.ports[port] for port in FEEDBACK_PERIOD_S)) as pose,
    ):
        np.testing.assert_allclose(pose().pose, arm.pose(), atol=1e-6)
        assert not pose().enabled


@pytest.mark.parametrize("spec", ["mg400", "magician:/dev/ttyUSB0", "mg400:127.0.0.1:x"])
def test_what_is_no_address_is_refused(spec):
    with pytest.raises((OptionError, DeviceError), match="for example mg400:127.0.0.1"):
        FeedbackPose.of(spec)
