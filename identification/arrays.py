"""The array type of the package."""

import ctypes
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""float64 of any shape; docstrings give the shape, time first: (N, n) is samples by joints."""

LARGE = 2**24  # bytes of an array beside which freed memory counts


def release_memory(beside: Array) -> None:
    """Return freed memory to the system if there is a large array `beside` it: between the arrays
    of a long recording the allocator keeps hundreds of MB. Only glibc can.
    """
    if beside.nbytes > LARGE:
        with suppress(AttributeError, TypeError):
            ctypes.CDLL(None).malloc_trim(0)
