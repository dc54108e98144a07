"""Tasks on executors: their order, workers that die, a cluster that cannot be used."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path

import pytest

from identification.data import Serial, cluster, processes
from identification.data import cluster as cluster_face
from identification.data.work import Pool
from identification.errors import IdentificationError

cluster_module = sys.modules[cluster_face.__module__]


def slowly_squared(x: int) -> int:
    time.sleep(0.02 * (4 - x))
    return x * x


def killed_at_first(marks: str, number: int, times: int) -> tuple[int, int]:
    """Ends its own worker by kill -9 the first `times` times that task 3 runs."""
    if number == 3:
        mark = Path(marks) / str(sum(1 for _ in Path(marks).iterdir()))
        if not (Path(marks) / str(times - 1)).exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return number, os.getpid()


def refused(x: int) -> int:
    raise IdentificationError("no", place=f"task {x}", key="k", value=x, expected="another")


def test_results_come_in_the_order_of_the_tasks():
    """The first tasks take longest."""
    tasks = [(k,) for k in range(4)]
    with ThreadPoolExecutor(4) as threads:
        found = list(Pool(lambda: threads).run(slowly_squared, tasks))
    assert found == list(Serial().run(slowly_squared, tasks)) == [0, 1, 4, 9]


def test_one_worker_is_this_process():
    with processes(1) as work:
        assert not work.remote
        assert [pid for _, pid in work.run(killed_at_first, [("", 1, 0)])] == [os.getpid()]


@pytest.mark.slow
def test_tasks_of_a_killed_worker_run_again(tmp_path):
    tasks = [(str(tmp_path), number, 2) for number in range(6)]
    with processes(2) as work:
        found = list(work.run(killed_at_first, tasks))
        assert [number for number, _ in found] == list(range(6))
        assert os.getpid() not in {pid for _, pid in found}
        assert len(list(tmp_path.iterdir())) == 2
        with pytest.raises(IdentificationError, match="task 1") as told:
            list(work.run(refused, [(1,), (2,)]))
        assert (told.value.place, told.value.value, told.value.expected) == ("task 1", 1, "another")


class Overlooking:
    """Its first executor has a process that ends, and says nothing of its tasks; the next one does them at once."""

    opened = 0

    def __init__(self):
        Overlooking.opened += 1
        self.dead = Overlooking.opened == 1
        if self.dead:
            get_context("spawn").Process(target=time.sleep, args=(0.1,)).start()

    def submit(self, function, *arguments):
        future = Future()
        if not self.dead:
            future.set_result(function(*arguments))
        return future

    def shutdown(self, wait=True, cancel_futures=False):
        pass


@pytest.mark.slow
def test_a_worker_that_dies_unnoticed_is_noticed(monkeypatch):
    """As the standard library's pool overlooks one that is killed while it starts."""
    monkeypatch.setattr(Overlooking, "opened", 0)
    assert list(Pool(Overlooking).run(slowly_squared, [(k,) for k in range(4)])) == [0, 1, 4, 9]
    assert Overlooking.opened == 2


class Breaking:
    """Its first executor breaks with task 2, which the next one does; `given` has what each was given."""

    def __init__(self, given):
        self.given, self.breaks = given, not given
        given.append([])

    def submit(self, function, *arguments):
        self.given[-1].append(*arguments)
        future = Future()
        if self.breaks and arguments == (2,):
            future.set_exception(BrokenProcessPool())
        else:
            future.set_result(function(*arguments))
        return future

    def shutdown(self, wait=True, cancel_futures=False):
        pass


def test_tasks_that_are_done_are_not_done_again():
    given: list[list[int]] = []
    assert list(Pool(lambda: Breaking(given)).run(slowly_squared, [(k,) for k in range(4)])) == [0, 1, 4, 9]
    assert given == [[0, 1, 2, 3], [2]]


@pytest.mark.slow
def test_a_task_that_kills_its_worker_three_times_is_an_error(tmp_path):
    with (
        processes(2) as work,
        pytest.raises(IdentificationError, match="workers ended 3 times before task 1 of 1 was done") as told,
    ):
        list(work.run(killed_at_first, [(str(tmp_path), 3, 3)]))
    assert "--workers" in told.value.expected


@pytest.mark.slow
@pytest.mark.parametrize(("from_stdin", "problem"), [(False, "the script starts workers"), (True, "workers end while")])
def test_workers_that_cannot_start_are_told_once(tmp_path, from_stdin, problem):
    """A script without a guard starts workers in its workers; one from standard input cannot be found by them."""
    script = tmp_path / "script.py"
    script.write_text(
        "import math\nfrom identification.errors import IdentificationError\nfrom identification.data import processes\n"
        "try:\n    with processes(2) as work:\n        list(work.run(math.sqrt, [(1.0,)] * 4))\n"
        "except IdentificationError as error:\n    print(type(error).__name__, error)\n"
    )
    with script.open() as text:
        arguments = [sys.executable, "-"] if from_stdin else [sys.executable, str(script)]
        done = subprocess.run(arguments, stdin=text, capture_output=True, text=True, timeout=60)
    assert done.stdout.startswith(f"WorkersNotStartedError {problem}")
    assert done.stdout.count("\n") == 1
    assert '__name__ == "__main__"' in done.stdout
    assert done.stderr == "" or from_stdin


def test_a_cluster_without_dask_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(IdentificationError, match="not installed") as told, cluster("tcp://127.0.0.1:8786"):
        pass
    assert told.value.expected == "pip install 'robot-idim[cluster]'"


def test_a_scheduler_that_does_not_answer_is_one_line(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster_module, "SCHEDULER_TIMEOUT_S", 0.3)
    for address in ("tcp://127.0.0.1:9", "nowhere://x", "tcp://no.such.host.invalid:8786"):
        began = time.monotonic()
        with pytest.raises(IdentificationError, match="no scheduler answers") as told, cluster(address):
            pass
        assert told.value.value == address
        assert "\n" not in str(told.value)
        assert time.monotonic() - began < 10


class Client:
    """What `_check_workers` asks a Dask client."""

    def __init__(self, answers):
        self.answers = answers

    def run(self, function, on_error):
        assert (function, on_error) == (cluster_module.versions, "return")
        return self.answers


@pytest.mark.parametrize(
    ("answers", "told"),
    [
        ({}, "the scheduler has no worker"),
        ({"tcp://b:1": ModuleNotFoundError("No module named 'identification'")}, "worker tcp://b:1: cannot run this package"),
        ({"tcp://b:1": {**cluster_module.versions(), "numpy": "1.0"}}, "worker tcp://b:1: numpy = '1.0': expected "),
    ],
)  # fmt: skip
def test_workers_that_cannot_do_the_work_are_named(answers, told):
    with pytest.raises(IdentificationError, match=told):
        cluster_module._check_workers(
            Client({"tcp://a:1": cluster_module.versions(), **answers} if answers else {}), ""
        )
    cluster_module._check_workers(Client({"tcp://a:1": cluster_module.versions()}), "")
