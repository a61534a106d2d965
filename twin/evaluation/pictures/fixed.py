"""How much of what renders miss on the caps is a picture fixed to each cap, which a better relief could hold."""

import cv2
import numpy as np

from scenes.sensor import PinsSpec, ViewSpec
from twin.optics.relief import SKIN_FROM, cap_planes
from twin.types import FloatArray, ImageArray, PinState

PLACES = 19
"""Places along the diameter of a cap and its edge at which a difference is read."""


def cap_patches(view: ViewSpec, pins: PinsSpec, state: PinState, real: ImageArray, rendered: ImageArray) -> FloatArray:
    """Real less rendered gray levels (N, k) at the same places of all caps' planes, up to ``SKIN_FROM`` cap radii from their middles.

    Parameters
    ----------
    real, rendered : (H, W) or (H, W, C) uint8
        Of the same state. Of C channels the levels at the k / C places follow one another.
    """
    side = np.linspace(-SKIN_FROM, SKIN_FROM, PLACES)
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    places = places[np.linalg.norm(places, axis=1) <= SKIN_FROM]
    middle, plane = cap_planes(view, pins, state)
    at = (middle[:, None] + np.einsum("nij,pj->npi", plane, places)).astype(np.float32)
    difference = real.astype(np.float32) - rendered.astype(np.float32)
    read = cv2.remap(difference, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(read, np.float32).reshape(len(middle), -1)


def fixed_share(patches: FloatArray) -> float:
    """Share of the power of patches (M, N, k) that is the same for a cap in all M frames; without bias, so that it may be below 0.

    The mean over pairs of different frames of the product of their patches, relative to the mean square. A mean over the frames alone
    would count 1 / M of what changes from frame to frame. NaN if there is one frame, or nothing is missed.
    """
    count, values = len(patches), np.asarray(patches, float)
    power = float(np.sum(values**2))
    if count < 2 or power == 0:
        return np.nan
    return float((np.sum(values.sum(axis=0) ** 2) - power) / (count - 1) / power)
