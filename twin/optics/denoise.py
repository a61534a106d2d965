"""Optional removal of sampling noise, by Open Image Denoise (``pip install pyoidn``; runs on the CPU)."""

import numpy as np

from twin.errors import RenderError


def denoise(linear: np.ndarray) -> np.ndarray:
    """Linear light without its sampling noise, same shape and type.

    Makes few samples look like many; it does not make pins easier to locate than the noisy image does.

    Parameters
    ----------
    linear : (H, W, 3) or (H, W) float32

    Raises
    ------
    RenderError
        If pyoidn is not installed.
    """
    try:
        import pyoidn
    except ImportError as error:
        raise RenderError("denoising needs Open Image Denoise: pip install pyoidn, or render without denoise") from error
    mono = linear.ndim == 2
    color = np.repeat(linear[..., None], 3, axis=2) if mono else linear
    clean = pyoidn.denoise(np.ascontiguousarray(color, np.float32), hdr=True)
    return np.ascontiguousarray(clean[..., 1] if mono else clean, np.float32)
