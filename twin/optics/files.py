"""Linear images on disk."""

from pathlib import Path

import numpy as np

from twin.optics.variant import VariantChoice, use_variant
from twin.types import FloatArray


def write_exr(path: Path, linear: FloatArray, choice: VariantChoice) -> None:
    """Write linear light as a half-float OpenEXR file.

    Parameters
    ----------
    path : Path
    linear : (H, W, 3) or (H, W) float32
    choice : VariantChoice
        The variant that rendered it.
    """
    mi = use_variant(choice)
    pixels = np.ascontiguousarray(linear if linear.ndim == 3 else linear[..., None])
    mi.Bitmap(pixels).convert(component_format=mi.Struct.Type.Float16).write(str(path))
