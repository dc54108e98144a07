"""Memory-mapped temporary arrays and bytes, for data that are too large for memory."""

import mmap
import tempfile
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

# of one array: an hour of six joints at 500 Hz has some five, which do not fit in 1 GB
MAX_BYTES_IN_MEMORY = 2**26
_BLOCK_ROWS = 100_000
Kind = TypeVar("Kind", bound=np.generic)


class GrowingBytes:
    """Bytes that grow, in memory or, if they exceed an eighth of `MAX_BYTES_IN_MEMORY`, in an
    unnamed temporary file.
    """

    def __init__(self) -> None:
        """Start without bytes."""
        self._max_bytes = MAX_BYTES_IN_MEMORY // 8
        self._file = tempfile.SpooledTemporaryFile(max_size=self._max_bytes)  # noqa: SIM115 (open as long as the bytes are used)

    def __len__(self) -> int:
        return self._file.tell()

    def extend(self, content: bytes) -> None:
        """Append. Raises `OSError` where the disk is full."""
        self._file.write(content)

    def whole(self) -> bytes | mmap.mmap:
        """All bytes; nothing may be appended afterwards."""
        if len(self) <= self._max_bytes:
            self._file.seek(0)
            return self._file.read()
        self._file.flush()
        return mmap.mmap(self._file.fileno(), len(self), access=mmap.ACCESS_READ)


def allocate(
    shape: tuple[int, ...], dtype: Any = np.float64, most: int | None = None
) -> NDArray[Any]:
    """An uninitialised array, in an unnamed temporary file if it is larger than `most` bytes
    (`MAX_BYTES_IN_MEMORY`).
    """
    size = np.dtype(dtype).itemsize * int(np.prod(shape))
    if size <= (MAX_BYTES_IN_MEMORY if most is None else most):
        return np.empty(shape, dtype)
    with tempfile.TemporaryFile() as file:
        file.truncate(size)
        return np.frombuffer(mmap.mmap(file.fileno(), size), dtype).reshape(shape)


def kept(x: NDArray[Kind]) -> NDArray[Kind]:
    """An array that lives for long: copied to disk if it is larger than an eighth of
    `MAX_BYTES_IN_MEMORY`; much memory that is freed in smaller parts is not returned.
    """
    copy = allocate(x.shape, x.dtype, MAX_BYTES_IN_MEMORY // 8)
    copy[...] = x
    return copy


def field_of(rows: NDArray[np.void], name: str) -> NDArray[Any]:
    """A field of rows; a copy on disk if the rows are larger than
    `MAX_BYTES_IN_MEMORY`, made in one pass.
    """
    x = rows[name]
    if rows.nbytes <= MAX_BYTES_IN_MEMORY:
        return x
    field = allocate(x.shape).view(x.dtype)
    for first in range(0, len(x), _BLOCK_ROWS):
        field[first : first + _BLOCK_ROWS] = x[first : first + _BLOCK_ROWS]
        release_pages(rows)
    release_pages(field)
    return field


def release_pages(x: NDArray[np.generic]) -> None:
    """Release the memory of an array in a temporary file; its pages are read
    again on the next access.
    """
    base: object = x
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, memoryview):
        base = base.obj
    if isinstance(base, mmap.mmap):
        base.madvise(mmap.MADV_DONTNEED)
