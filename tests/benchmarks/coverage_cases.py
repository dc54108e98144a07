"""How often the printed 95 % intervals hold the truth: recordings of the independent
simulator, fitted one by one.
"""

from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from conftest import REPLAY
from independent_robots import plant
from independent_simulator import (
    Controller,
    Imperfections,
    described_controller,
    description,
    designed_pd,
    references,
    simulate,
)

from identification.estimation import one_thread
from identification.methods import Iteration
from identification.model import InverseModel, described_parameters
from identification.regression import Overrides
from identification.results import identify_iv, identify_ls

Array = np.ndarray
CHUNK = 20  # runs simulated side by side


@dataclass(frozen=True, kw_only=True)
class Case:
    """A robot, what its cell adds, and how its recordings are fitted; `integral`: the arm is
    under a PI velocity loop; `delay_known`: the delay of the torque is given.
    """

    robot: Literal["emps", "scara", "tx40"]
    what: str
    cell: Imperfections
    method: Literal["iv", "wls"] = "iv"
    duration_s: float = 10.0
    integral: bool = False
    delay_known: bool = False

    @property
    def name(self) -> str:
        return f"{self.robot.upper()} {self.method.replace('wls', 'ls').upper()}, {self.what}"


def axis_cases(robot: Literal["emps", "scara"], unit: float) -> list[Case]:
    """The cases of a robot whose position noise is counted in `unit`, m or rad."""
    quiet = Imperfections(torque_noise_percent=2.0)
    coloured = Imperfections(coloured_noise_percent=2.0)
    by_iv = {
        "noise-free position": quiet,
        "small noise": replace(quiet, encoder_noise=unit),
        f"noise {'20 µm' if robot == 'emps' else '200 µrad'}": replace(
            quiet, encoder_noise=20 * unit
        ),
        "quantisation": replace(quiet, encoder_step=5 * unit),
        "AR(0.98) torque noise": coloured,
        "disturbance in the loop": replace(quiet, disturbance_percent=2.0),
    }
    by_ls = {what: by_iv[what] for what in ("noise-free position", "AR(0.98) torque noise")}
    return [
        *(Case(robot=robot, what=what, cell=cell) for what, cell in by_iv.items()),
        *(Case(robot=robot, what=what, cell=cell, method="wls") for what, cell in by_ls.items()),
    ]


AXES = (*axis_cases("emps", 1e-6), *axis_cases("scara", 1e-5))
ARM = (
    Case(
        robot="tx40", what="white", cell=Imperfections(encoder_noise=1e-5, torque_noise_percent=3.0)
    ),
    Case(
        robot="tx40",
        what="AR(0.98) torque noise",
        cell=Imperfections(encoder_noise=1e-5, coloured_noise_percent=3.0),
    ),
    Case(
        robot="tx40",
        what="PI loop, disturbance",
        cell=Imperfections(encoder_noise=1e-5, torque_noise_percent=1.0, disturbance_percent=2.0),
        integral=True,
    ),
)


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Of the runs of a case those with a fixed point: estimates, ends of intervals and the
    formula's deviations (S, b).
    """

    case: Case
    names: tuple[str, ...]
    true: Array
    beta: Array
    low: Array
    high: Array
    sigma: Array
    runs: int

    @property
    def by_parameter(self) -> Array:
        """(b,) share of runs in percent whose interval holds the truth."""
        return 100 * np.mean((self.low <= self.true) & (self.true <= self.high), axis=0)

    @property
    def whole(self) -> float:
        """The share over all parameters."""
        return float(self.by_parameter.mean())

    @property
    def by_formula(self) -> float:
        """The share of true values within 1.96 of the formula's deviations."""
        return float(100 * np.mean(np.abs(self.beta - self.true) <= 1.96 * self.sigma))

    @property
    def half_over_spread(self) -> Array:
        """(b,) mean half-width over 1.96 deviations of the estimates' errors from run to run."""
        error = self.beta - self.true
        return np.asarray(
            np.mean(self.high - self.low, axis=0) / 2 / (1.96 * np.std(error, axis=0, ddof=1))
        )

    def row(self) -> str:
        """A row of the table in benchmarks/coverage.md."""
        worst, half = int(self.by_parameter.argmin()), self.half_over_spread
        return (
            f"| {self.case.name} | {len(self.beta)} of {self.runs} | {self.whole:.1f} % | "
            f"{self.by_parameter[worst]:.0f} % "
            f"({self.names[worst]}) | {self.by_formula:.0f} % | {np.median(half):.2f} | "
            f"{half.max():.2f} |"
        )


