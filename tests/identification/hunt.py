"""Fits of set-ups whose truth is known, and how they count: verdict, whether the fault is named,
whether a value is off.
"""

import zlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from hunt_kinds import ASSUMED, CLEAN, CORRECTED, KINDS, Kind, SetUp, cell_of, sound, white

from identification.data import Signals
from identification.errors import RobotIdimError
from identification.estimation import one_thread
from identification.methods import Iteration
from identification.model import InverseModel, base_parameters
from identification.regression import Overrides
from identification.results import Evidence, identify_iv, identify_ls

HALF_WIDTHS, PERCENT = 3.0, 2.0  # an essential parameter that is further off than both is harmed


def fit_by_default(signals: Signals, overrides: Overrides | None = None) -> Evidence:
    """By the method that the package takes where none is asked for."""
    given = overrides or Overrides()
    return (
        identify_ls(signals, given)
        if signals.q_ref is None
        else identify_iv(signals, given, Iteration())
    )


@cache
def clean(name: str) -> Evidence:
    """Of white noise alone."""
    return fit_by_default(white(name).recording(3))


def fit_by_least_squares(signals: Signals) -> Evidence:
    return identify_ls(signals, Overrides())


@lru_cache
def true_values(name: str) -> dict[str, float]:
    """Base parameters by name, that fit the simulator's torques of fast motion."""
    body, _, robot = cell_of(name)
    model, rng = InverseModel(robot), np.random.default_rng(0)
    base = base_parameters(model)
    q, ddq = rng.uniform(-2, 2, (100, body.n)), rng.uniform(-9, 9, (100, body.n))
    dq = rng.uniform(2, 3, q.shape) * rng.choice([-1, 1], q.shape)
    dq[:, 1::2] *= 2.5  # so that no sum of two is slow
    W = model.regressor(q, dq, ddq)[:, :, base.columns].reshape(-1, base.b)
    tau = body.inverse(q, dq, ddq).ravel()
    values, *_ = np.linalg.lstsq(W, tau)
    np.testing.assert_allclose(W @ values, tau, atol=1e-6 * np.abs(tau).max())
    return dict(zip(base.names, values.tolist(), strict=True))


def is_harmed(fit: Evidence, name: str) -> bool:
    """Whether an essential parameter is off by over 3 half-widths and 2 % of its value."""
    true, essential = true_values(name), set(fit.essential.names)
    found = zip(fit.estimate.names, fit.estimate.beta, fit.intervals.half, strict=True)
    off = (
        (abs(beta - true[key]), half, abs(true[key]))
        for key, beta, half in found
        if key in essential
    )
    return any(error > max(HALF_WIDTHS * half, 0.01 * PERCENT * size) for error, half, size in off)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Of a fit: its verdict, or `refused`; whether the fault is named, a value harmed; the test
    that the user reads first.
    """

    verdict: str
    named: bool
    harmed: bool
    first: str

    @property
    def false_trust(self) -> bool:
        return self.harmed and self.verdict == "trust"


def outcome_of(fit_by, signals: Signals, name: str, kind: Kind) -> Outcome:
    try:
        fit = fit_by(signals)
    except RobotIdimError as error:
        named = any(test == "" and part in str(error) for test, part in kind.named)
        return Outcome(verdict="refused", named=named, harmed=False, first="refused")
    lines = fit.trust.lines
    bad = [line for line in lines if line.level in ("do not use", "caution")]
    named = any(
        test in ("", line.test) and part in line.text
        for test, part in kind.named
        for line in (lines if part == CORRECTED else bad)
    ) or any((ASSUMED, one.what) in kind.named for one in fit.trust.assumed)
    first = [*(line.test for line in bad), ""][0]
    return Outcome(verdict=fit.trust.verdict, named=named, harmed=is_harmed(fit, name), first=first)


def both_outcomes(setup: SetUp, seed: int, kind: Kind = CLEAN) -> tuple[Outcome, Outcome]:
    """By the default method, and by least squares of the same recording."""
    signals = setup.recording(seed)
    return tuple(
        outcome_of(by, signals, setup.name, kind) for by in (fit_by_default, fit_by_least_squares)
    )


@one_thread
def outcomes_of(what: str, name: str, seed: int) -> tuple[Outcome, Outcome]:
    """Of a set-up of a kind of fault, or of a `clean` one, drawn by the seed."""
    kind = KINDS.get(what, CLEAN)
    rng = np.random.default_rng([zlib.crc32(what.encode()), seed, len(name)])
    return both_outcomes(kind.change(sound(name, rng), rng), 5000 + seed, kind)


NOISES = ("white", "quantised", "AR(0.9)")


@one_thread
def outcomes_of_noise(noise: str, deviation: float, seed: int) -> tuple[Outcome, Outcome]:
    """Of the axis with noise of the position of this deviation in m; rounding has that of a step of
    the root of 12 times it.
    """
    setup = sound("emps", np.random.default_rng(seed)).in_cell(
        encoder_noise=0.0 if noise == "quantised" else deviation,
        encoder_step=np.sqrt(12) * deviation if noise == "quantised" else 0.0,
        encoder_correlation=0.9 if noise == "AR(0.9)" else 0.0,
        torque_noise_percent=1.0,
        coloured_noise_percent=0.0,
    )
    return both_outcomes(setup, 7000 + seed)


HEADER = (
    "| fault | not `trust` | named rightly | harmed | false trust | what the user is told first |\n"
    "|---|---|---|---|---|---|"
)


def row(what: str, found: Iterable[tuple[Outcome, Outcome]], named: bool = True) -> str:
    """A row of the table: by the default method · by least squares."""
    methods = list(zip(*found, strict=True))

    def counted(name: str) -> str:
        return " · ".join(str(sum(getattr(x, name) for x in each)) for each in methods)

    def distrusted(each: tuple[Outcome, ...]) -> str:
        refused = sum(x.verdict == "refused" for x in each)
        text = f"{sum(x.verdict != 'trust' for x in each)}/{len(each)}"
        return f"{text} ({refused} refused)" if refused else text

    firsts = (
        ", ".join(
            f"{test} {times}"
            for test, times in Counter(x.first for x in each if x.first).most_common(3)
        )
        for each in methods
    )
    cells = (
        what,
        " · ".join(map(distrusted, methods)),
        counted("named") if named else "- · -",
        counted("harmed"),
    )
    return (
        f"| {' | '.join(cells)} | {counted('false_trust')} | "
        f"{' · '.join(x or '-' for x in firsts)} |"
    )
