"""Whether the sensor is pressed in a frame that should show no contact: motion of the pins that no camera could make."""

import numpy as np

from scenes.sensor import SensorSpec
from twin.errors import FrameError
from twin.preprocess.pipeline import Pipeline
from twin.preprocess.reference import Reference
from twin.types import Form, Frame

# Largest dent, in the rim's mean radius, of a sensor at rest. Measured: 0.0026 to 0.0041 at rest in three real sensors, 0.005 with a camera
# tilted by 2 deg; in real contacts at least 0.003 from about 1 mm on, 0.009 from 2 mm, 0.012 from 3 mm. A touch lighter than about 2 mm is
# not noticed: it moves the pins less than cameras differ.
MOST_DENT = 0.008


def dent_of(pins_px: np.ndarray, reference: Reference) -> float:
    """Largest motion of neighbouring pins that another camera cannot explain, in the rim's mean radius.

    Another place, tilt, focal length or radial distortion of the camera moves the reference, to first order, by
    ``u = t + G x + (h . x) x + k |x|^2 x``. This motion is fitted by least squares and taken away. The rest is averaged over each
    pin and its neighbours, because the tolerances of a print differ from pin to pin and shall not count.

    Parameters
    ----------
    pins_px : (N, 2) float
        NaN where lost.
    reference : Reference
    """
    rim = reference.pins_px[reference.outmost]
    middle = rim.mean(axis=0)
    radius_px = float(np.linalg.norm(rim - middle, axis=1).mean())
    place, moved = (reference.pins_px - middle) / radius_px, (pins_px - reference.pins_px) / radius_px
    seen = np.isfinite(moved[:, 0])
    x, y = place.T
    one, none, square = np.ones_like(x), np.zeros_like(x), x * x + y * y
    along_x = np.column_stack([one, none, x, y, none, none, x * x, x * y, square * x])
    along_y = np.column_stack([none, one, none, none, x, y, x * y, y * y, square * y])
    camera = np.linalg.lstsq(np.concatenate([along_x[seen], along_y[seen]]), moved[seen].T.ravel(), rcond=None)[0]
    left = moved - np.column_stack([along_x @ camera, along_y @ camera])
    around = np.column_stack([np.arange(len(left)), reference.neighbours])[seen]
    return float(np.linalg.norm(np.nanmean(left[around], axis=1), axis=1).max())


def require_untouched(spec: SensorSpec, form: Form, frame: Frame, remedy: str) -> None:
    """Refuse a frame that is meant to show no contact if its pins show one. A frame in which the pins are not found passes.

    Raises
    ------
    FrameError
        Ends with ``remedy``: what to do.
    """
    pipeline = Pipeline(spec, form, graph="delaunay")
    seen = pipeline(frame)
    if seen.valid and (dent := dent_of(seen.pins_px, pipeline.reference)) > MOST_DENT:
        raise FrameError(
            f"{frame.name or 'frame'}: the sensor seems pressed: its pins are dented by {dent:.1%} of their rim's radius from where "
            f"{spec.name} has them without contact (allowed {MOST_DENT:.1%}); {remedy}"
        )
