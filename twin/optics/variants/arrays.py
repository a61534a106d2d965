"""Copies of arrays that are safe to give to Dr.Jit.

Dr.Jit's vectorised variants use the memory of a NumPy array without a copy, and their kernels read it in whole packets: up to one packet
beyond the last element. If that is beyond the end of a mapped page, the process is killed (drjit 1.5, `arr + 1` on such an array).
Embree also reads beyond the last vertex. Therefore every array that is given to them has unused memory behind its end.

A kernel is compiled again for arrays that do not begin at a multiple of a packet's size. Therefore all copies begin at such a multiple.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Number = TypeVar("Number", np.float32, np.uint32)

ROOM_BYTES = 64
"""Size of the widest packet: 16 numbers of 4 bytes (AVX-512)."""


def with_room(values: ArrayLike, dtype: type[Number]) -> NDArray[Number]:
    """A contiguous copy of ``values`` with the same shape.

    Its memory begins at a multiple of ``ROOM_BYTES`` and extends at least ``ROOM_BYTES`` beyond its end.
    """
    values = np.asarray(values)
    each = np.dtype(dtype).itemsize
    room = np.zeros(values.size + 2 * (ROOM_BYTES // each), dtype)
    first = -room.ctypes.data % ROOM_BYTES // each
    out = room[first : first + values.size].reshape(values.shape)
    out[...] = values
    return out
