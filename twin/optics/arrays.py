"""NumPy arrays that Dr.Jit may take over.

Dr.Jit's vectorised variants use a NumPy array where it lies, and their kernels read whole packets of it: up to a packet
beyond its last element. If that is beyond the end of a mapped page, the process dies (drjit 1.5, `arr + 1` on such an array).
Embree needs the same room behind vertices. Therefore every array that is handed over gets room behind its end.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Number = TypeVar("Number", np.float32, np.uint32)

ROOM_BYTES = 64
"""The widest packet: 16 numbers of 4 bytes (AVX-512)."""


def with_room(values: ArrayLike, dtype: type[Number]) -> NDArray[Number]:
    """A contiguous copy of ``values``, of their shape, with ``ROOM_BYTES`` of its own memory behind its end."""
    values = np.asarray(values)
    room = np.zeros(values.size + -(-ROOM_BYTES // np.dtype(dtype).itemsize), dtype)
    out = room[: values.size].reshape(values.shape)
    out[...] = values
    return out
