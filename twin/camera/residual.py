"""A small network that adds to a frame the details that the models of light and camera do not describe: texture of edges, colours and
noise.

The change of each pixel depends on the pixels around it and on random numbers of its own. The network has four convolutions; the middle two
add to their input. It was trained against classifiers that distinguish real frames from rendered ones (`training.runs.residual`). It works
on luma and colour differences before the stream rounds them, within the lens disc, and only if ``response.residual.used`` is set.
"""

import numpy as np

from scenes.sensor import ResidualSpec, SensorSpec
from twin.errors import RenderError
from twin.types import FloatArray

LEVELS = 64.0
"""Number of gray levels that correspond to the value 1 of the network's input."""
MIDDLE = (1.0, 0.0, 0.0)
"""Offsets that are subtracted from the input's luma and colour differences, in units of ``LEVELS``."""
LEAK = 0.1
"""Slope of the leaky rectifier for negative values."""
MOST_LEVELS, STEEPNESS = 16.0, 2.0
"""Largest change of luma and colour differences, gray levels, and factor in front of the tanh's argument."""


def with_residual(spec: SensorSpec) -> SensorSpec:
    """The specification with its residual network switched on.

    Raises
    ------
    RenderError
        The specification has none.
    """
    if spec.response.residual is None:
        raise RenderError(f"sensor {spec.name} has no residual network (response.residual); leave `residual` out, or use ur5-331")
    return spec.alter(response={"residual": {"used": True}})


def refine(
    gray: FloatArray, residual: ResidualSpec, luma: FloatArray, columns: int, rng: np.random.Generator | None, origin_px: tuple[int, int]
) -> FloatArray:
    """Gray levels (H, W, 3) after the network, with the mean colour differences of the columns that share them.

    Parameters
    ----------
    gray : (H, W, 3) float
        Gray levels in which no columns share their colour differences yet.
    luma : (3,) float
        Shares of the colours in the luma.
    columns : int
        Number of neighbouring columns of the full frame that share colour differences.
    rng : numpy.random.Generator, optional
        Source of the network's random numbers; without it they are 0.
    origin_px : (x, y)
        Place of the first pixel in the camera's full frame.
    """
    matrix = differences(luma)
    signal = np.asarray(gray, np.float32) @ matrix.T
    height, width = gray.shape[:2]
    middle_x, middle_y = (at - start for at, start in zip(residual.center_px, origin_px, strict=True))
    inside = (np.arange(width) - middle_x) ** 2 + (np.arange(height)[:, None] - middle_y) ** 2 <= residual.radius_px**2
    if inside.any():
        rows, across = (slice(k.min(), k.max() + 1) for k in np.nonzero(inside))
        part = signal[rows, across]
        size = (*part.shape[:2], residual.noises)
        noise: FloatArray = np.zeros(size, np.float32) if rng is None else rng.standard_normal(size, dtype=np.float32)
        signal[rows, across] = part + inside[rows, across, None] * change(part, noise, residual)
    signal[..., 1:] = average_colours(signal[..., 1:], columns, origin_px[0])
    return np.asarray(signal @ np.linalg.inv(matrix).T, np.float32)


def differences(luma: FloatArray) -> FloatArray:
    """Matrix (3, 3) from red, green and blue to luma, blue and red difference, all in gray levels; ``luma`` (3,): shares in the luma."""
    rows = [luma, *((np.eye(3)[k] - luma) / (2 * (1 - luma[k])) for k in (2, 0))]
    return np.array(rows, np.float32)


def change(signal: FloatArray, noise: FloatArray, residual: ResidualSpec) -> FloatArray:
    """The change (H, W, 3), gray levels, that the network adds to luma and colour differences (H, W, 3), for noise (H, W, noises)."""
    first, second, third, last = layers(residual)
    seen = np.concatenate([signal / np.float32(LEVELS) - np.array(MIDDLE, np.float32), noise], axis=2)
    hidden = rectify(convolve(seen, *first))
    hidden = hidden + rectify(convolve(hidden, *second))
    hidden = hidden + rectify(convolve(hidden, *third))
    return np.float32(MOST_LEVELS) * np.tanh(np.float32(STEEPNESS) * convolve(hidden, *last))


def layers(residual: ResidualSpec) -> list[tuple[FloatArray, FloatArray]]:
    """Kernels (out, in, k, k) and biases (out,) of the four convolutions."""
    weights, found, at = np.array(residual.weights, np.float32), [], 0
    for shape in residual.shapes:
        size = int(np.prod(shape))
        found.append((weights[at : at + size].reshape(shape), weights[at + size : at + size + shape[0]]))
        at += size + shape[0]
    return found


def convolve(signal: FloatArray, kernel: FloatArray, bias: FloatArray) -> FloatArray:
    """Cross-correlation of a signal (H, W, in) with a kernel (out, in, k, k). The signal is padded with zeros."""
    height, width, channels = signal.shape
    side = kernel.shape[2]
    padded = np.pad(signal, ((side // 2, side // 2), (side // 2, side // 2), (0, 0)))
    found = np.broadcast_to(bias, (height * width, len(bias))).copy()
    for down in range(side):
        rows = padded[down : down + height]
        seen = np.concatenate([rows[:, across : across + width] for across in range(side)], axis=2)
        weights = kernel[:, :, down].transpose(2, 1, 0).reshape(side * channels, -1)
        found += seen.reshape(height * width, -1) @ weights
    return found.reshape(height, width, -1)


def rectify(signal: FloatArray) -> FloatArray:
    """The signal, with its negative part multiplied by ``LEAK``."""
    return np.maximum(signal, np.float32(LEAK) * signal)


def average_colours(chroma: FloatArray, columns: int, left_px: int = 0) -> FloatArray:
    """Colour differences (H, W, 2), averaged over groups of columns of the full frame; ``left_px`` is the number of the first column."""
    if columns == 1:
        return chroma
    group = (left_px + np.arange(chroma.shape[1])) // columns
    start = np.flatnonzero(np.r_[True, np.diff(group) > 0])
    mean = np.add.reduceat(chroma, start, axis=1) / np.diff(np.r_[start, len(group)])[None, :, None]
    return np.asarray(np.repeat(mean, np.diff(np.r_[start, len(group)]), axis=1), np.float32)
