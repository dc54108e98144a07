"""Output files that are whole or not there: written beside their place, renamed when complete."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import AcquisitionError


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a path beside `path` to write to; rename it to `path` when the block ends without an exception.

    On an exception the partial file is removed and whatever stood at `path` before stays as it was.
    Raises `AcquisitionError` when `path` is a folder or a device, its folder is missing or not writable, or the disk is
    full.
    """
    if not path.name:
        raise AcquisitionError(f"{path}: cannot be written: expected the name of a file")
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        if path.exists() and not path.is_file():
            # Renaming onto /dev/null would replace the device.
            raise AcquisitionError(f"{path}: cannot be written: expected a file, found a folder or a device")
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise AcquisitionError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):  # the folder may not be there, or be a file: the error above has said so
            partial.unlink()


def refuse_clash(out: Path, inputs: Iterable[Path]) -> None:
    """Raise `AcquisitionError` when writing `out` would replace one of the `inputs`."""
    for path in inputs:
        with suppress(OSError):  # a missing input is told by whoever reads it
            if out.exists() and out.samefile(path):
                raise AcquisitionError(f"{out}: is an input too ({path}): expected another name for the output")
