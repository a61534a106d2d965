"""How alike two frames are: the field's two full-reference measures."""

from dataclasses import dataclass

import numpy as np
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from twin.errors import FrameError


@dataclass(frozen=True)
class Similarity:
    """Structural similarity (Wang et al. 2004; 1: identical) and peak signal-to-noise ratio, dB."""

    ssim: float
    psnr_db: float


def frame_similarity(rendered: np.ndarray, recorded: np.ndarray) -> Similarity:
    """Compare two frames of the same form and size.

    Parameters
    ----------
    rendered, recorded : (H, W) or (H, W, 3) uint8

    Raises
    ------
    FrameError
        If they differ in shape or are not 8-bit.
    """
    if rendered.shape != recorded.shape or rendered.dtype != np.uint8 or recorded.dtype != np.uint8:
        raise FrameError(
            f"can't compare {rendered.dtype} {rendered.shape} with {recorded.dtype} {recorded.shape}; give two 8-bit frames of one form"
        )
    channel_axis = 2 if rendered.ndim == 3 else None
    ssim = structural_similarity(rendered, recorded, channel_axis=channel_axis)
    same = np.array_equal(rendered, recorded)
    return Similarity(float(ssim), float("inf") if same else float(peak_signal_noise_ratio(recorded, rendered)))
