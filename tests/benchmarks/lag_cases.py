"""Coverage of the printed 95 % intervals where nobody states how late the torque is, beside the same with the lag stated.

Commands are recorded at their tick, none to 2.5 samples late. A third of the recordings comes with the description of the
controller, a third without, and in a third the command acts 0.3, 1 or 2 ms after its tick.
"""

from collections import defaultdict
from collections.abc import Iterable
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from conftest import REPLAY
from hunt import fit_by_default
from independent_robots import plant
from independent_simulator import (
    Imperfections,
    described_controller,
    description,
    designed_pd,
    references,
    simulate,
    timing_not_stated,
    without_control_law,
    without_settings,
)

from identification.estimation import one_thread
from identification.methods import Fit
from identification.model import InverseModel, described_parameters
from identification.regression import Overrides

Array = np.ndarray
LAGS = (0.0, 1.0, 2.0, 2.5)  # samples
DELAYS_S = (3e-4, 1e-3, 2e-3)
MOST = 20  # runs simulated side by side


@dataclass(frozen=True, kw_only=True)
class LagCase:
    """A robot and the noise in its cell."""

    robot: str
    noise: str
    cell: Imperfections

    @property
    def name(self) -> str:
        return f"{self.robot.upper()}, {self.noise}"


def cases_of(robot: str, unit: float) -> list[LagCase]:
    """The noises of a robot whose encoder counts in `unit`, m or rad."""
    white = Imperfections(encoder_noise=unit, torque_noise_percent=2.0)
    cells = {
        "white": white,
        "AR(0.98)": replace(white, torque_noise_percent=0.0, coloured_noise_percent=2.0),
        "ten counts": replace(white, encoder_noise=10 * unit, encoder_step=unit),
        "disturbance in the loop": replace(white, disturbance_percent=2.0),
    }
    return [LagCase(robot=robot, noise=noise, cell=cell) for noise, cell in cells.items()]


AXES = (*cases_of("emps", 1e-6), *cases_of("scara", 1e-5))
ARM = (LagCase(robot="tx40", noise="white", cell=Imperfections(encoder_noise=1e-5, torque_noise_percent=3.0)),)


@dataclass(frozen=True, kw_only=True)
class Run:
    """How one recording is made; `control`: the fit knows the control law."""

    seed: int
    lag: float
    delay_s: float
    control: bool


def runs_of(count: int) -> list[Run]:
    """Lags, thirds and delays in turn."""
    return [
        Run(
            seed=9000 + k,
            lag=LAGS[k // 3 % len(LAGS)],
            delay_s=DELAYS_S[k // 12 % len(DELAYS_S)] if k % 3 == 2 else 0.0,
            control=k % 3 != 1,
        )
        for k in range(count)
    ]


Ends = Array | None  # low, high (2, b) of the intervals; None where the fit has no fixed point


def ends(fit: Fit) -> Ends:
    fixed = fit.status in ("solved", "converged", "not_confirmed")
    return np.stack([fit.intervals.low, fit.intervals.high]) if fixed else None


@one_thread
def ends_of(case: LagCase, runs: list[Run]) -> tuple[tuple[str, ...], Array, list[tuple[Ends, Ends]]]:
    """Names and true values of the parameters; intervals of runs of one lag and delay, the lag estimated and stated."""
    toml = REPLAY / case.robot / "robot.toml"
    body = plant(toml)
    controller = designed_pd(body, 10.0, 1000.0) if case.robot == "tx40" else described_controller(body)
    robot = without_settings(description(toml, controller if case.robot == "tx40" else None))
    path = references(body, [run.seed for run in runs], duration_s=10.0, rate_hz=controller.rate_hz)
    cell = replace(case.cell, lag=runs[0].lag, actuation_delay_s=runs[0].delay_s)
    made, found = simulate(body, controller, path, cell, seed=runs[0].seed), []
    names, true, stated = (), np.empty(0), Overrides(torque_lag_s=cell.lag_s(controller.rate_hz))
    for k, run in enumerate(runs):
        signals = made.signals(robot if run.control else without_control_law(robot), k, timing_not_stated())
        fits = [fit_by_default(signals, overrides) for overrides in (Overrides(), stated)]
        names, true = fits[0].base.names, described_parameters(InverseModel(robot), fits[0].base)
        found.append((ends(fits[0]), ends(fits[1])))
    return names, true, found


@dataclass(frozen=True, kw_only=True)
class LagCoverage:
    """Of a case: shares in percent of intervals that hold the truth, by parameter (b,), with the lag estimated and stated.

    width: median of the half-widths over those with the lag stated. fixed: share of the fits with a fixed point.
    """

    case: LagCase
    names: tuple[str, ...]
    by_parameter: Array
    stated: Array
    width: float
    fixed: float
    runs: int

    @property
    def whole(self) -> float:
        return float(self.by_parameter.mean())

    @property
    def row(self) -> str:
        worst = int(self.by_parameter.argmin())
        return (
            f"| {self.case.name} | {self.runs} | {self.whole:.1f} % | {self.by_parameter[worst]:.0f} % ({self.names[worst]}) "
            f"| {self.stated.mean():.1f} % | {self.width:.3f} | {self.fixed:.0f} % |"
        )


HEADER = (
    "| case | runs | coverage | worst parameter | lag stated | half-width over that of a stated lag | fixed point |\n"
    "|---|---|---|---|---|---|---|"
)


def coverage_of(case: LagCase, parts: list[tuple[tuple[str, ...], Array, list[tuple[Ends, Ends]]]]) -> LagCoverage:
    names, true, _ = parts[0]
    pairs = [pair for part in parts for pair in part[2]]

    def share(which: int) -> Array:
        inside = [(e[0] <= true) & (true <= e[1]) for pair in pairs if (e := pair[which]) is not None]
        return 100 * np.mean(inside, axis=0) if inside else np.zeros(len(true))

    widths = [np.ptp(a, axis=0) / np.ptp(b, axis=0) for a, b in pairs if a is not None and b is not None]
    return LagCoverage(
        case=case,
        names=names,
        by_parameter=share(0),
        stated=share(1),
        width=float(np.median(widths)) if widths else np.nan,
        fixed=float(100 * np.mean([pair[0] is not None for pair in pairs])),
        runs=len(pairs),
    )


def lag_coverages(cases: Iterable[LagCase], count: int, workers: int | None) -> Iterable[LagCoverage]:
    """The cases one by one, each over so many recordings."""
    alike = defaultdict(list)
    for run in runs_of(count):
        alike[run.lag, run.delay_s].append(run)
    batches = [runs[k : k + MOST] for runs in alike.values() for k in range(0, len(runs), MOST)]
    with ProcessPoolExecutor(workers) as pool:
        waiting: list[tuple[LagCase, list[Future]]] = [
            (case, [pool.submit(ends_of, case, batch) for batch in batches]) for case in cases
        ]
        for case, futures in waiting:
            yield coverage_of(case, [future.result() for future in futures])
