"""Tasks on workers: their order, their errors, workers that die, clusters that cannot be used."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from identification.data import Work
from identification.data import work as work_module
from identification.errors import BadInputError, RobotIdimError


def slowly_squared(x: int) -> tuple[int, int]:
    time.sleep(0.02 * (4 - x))
    return x * x, os.getpid()


def thread() -> str:
    return threading.current_thread().name


def refused(x: int) -> int:
    raise RobotIdimError("no", place=f"task {x}", key="k", value=x, expected="another")


def killed(mark: Path, number: int, times: int) -> int:
    """Task 3 ends its worker by kill -9, as often as told."""
    if (
        number == 3
        and (mark.write_text(mark.read_text() + "x") if mark.exists() else mark.write_text("x"))
        <= times
    ):
        os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0"
    ) as dask:
        yield dask.scheduler_address
        distributed.default_client().close()


@pytest.fixture(params=[1, 2, "cluster"])
def work(request):
    return Work(request.getfixturevalue("cluster") if request.param == "cluster" else request.param)


def test_results_keep_task_order_and_errors_their_type(work):
    found = list(work.run(slowly_squared, [(k,) for k in range(4)]))
    assert [square for square, _ in found] == [0, 1, 4, 9]
    assert {pid == os.getpid() for _, pid in found} == {work.workers == 1}
    with pytest.raises(RobotIdimError, match="task 1") as told:
        list(work.run(refused, [(1,)]))
    assert (told.value.place, told.value.value, told.value.expected) == ("task 1", 1, "another")


def told_of(work, *task) -> str:
    with pytest.raises(BadInputError) as told:
        list(work.run(*task))
    assert "\n" not in str(told.value)
    return str(told.value)


def test_killed_worker_ends_run_in_one_line(tmp_path):
    tasks = [(tmp_path / "mark", number, 1) for number in range(6)]
    line = told_of(Work(2), killed, tasks)
    wanted = (
        "A worker process managed by the executor was unexpectedly terminated. Use fewer workers, "
        "or more memory (workers)."
    )
    assert line == wanted
    assert list(Work(2).run(killed, tasks)) == list(range(6)), "new workers do it"


def test_killed_dask_worker_replaced(cluster, tmp_path, monkeypatch):
    """joblib's own backend of Dask waits forever for what its workers cannot do."""
    assert list(Work(cluster).run(killed, [(tmp_path / "once", k, 1) for k in range(6)])) == list(
        range(6)
    )
    assert "4 different workers" in told_of(
        Work(cluster), killed, [(tmp_path / "ever", k, 99) for k in range(6)]
    )
    monkeypatch.setattr(work_module, "__package__", "only_here")
    assert "No module named 'only_here'" in told_of(Work(cluster), slowly_squared, [(1,)])


def test_one_worker_cluster_runs_tasks():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=1, processes=False, dashboard_address=":0") as dask:
        threads = list(Work(dask.scheduler_address).run(thread, [()]))
        distributed.default_client().close()
    assert "Dask" in threads[0]


def test_script_needs_no_guard():
    script = (
        "from identification import Work\nprint(*Work(2).run(pow, [(k, 2) for k in range(4)]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-"], input=script, capture_output=True, text=True, timeout=60
    )
    assert (done.stdout, done.stderr) == ("0 1 4 9\n", "")


@pytest.mark.parametrize("installed", [True, False])
def test_unusable_cluster_refused(monkeypatch, installed):
    if not installed:
        monkeypatch.setitem(sys.modules, "distributed", None)
    line = told_of(Work("nowhere://host:8786"), slowly_squared, [(1,)])
    assert line.startswith("nowhere://host:8786: ")
    assert line.endswith(". Start Dask workers that have this package installed.")
