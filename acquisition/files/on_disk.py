"""Memory-mapped temporary arrays and bytes, for data that exceed the memory.

The functions here process such data block by block.
"""

import mmap
import os
import tempfile
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

# Larger arrays go to disk. An hour of six joints at 500 Hz has about five of them, which do not fit
# in 1 GB.
MAX_BYTES_IN_MEMORY = 2**26
BLOCK_ROWS = 100_000  # rows of an array that are processed at a time
Kind = TypeVar("Kind", bound=np.generic)


class GrowingBytes(tempfile.SpooledTemporaryFile[bytes]):
    """Bytes that grow by `write`, in memory, or in a temporary file if they are large.

    The file is unnamed. It is used if the bytes exceed an eighth of `MAX_BYTES_IN_MEMORY`. `write`
    raises `OSError` if the disk is full.
    """

    def __init__(self) -> None:
        """Start without bytes."""
        super().__init__(max_size=MAX_BYTES_IN_MEMORY // 8)

    def whole(self) -> bytes | mmap.mmap:
        """Return all bytes. Nothing may be written afterwards."""
        size = self.tell()
        if size <= MAX_BYTES_IN_MEMORY // 8:
            self.seek(0)
            return self.read()
        self.flush()
        return mmap.mmap(self.fileno(), size, access=mmap.ACCESS_READ)


def allocate(shape: tuple[int, ...], dtype: Any = np.float64, *, many: int = 1) -> NDArray[Any]:
    """Allocate an uninitialised array, on disk if it is large.

    Parameters
    ----------
    shape : shape of the array.
    dtype : type of its elements.
    many : number of such arrays that exist at the same time. If they exceed `MAX_BYTES_IN_MEMORY`
        together, the array is in an unnamed temporary file.

    Raises
    ------
    OSError : the disk is full.
    """
    size = np.dtype(dtype).itemsize * int(np.prod(shape))
    if many * size <= MAX_BYTES_IN_MEMORY:
        return np.empty(shape, dtype)
    with tempfile.TemporaryFile() as file:
        # If the disk becomes full, writing to a file with holes would kill the process, so the
        # space is allocated first.
        os.posix_fallocate(file.fileno(), 0, size)
        return np.frombuffer(mmap.mmap(file.fileno(), size), dtype).reshape(shape)


def kept(x: NDArray[Kind]) -> NDArray[Kind]:
    """Copy an array that is used for a long time, to disk if it is large.

    An array is large if it exceeds an eighth of `MAX_BYTES_IN_MEMORY`. Memory that is freed in
    smaller parts is not returned to the system.
    """
    copy = allocate(x.shape, x.dtype, many=8)
    copy[...] = x
    return copy


def by_rows(
    rule: Callable[..., NDArray[Any]], *arrays: NDArray[Any], beside: int = 0
) -> NDArray[Any]:
    """Compute `rule(*arrays)` block by block; a large result is on disk.

    Parameters
    ----------
    rule : function of blocks of all arrays.
    arrays : (N, ...) each.
    beside : number of next rows that a row of the result also needs.

    Returns
    -------
    Array (N - beside, ...).
    """
    count = len(arrays[0]) - beside
    if count <= BLOCK_ROWS:
        return rule(*arrays)
    for first in range(0, count, BLOCK_ROWS):
        part = rule(*(x[first : min(count, first + BLOCK_ROWS) + beside] for x in arrays))
        if first == 0:
            whole = allocate((count, *part.shape[1:]), part.dtype, many=8)
        whole[first : first + BLOCK_ROWS] = part
        for x in (*arrays, whole):
            release_pages(x)
    return whole


def taken(x: NDArray[Any], rows: NDArray[np.intp]) -> NDArray[Any]:
    """Return the growing `rows` of x (N, ...), on disk if they are many."""
    return x if len(rows) == len(x) else by_rows(lambda part: x[part], rows)


def field_of(rows: NDArray[np.void], name: str) -> NDArray[Any]:
    """Return a field of rows.

    If the rows exceed `MAX_BYTES_IN_MEMORY`, the field is a copy on disk, made in one iteration
    over the rows.
    """
    return (
        by_rows(lambda part: part[name], rows) if rows.nbytes > MAX_BYTES_IN_MEMORY else rows[name]
    )


def release_pages(x: NDArray[np.generic]) -> None:
    """Release the memory of an array in a temporary file.

    The pages of the array are read again at the next access.
    """
    base: object = x
    while isinstance(base, np.ndarray | memoryview):
        base = base.base if isinstance(base, np.ndarray) else base.obj
    if isinstance(base, mmap.mmap):
        base.madvise(mmap.MADV_DONTNEED)
