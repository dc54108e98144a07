"""What is too large to be held in memory, in a temporary file: memory has of it what is looked at."""

import mmap
import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

HELD = 2**28  # bytes that are held in memory
_ROWS = 100_000  # gone through at a time


class GrowingBytes:
    """Bytes that grow, in memory or, beyond an eighth of `HELD`, in a temporary file without a name."""

    def __init__(self) -> None:
        """None yet."""
        self._most = HELD // 8
        self._file = tempfile.SpooledTemporaryFile(max_size=self._most)  # noqa: SIM115 (it lives as long as the bytes)

    def __len__(self) -> int:
        return self._file.tell()

    def extend(self, content: bytes) -> None:
        """Append. Raises `OSError` where the disk is full."""
        self._file.write(content)

    def whole(self) -> bytes | mmap.mmap:
        """All of them; nothing is appended afterwards."""
        if len(self) <= self._most:
            self._file.seek(0)
            return self._file.read()
        self._file.flush()
        return mmap.mmap(self._file.fileno(), len(self), access=mmap.ACCESS_READ)


def allocate(shape: tuple[int, ...], held: int | None = None) -> NDArray[np.float64]:
    """An array to be filled; one larger than `held`, or `HELD`, lies in a temporary file without a name."""
    size = 8 * int(np.prod(shape))
    if size <= (HELD if held is None else held):
        return np.empty(shape)
    with tempfile.TemporaryFile() as file:
        file.truncate(size)
        return np.frombuffer(mmap.mmap(file.fileno(), size), np.float64).reshape(shape)


def field_of(rows: NDArray[np.void], name: str) -> NDArray[Any]:
    """A field of rows. Where these are more than `HELD` it lies on disk by itself: rows are read once, and let go."""
    x = rows[name]
    if rows.nbytes <= HELD:
        return x
    own = allocate(x.shape).view(x.dtype)
    for first in range(0, len(x), _ROWS):
        own[first : first + _ROWS] = x[first : first + _ROWS]
        release_pages(rows)
    release_pages(own)
    return own


def release_pages(x: NDArray[np.generic]) -> None:
    """Take what lies in a temporary file out of memory: it is read again where it is looked at."""
    base: object = x
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, memoryview):
        base = base.obj
    if isinstance(base, mmap.mmap):
        base.madvise(mmap.MADV_DONTNEED)
