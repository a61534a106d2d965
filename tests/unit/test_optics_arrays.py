"""Arrays that Dr.Jit takes over may be read a packet beyond their end."""

import numpy as np
import pytest

from twin.optics.variant import ROOM_BYTES, with_room


@pytest.mark.parametrize("dtype", [np.uint32, np.float32])
@pytest.mark.parametrize("shape", [(0,), (1,), (1021,), (7, 3, 3), (211, 97)])
def test_values_shape_and_room(shape, dtype):
    values = np.arange(np.prod(shape)).reshape(shape)
    made = with_room(values, dtype)
    assert np.array_equal(made, values) and made.dtype == dtype and made.flags.c_contiguous
    whole = made
    while whole.base is not None:
        whole = whole.base
    end = made.__array_interface__["data"][0] + made.nbytes
    assert whole.__array_interface__["data"][0] + whole.nbytes - end >= ROOM_BYTES
    assert not values.size or made.__array_interface__["data"][0] % ROOM_BYTES == 0, "else kernels are compiled twice"


def test_a_copy_shares_no_memory_with_its_original():
    values = np.zeros(5, np.float32)
    made = with_room(values, np.float32)
    values[:] = 1
    assert not made.any()
