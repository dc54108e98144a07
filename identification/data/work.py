"""Tasks on an executor: functions of a module with positional arguments; a task runs again if its worker dies.

Results come in the order of the tasks, whatever the order in which they finish: sums over them are identical to the last bit
with any number of workers.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib.metadata import version
from multiprocessing import active_children, current_process, get_context
from multiprocessing.process import BaseProcess
from typing import Any, Protocol

from ..errors import IdentificationError

MAX_RENEWALS = 2  # times that tasks are submitted to new workers
POLL_S = 1.0  # between checks whether workers are alive
EXIT_NO_GUARD = 71  # exit code of a worker whose script would start workers
EXIT_SCRIPT_ERROR = 1  # exit code of a worker whose script fails
EXPECTED_GUARD = 'the call below `if __name__ == "__main__":`, because workers also run the script'
EXTRA = "pip install 'robot-idim[cluster]'"
PACKAGES = ("robot-idim", "numpy", "scipy", "pin")  # versions must agree for identical results
SCHEDULER_TIMEOUT_S = 10.0  # to wait for the scheduler
Task = tuple[Any, ...]  # positional arguments of a task


class WorkersNotStartedError(IdentificationError):
    """Workers ended before their first task; new ones would end too."""


class Work(Protocol):
    """Runs a function of a module for each tuple of positional arguments."""

    @property
    def remote(self) -> bool:
        """Whether tasks run in other processes, so that arguments and results are sent."""

    def run(self, function: Callable[..., Any], tasks: Sequence[Task]) -> Iterator[Any]:
        """Results in the order of the tasks. An error of a task is raised in place of its result."""


class Serial:
    """Runs tasks one after the other in this process."""

    remote = False

    def run(self, function: Callable[..., Any], tasks: Sequence[Task]) -> Iterator[Any]:
        """Results in the order of the tasks."""
        return (function(*task) for task in tasks)


class Pool:
    """Runs tasks on an executor of `open_executor`; opens a new one if workers die, at most twice."""

    remote = True

    def __init__(
        self, open_executor: Callable[[], Executor], lost: tuple[type[BaseException], ...] = (BrokenProcessPool,)
    ) -> None:
        """`lost` are the errors of a task whose worker died."""
        self._others: list[BaseProcess] = active_children()  # that are not workers
        self._workers: list[BaseProcess] = []
        self._open, self._executor, self._lost = open_executor, open_executor(), lost

    def run(self, function: Callable[..., Any], tasks: Sequence[Task]) -> Iterator[Any]:
        """Results in the order of the tasks; all of them are submitted at once.

        Raises `IdentificationError`: if workers died three times; `WorkersNotStartedError`: if they
        cannot start.
        """
        futures = [self._submit(function, task) for task in tasks]
        lost = 0
        for k in range(len(tasks)):
            while not self._is_done(futures[k]):
                self._refuse_no_start()
                lost += 1
                if lost > MAX_RENEWALS:
                    problem = f"workers ended {lost} times before task {k + 1} of {len(tasks)} was done: out of memory?"
                    raise IdentificationError(problem, expected="fewer --workers, or a larger --decimate")
                self._renew(function, tasks, futures, k)
            result = futures[k].result()
            futures[k] = Future()  # its result is not held twice
            yield result

    def _is_done(self, future: "Future[Any]") -> bool:
        """Wait for a task; False if its worker died.

        The pool of the standard library does not notice a worker that dies while it starts, and waits forever.
        """
        while True:
            finished, _ = wait([future], timeout=POLL_S)
            if finished:
                return future.cancelled() or not isinstance(future.exception(), self._lost)
            if any(not worker.is_alive() for worker in self._workers):
                return False

    def _submit(self, function: Callable[..., Any], task: Task) -> "Future[Any]":
        """The task's future; a failed one if a worker has already died."""
        try:
            future = self._executor.submit(function, *task)
        except self._lost as error:
            future = Future()
            future.set_exception(error)
        self._workers += [child for child in active_children() if child not in (*self._others, *self._workers)]
        return future

    def _refuse_no_start(self) -> None:
        for worker in self._workers:
            worker.join(POLL_S)  # the pool sees the closed pipe before the exit code exists
        codes = {worker.exitcode for worker in self._workers}
        if EXIT_NO_GUARD in codes:
            raise WorkersNotStartedError("the script starts workers whenever it is imported", expected=EXPECTED_GUARD)
        if EXIT_SCRIPT_ERROR in codes:  # errors of tasks do not end a worker
            raise WorkersNotStartedError(
                "workers end while they start", expected=f"a script that can be imported; {EXPECTED_GUARD}"
            )

    def _renew(self, function: Callable[..., Any], tasks: Sequence[Task], futures: list["Future[Any]"], k: int) -> None:
        """A broken pool is unusable: open a new one and submit the unfinished tasks from k on."""
        for worker in self._workers:
            worker.kill()
        self._executor.shutdown(wait=False, cancel_futures=True)
        self._others, self._workers = active_children(), []
        self._executor = self._open()
        for i in range(k, len(tasks)):
            done = futures[i].done() and not futures[i].cancelled() and futures[i].exception() is None
            if not done:
                futures[i] = self._submit(function, tasks[i])

    def close(self) -> None:
        """End the workers; drop tasks that have not begun."""
        self._executor.shutdown(wait=True, cancel_futures=True)


@contextmanager
def processes(workers: int) -> Iterator[Work]:
    """Worker processes on this machine, or this process alone for one.

    Processes are spawned, each with one thread of linear algebra.
    """
    if workers == 1:
        yield Serial()
        return
    if getattr(current_process(), "_inheriting", False):  # a worker that imports a script without guard
        os._exit(EXIT_NO_GUARD)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    pool = Pool(lambda: ProcessPoolExecutor(max_workers=workers, mp_context=get_context("spawn")))
    try:
        yield pool
    finally:
        pool.close()


@contextmanager
def cluster(address: str) -> Iterator[Work]:
    """The workers of the Dask scheduler at `address`, such as tcp://host:8786.

    Raises
    ------
    IdentificationError : if Dask distributed is not installed, the scheduler does not answer or has no worker, or a worker
        lacks this package or has other versions of `PACKAGES`.
    """
    try:
        from distributed import Client, KilledWorker
    except ImportError as error:
        problem = "Dask distributed is not installed"
        raise IdentificationError(problem, key="--cluster", value=address, expected=EXTRA) from error
    try:
        client = Client(address, timeout=SCHEDULER_TIMEOUT_S, set_as_default=False)
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
    """Versions of `PACKAGES` in this process."""
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
