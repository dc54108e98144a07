"""Speed and memory of identification, beside a floor taken in the same run.

Figures stand in identify_speed.md.

Run with `pytest tests/benchmarks -s --benchmark-enable`. The floor is a bare loop of pinocchio's
`computeJointTorqueRegressor` over the same samples: no result is kept.
"""

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin
from conftest import described_chi, robot_named

from acquisition.recording import Header, RecordingWriter, sample_dtype
from acquisition.robot import fourier_reference
from identification.data import Work, load_signals
from identification.methods import Iteration
from identification.model import InverseModel, base_parameters, described_parameters, direct_model
from identification.regression import Overrides
from identification.results import identify_iv, identify_ls
from identification.study import Study, run_study

SAMPLES = 45_000


def floor(
    dynamics: InverseModel, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray
) -> Callable[[], None]:
    model, data, compute = (
        dynamics.model,
        dynamics.model.createData(),
        pin.computeJointTorqueRegressor,
    )

    def run() -> None:
        for k in range(len(q)):
            compute(model, data, q[k], dq[k], ddq[k])

    return run


def floor_of_passes(dynamics: InverseModel, q: np.ndarray, passes: int) -> Callable[[], None]:
    """Bare loops of computeJointTorqueRegressor and of aba over the samples, as
    often as there are passes.
    """
    base = base_parameters(dynamics)
    model = direct_model(dynamics, base.standard_parameters(described_parameters(dynamics, base)))
    regressors, data = floor(dynamics, q, q, q), model.rigid.createData()

    def run() -> None:
        for _ in range(passes):
            regressors()
            for qk in q:
                pin.aba(model.rigid, data, qk, qk, qk)

    return run


def ratio(
    run: Callable[[], object], beside: Callable[[], object], *, rounds: int = 9
) -> tuple[float, float]:
    """Median over alternate rounds of run/beside, and the median time of `beside` in s."""
    for warm in (run, beside):
        warm()
    ratios, floors = [], []
    for _ in range(rounds):
        times = []
        for part in (run, beside):
            start = time.perf_counter()
            part()
            times.append(time.perf_counter() - start)
        ratios.append(times[0] / times[1])
        floors.append(times[1])
    return float(np.median(ratios)), float(np.median(floors))


def test_regressor():
    dynamics = InverseModel(robot_named("tx40"))
    base = base_parameters(dynamics)
    q, dq, ddq = np.random.default_rng(0).uniform(-3, 3, size=(3, SAMPLES, 6))
    found, floor_s = ratio(
        lambda: dynamics.series(q, dq, ddq, base.columns), floor(dynamics, q, dq, ddq)
    )
    print(
        f"\nregressor, {SAMPLES} x 6, 60 columns: {found:.2f} x the floor of {floor_s:.3f} s "
        "(bound 1.4)"
    )


def test_tx40_ls_fit(tx40):
    signals = load_signals(tx40)
    dynamics = InverseModel(signals.robot)
    q = np.ascontiguousarray(signals.q)
    found, floor_s = ratio(
        lambda: identify_ls(load_signals(tx40), Overrides()), floor(dynamics, q, q, q)
    )
    print(f"\nfit, MCAP to estimate: {found:.2f} x the floor of {floor_s:.3f} s (bound 5)")


def test_tx40_iv_fit(tx40):
    signals = load_signals(tx40)
    dynamics = InverseModel(signals.robot)
    passes = len(identify_iv(signals, Overrides(), Iteration()).passes)
    floor_of_the_passes = floor_of_passes(dynamics, np.ascontiguousarray(signals.q), passes)
    found, floor_s = ratio(
        lambda: identify_iv(load_signals(tx40), Overrides(), Iteration()),
        floor_of_the_passes,
        rounds=5,
    )
    print(
        f"\niv, MCAP to estimate, {passes} passes: {found:.2f} x the floor of {floor_s:.3f} s "
        "(bound 1)"
    )


