"""Robots, recordings and the real data that tests share."""

import os
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from made_up_recordings import write
from threadpoolctl import threadpool_limits

from acquisition.commands import main as acquire
from acquisition.importing import import_tables
from acquisition.robot import Robot, load_robot
from identification.commands import main as identify
from identification.model import InverseModel

pytest_plugins = ["slow_tests"]
os.environ.pop("COLUMNS", None)  # workers of xdist have 80
# However long this machine takes for an example.
hypothesis.settings.register_profile(
    "busy", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("busy")
ROOT = Path(__file__).resolve().parents[1]
REPLAY = ROOT / "replay_data"
ACQUIRE, IDENTIFY = acquire.__self__, identify.__self__  # whose method each is
PROGRAMS = {"acquisition": ACQUIRE, "identification": IDENTIFY}
# Of m, mx, my, mz, xx, xy, yy, xz, yz, zz, in the order XX, XY, XZ, YY, YZ, ZZ, MX, MY, MZ, M.
FROM_PINOCCHIO = [4, 5, 7, 6, 8, 9, 1, 2, 3, 0]
DATA = ROOT.parent / "shared" / "data"
RECORDS = {"emps": ("DATA_EMPS.mat",), "tx40": ("pos_read_data.csv", "curr_data.csv")}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("benchmark_enable", False):
        skip = pytest.mark.skip(
            reason="a benchmark: run `pytest tests/benchmarks -s --benchmark-enable`"
        )
        for item in items:
            if "benchmarks" in item.path.parts:
                item.add_marker(skip)


def pytest_configure() -> None:
    """One thread for matrices, as in a fit: of two processes on two cores, the threads of
    each wait for the other's.
    """
    threadpool_limits(1)
    # of libraries loaded later, and of processes that tests start
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@pytest.fixture(autouse=True)
def own_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    """`view --follow` in this process would leave every later test behind all other processes."""
    monkeypatch.setattr(os, "nice", lambda by: 0)


def robot_named(name: str) -> Robot:
    return load_robot(REPLAY / name / "robot.toml")


def described_chi(dynamics: InverseModel) -> np.ndarray:
    """Standard parameters (p,) of the description's `[parameters]`."""
    return np.array([dynamics.robot.parameters.get(name, 0.0) for name in dynamics.names])


def needs_data(*parts: str) -> Path:
    path = DATA.joinpath(*parts)
    if not path.exists():
        pytest.skip(
            f"real recording not here: ../shared/data/{'/'.join(parts)} (see replay_data/README.md)"
        )
    return path


@pytest.fixture(scope="session")
def robot() -> Robot:
    """The SCARA."""
    return robot_named("scara")


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory, robot: Robot) -> Path:
    """A small recording of the SCARA with something of everything, whole."""
    path = tmp_path_factory.mktemp("recording") / "whole.mcap"
    write(path, robot)
    return path


def imported(name: str, out: Path) -> Path:
    """The real record of a robot as a recording."""
    import_tables(
        [DATA / name / part for part in RECORDS[name]],
        robot_named(name),
        REPLAY / name / "map.toml",
        out,
    )
    return out


def imported_for_tests(name: str, factory: pytest.TempPathFactory) -> Path:
    for part in RECORDS[name]:
        needs_data(name, part)
    return imported(name, factory.mktemp(name) / f"{name}.mcap")


@pytest.fixture(scope="session")
def emps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return imported_for_tests("emps", tmp_path_factory)


@pytest.fixture(scope="session")
def tx40(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return imported_for_tests("tx40", tmp_path_factory)
