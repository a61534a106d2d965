"""Comparison of a real frame with its render, pixel by pixel, over the lens disc.

The figures are PSNR, SSIM (Wang et al. 2004, computed by scikit-image) and FLIP (Andersson et al. 2020). FLIP is the difference, from 0 to
1, that is visible when both pictures alternate on a normal screen (67 px per degree). Outside the disc both pictures are made equal, so
that these pixels do not affect SSIM and FLIP near the disc's edge.

A part of what renders miss on the caps is a picture fixed to each cap (``fixed_share``), which a better relief could hold.
"""

from dataclasses import dataclass

import cv2
import flip_evaluator
import numpy as np
from skimage.metrics import structural_similarity

from scenes.sensor import PinsSpec, ViewSpec
from twin.errors import FrameError
from twin.frames.forms import gray_levels
from twin.optics.relief import SKIN_FROM, cap_planes
from twin.types import FloatArray, ImageArray, PinState

# Range of 8-bit gray levels.
LEVELS = 255.0
# Amplification of the difference picture.
CHANGE_GAIN = 2
# Places along the diameter of a cap and its edge at which a difference is read.
PLACES = 19


@dataclass(frozen=True)
class ImageFigures:
    """Similarity of one pair: PSNR in dB (inf: identical), SSIM (1: identical), FLIP (0: identical); ``psnr_whole_db``: of whole frames."""

    psnr_db: float
    psnr_gray_db: float
    ssim: float
    ssim_gray: float
    flip: float
    psnr_whole_db: float


def compare_images(real: np.ndarray, rendered: np.ndarray, inside: np.ndarray) -> ImageFigures:
    """Figures of a pair of 8-bit frames, (H, W) or (H, W, 3), over the pixels ``inside`` (H, W) bool.

    Raises
    ------
    FrameError
        The frames differ in shape or are not 8-bit.
    """
    if real.shape != rendered.shape or real.dtype != np.uint8 or rendered.dtype != np.uint8:
        raise FrameError(
            f"can't compare {rendered.dtype} {rendered.shape} with {real.dtype} {real.shape}; give two 8-bit frames of one sensor"
        )
    masked = np.where(inside if real.ndim == 2 else inside[..., None], rendered, real)
    gray, masked_gray = gray_levels(real), gray_levels(masked)
    return ImageFigures(
        psnr_db=_psnr_db(real[inside], masked[inside]),
        psnr_gray_db=_psnr_db(gray[inside], masked_gray[inside]),
        ssim=_ssim(real, masked, inside),
        ssim_gray=_ssim(gray, masked_gray, inside),
        flip=float(flip_map(real, masked)[inside].mean()),
        psnr_whole_db=_psnr_db(real, rendered),
    )


def flip_map(real: np.ndarray, rendered: np.ndarray) -> np.ndarray:
    """(H, W) FLIP of two 8-bit frames."""
    pair = (np.repeat(a[..., None], 3, axis=2) if a.ndim == 2 else a for a in (real, rendered))
    reference, test = (np.ascontiguousarray(a, np.float32) / np.float32(LEVELS) for a in pair)
    return flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False, computeMeanError=False)[0][..., 0]


def difference_picture(real: np.ndarray, rendered: np.ndarray) -> np.ndarray:
    """Difference picture (uint8), amplified twice: above middle gray the render is brighter than the real frame, below it is darker."""
    return np.clip(127.5 + CHANGE_GAIN * (rendered.astype(float) - real), 0, 255).astype(np.uint8)


def _psnr_db(real: np.ndarray, rendered: np.ndarray) -> float:
    mean_square = np.mean((real.astype(float) - rendered) ** 2)
    return float("inf") if mean_square == 0 else float(10 * np.log10(LEVELS**2 / mean_square))


def _ssim(real: np.ndarray, rendered: np.ndarray, inside: np.ndarray) -> float:
    axis = 2 if real.ndim == 3 else None
    _, local = structural_similarity(real, rendered, data_range=LEVELS, channel_axis=axis, full=True)
    return float(local[inside].mean())


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