def hour_long_recording(path: Path, seconds: int = 3600) -> None:
    """One hour at 1 kHz of the simulated TX40, noise on the torque, written block by block."""
    robot = robot_named("tx40")
    dynamics = InverseModel(robot)
    chi, columns = described_chi(dynamics), np.arange(dynamics.p)
    entries = dynamics.entries(columns)
    reference = fourier_reference(robot, period_s=20.0, seed=1)
    rng = np.random.default_rng(0)
    with RecordingWriter(
        path,
        Header(
            robot=robot, source="simulated", sample_rate_hz=1000.0, effort_provenance="simulated"
        ),
    ) as writer:
        for second in range(0, seconds, 5):
            k = np.arange(second * 1000, (second + 5) * 1000)
            q, dq, ddq = reference.at(k * 1e-3)
            block = np.zeros(len(k), sample_dtype(6, reference=False))
            block["stamp_ns"], block["position"] = k * 1_000_000, q
            terms = dynamics.series(q, dq, ddq, columns) * chi[entries[:, 1], None]
            for j in range(6):
                block["effort"][:, j] = terms[entries[:, 0] == j].sum(axis=0) + rng.standard_normal(
                    len(k)
                )
            for part in np.array_split(block, 5):
                writer.samples(part)


def cpu_s(*command: object) -> float:
    """CPU time of a process, its children included, with compiled modules at hand as an
    installation has them.
    """
    environment = {
        name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"
    }
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [str(part) for part in command], check=True, capture_output=True, env=environment
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_tx40_command_line(tx40):
    """The command line from start to end, beside the imports that it cannot do without and
    the floor of its passes.
    """
    signals = load_signals(tx40)
    dynamics = InverseModel(signals.robot)
    q = np.ascontiguousarray(signals.q)
    passes = floor_of_passes(
        dynamics, q, len(identify_iv(signals, Overrides(), Iteration()).passes)
    )
    fit = (sys.executable, "-m", "identification", "fit", tx40, "--method")
    everything = "import identification as i; i.fit, i.identify_iv, i.load_signals"
    cases = {
        "import of numpy and pinocchio": lambda: cpu_s(sys.executable, "-c", "import pinocchio"),
        "import identification": lambda: cpu_s(sys.executable, "-c", "import identification"),
        "the same and all names used": lambda: cpu_s(sys.executable, "-c", everything),
        "fit by wls": lambda: cpu_s(*fit, "wls"),
        "fit by iv": lambda: cpu_s(*fit, "iv"),
        "floor of the passes of iv": lambda: timed(passes),
    }
    found = {name: [] for name in cases}
    for run in cases.values():
        run()
    for _ in range(5):
        for name, run in cases.items():
            found[name].append(run())
    for name, times in found.items():
        print(f"\n{name}: {np.median(times):.2f} s of CPU", end="")
    pairs = zip(found["fit by iv"], found["floor of the passes of iv"], strict=True)
    print(
        f"\nfit by iv, whole process: {np.median([a / b for a, b in pairs]):.2f} x the floor of "
        "its passes (bound 2.2)"
    )


def timed(run: Callable[[], object]) -> float:
    start = time.process_time()
    run()
    return time.process_time() - start


def test_study_runs():
    """Of each robot, beside the floor of bare `aba` at the steps of the simulated recording."""
    for name in ("emps", "tx40"):
        robot = robot_named(name)
        runs = run_study(robot, Study(runs=6), Work())
        times = [timed(partial(next, runs)) for _ in range(6)]
        print(f"\nstudy run of {name}: {np.median(times):.2f} s of CPU", end="")


def test_one_hour_fit(tmp_path):
    path = tmp_path / "hour.mcap"
    hour_long_recording(path)
    dynamics = InverseModel(robot_named("tx40"))
    q, dq, ddq = np.random.default_rng(0).uniform(-3, 3, size=(3, 100_000, 6))
    bare = floor(dynamics, q, dq, ddq)
    before_s = timed(bare)
    took_s = cpu_s(
        sys.executable, "-m", "identification", "fit", path, "--json", tmp_path / "fit.json"
    )
    peak_gb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
    floor_s = 36 * 0.5 * (before_s + timed(bare))
    print(
        f"\nfit of one hour at 1 kHz, 3.6 million samples x 6: peak {peak_gb:.2f} GB (bound 1)",
        end="",
    )
    print(f", {took_s / floor_s:.2f} x the floor of {floor_s:.1f} s (bound 3)")
