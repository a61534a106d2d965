"""A camera that shows a sensor's pins, and a model of that sensor for the studio."""

from types import SimpleNamespace

import numpy as np
from drawn_frames import cap_radii_px, drawn_frame
from noisy_camera import NoisyCamera
from true_estimator import TrueEstimate

from hardware.cameras.reader import DevicePicture
from scenes import load_sensor
from twin.pins import Pipeline, nominal_reference
from twin.types import Form


class Switched(NoisyCamera):
    """A camera that can be switched off, or be given one picture to repeat."""

    off, picture = False, None

    def _grab(self):
        while self.off and not self._end.wait(0.01):
            pass
        made = super()._grab()
        return made if self.picture is None else DevicePicture(self.picture, made.time_s)


SENSOR = load_sensor("mg400-331")
AT_REST = nominal_reference(SENSOR, Form.RAW).pins_px


def shows(pins_px):
    """A camera of frames with pins (N, 2)."""
    source = Switched(fps=60)
    source.notices_still = False
    source.picture = drawn_frame(SENSOR, Form.RAW, pins_px, radius_px=cap_radii_px(SENSOR, Form.RAW)[: len(pins_px)]).image
    return source


class StudioModel(SimpleNamespace):
    """A model of the sensor for the studio."""

    sensor, form, check = load_sensor("mg400-331"), Form.RAW, lambda *_: None

    @property
    def pipeline(self):
        return Pipeline(self.sensor, self.form)

    def seeking_rest(self):
        return self

    def __call__(self, frame):
        return TrueEstimate(("pose_2",), *np.zeros((3, 1)))
