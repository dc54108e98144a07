"""Tasks on workers, by joblib.

Results come in the order of the tasks, so that sums over them are the same to the last bit.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from functools import partial
from typing import Any, NamedTuple

from ..errors import BadInputError


class Work(NamedTuple):
    """The processes in which tasks run.

    Attributes:
        workers: number of processes, 1 for the calling one; or the address of a Dask scheduler,
            such as `tcp://HOST:8786`.
    """

    workers: int | str = 1

    def run(self, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        """Call a function for each task, and yield the results in the order of the tasks.

        Parameters
        ----------
        function : a function that can be pickled.
        tasks : positional arguments of each call.

        Raises
        ------
        BadInputError : the workers cannot be used, or end early. An error of a task is raised too.
        """
        if (on := self.workers) == 1:
            return (yield from (function(*task) for task in tasks))
        from asyncio import CancelledError

        from joblib import Parallel, delayed

        how = (
            _cluster(on)
            if isinstance(on, str)
            else {"backend": "loky", "n_jobs": min(on, len(tasks)), "inner_max_num_threads": 1}
        )
        parallel = Parallel(
            **how, return_as="generator", pre_dispatch="all", batch_size=1, max_nbytes=None
        )
        # With `partial`, Dask keeps a task whole. Else it would store large arguments at one
        # worker, and lose them with that worker.
        try:
            yield from parallel(delayed(partial(function, *task))() for task in tasks)
        except (BrokenExecutor, CancelledError) as error:
            raise BadInputError(
                str(error).split(".")[0],
                advice="Use fewer workers, or more memory",
                arguments=("workers",),
            ) from error


HERE = Work()


def _cluster(address: str) -> dict[str, Any]:
    try:
        from distributed import get_client
        from joblib._dask import DaskDistributedBackend

        (client := get_client(address, timeout=10)).wait_for_workers(1, timeout=10)
        client.run(__import__, __package__)  # an error if a worker has no such package
    except (ImportError, OSError, ValueError) as error:
        raise BadInputError(
            f"cannot be used: {error}",
            place=address,
            advice="Start Dask workers that have this package installed",
        ) from error

    class Backend(DaskDistributedBackend):  # type: ignore[misc]  # joblib's waits forever after errors of workers
        def submit(self, func: Any, callback: Callable[[Any], object]) -> Any:
            job = super().submit(func, callback)
            job.add_done_callback(
                lambda done: done.exception() and callback(BrokenExecutor(done.exception()))
            )
            return job

        def effective_n_jobs(self, n_jobs: int) -> int:
            return 2  # the tasks for a single worker joblib would do itself

    return {"backend": Backend(client=client)}