HEADER = (
    "| case | runs | coverage | worst parameter | by the formula | half-width over 1.96 × spread, "
    "median | largest |\n"
    "|---|---|---|---|---|---|---|"
)


def controller_of(case: Case) -> Controller:
    """The described controller, or for the arm, which describes none, a PD; with
    `integral` a PI velocity loop.
    """
    body = plant(REPLAY / case.robot / "robot.toml")
    if case.robot != "tx40":
        return described_controller(body)
    pd = designed_pd(body, 10.0, 1000.0)
    if not case.integral:
        return pd
    return replace(
        pd,
        structure="cascade_p_pi",
        position_gain=pd.position_gain / pd.velocity_gain,
        integral_gain=np.full(body.n, 5.0),
    )


@one_thread
def fits_of(case: Case, seeds: range) -> tuple[tuple[str, ...], Array, list[Array]]:
    """Names and true values of the parameters; estimate, low, high sigma by formula (4, b) of
    runs with a fixed point.
    """
    toml = REPLAY / case.robot / "robot.toml"
    body, controller, robot = plant(toml), controller_of(case), description(toml)
    # The rules of the package, not what reproduces the digits of the axis's authors.
    robot = replace(robot, identification=type(robot.identification)())
    reference = references(body, seeds, duration_s=case.duration_s, rate_hz=controller.rate_hz)
    runs = simulate(body, controller, reference, case.cell, seed=seeds.start)
    # The command of a tick, held until the next. The arm's description has no
    # period that would tell so.
    known = (
        Overrides()
        if robot.controller.sample_rate_hz and not case.delay_known
        else Overrides(torque_lag_s=-0.5 / controller.rate_hz)
    )
    found, names, true = [], (), np.empty(0)
    for k in range(len(seeds)):
        signals = runs.signals(robot, k)
        fit = (
            identify_iv(signals, known, Iteration())
            if case.method == "iv"
            else identify_ls(signals, known)
        )
        names, true = fit.base.names, described_parameters(InverseModel(robot), fit.base)
        if fit.status in ("solved", "converged", "not_confirmed"):
            found.append(
                np.stack([fit.beta, fit.intervals.low, fit.intervals.high, fit.estimate.sigma])
            )
    return names, true, found


def coverage_of(
    case: Case, runs: int, parts: list[tuple[tuple[str, ...], Array, list[Array]]]
) -> Coverage:
    """The runs of a case from parts of them, as `fits_of` gives them."""
    names, true, _ = parts[0]
    beta, low, high, sigma = np.stack([fit for part in parts for fit in part[2]], axis=1)
    return Coverage(
        case=case, names=names, true=true, beta=beta, low=low, high=high, sigma=sigma, runs=runs
    )


def covered(cases: Iterable[Case], runs: int, workers: int) -> Iterable[Coverage]:
    """The cases one by one, each over so many runs, in so many processes."""
    chunks = [range(first, min(runs, first + CHUNK)) for first in range(0, runs, CHUNK)]
    with ProcessPoolExecutor(workers) as pool:
        waiting = [
            (case, [pool.submit(fits_of, case, chunk) for chunk in chunks]) for case in cases
        ]
        for case, futures in waiting:
            parts = [future.result() for future in futures]
            yield coverage_of(case, runs, parts)
