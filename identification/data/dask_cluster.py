"""Workers of a Dask cluster, where the optional extra `cluster` is installed."""

from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

from ..errors import IdentificationError
from .work import Pool, Work

EXTRA = "pip install 'robot-idim[cluster]'"
PACKAGES = ("robot-idim", "numpy", "scipy", "pin")  # whose versions must agree for the same bits
PATIENCE_S = 10.0


@contextmanager
def cluster(address: str) -> Iterator[Work]:
    """The workers of the Dask scheduler at `address`, such as tcp://host:8786.

    Raises
    ------
    IdentificationError : where Dask distributed is not installed, the scheduler does not answer or has no worker, or a worker
        lacks this package or has other versions of what a fit rests on.
    """
    try:
        from distributed import Client, KilledWorker
    except ImportError as error:
        problem = "Dask distributed is not installed"
        raise IdentificationError(problem, key="--cluster", value=address, expected=EXTRA) from error
    try:
        client = Client(address, timeout=PATIENCE_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        problem = f"no scheduler answers: {error}"
        expected = "the address that `dask scheduler` prints, such as tcp://host:8786"
        raise IdentificationError(problem, key="--cluster", value=address, expected=expected) from error
    try:
        _check_workers(client, address)
        yield Pool(lambda: client.get_executor(pure=False, retries=2), (KilledWorker, CancelledError))
    finally:
        client.close()


def versions() -> dict[str, str]:
    """Versions of what a fit rests on, in this process."""
    return {name: version(name) for name in PACKAGES}


def _check_workers(client: Any, address: str) -> None:
    here, found = versions(), client.run(versions, on_error="return")
    if not found:
        expected = "`dask worker` started on it"
        raise IdentificationError("the scheduler has no worker", key="--cluster", value=address, expected=expected)
    for worker, there in sorted(found.items()):
        if isinstance(there, BaseException):
            expected = f"robot-idim {here['robot-idim']}"
            raise IdentificationError(f"cannot run this package: {there}", place=f"worker {worker}", expected=expected)
        for name, wanted in here.items():
            if there[name] != wanted:
                expected = f"{wanted}, as here"
                raise IdentificationError(place=f"worker {worker}", key=name, value=there[name], expected=expected)
