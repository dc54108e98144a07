"""The whole trust block: every test, what was assumed, and witnesses of a sign that is wrong."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from msgspec import structs

from ..report import Assumed, TrustResult, Verdict, is_own
from . import columns, drives, efforts, gains, physical, predictions, prior, rows, solution
from .evidence import LEVELS, TrustInputs, Words, assume

MAX_SHORT_S = 100.0  # of motion: beyond, the error of the filters is as large as that of noise
CAUSES = "saturation", "rows", "missing terms"  # of no fixed point, by what they find
MAX_WITNESS_PERCENT = 20.0  # held-out error: more is that of another robot
MAX_WITNESS_RATIO = 0.95  # of the torque errors with a sign turned and as it is


@dataclass(frozen=True, kw_only=True)
class Trust:
    """All tests of a fit, worst first, and the assumptions that no test confirms.

    A skipped test does not count.
    """

    lines: tuple[TrustResult, ...]
    assumed: tuple[Assumed, ...] = ()

    def line(self, test: str) -> TrustResult:
        """Return the result of a test."""
        return next(line for line in self.lines if line.test == test)

    @cached_property
    def verdict(self) -> Verdict:
        """The worst level."""
        worst = self.lines[0].level
        return worst if worst == "do not use" or worst == "caution" else "trust"


def list_assumptions(evidence: TrustInputs, lines: Mapping[str, TrustResult]) -> Iterator[Assumed]:
    """List the assumptions that no test confirms, by the results of tests."""
    signals, robot, several = evidence.problem.signals, evidence.robot, evidence.robot.n > 1
    fs, iv = signals.sample_rate_hz, evidence.method == "iv"
    law, lag = lines["control law"], lines.get("delay")
    stated = [
        f"{m.drive_gain:g} {m.drive_gain_unit}" for m in robot.motors if m.drive_gain is not None
    ]
    duration_s = len(evidence.observed.tau) * evidence.problem.settings.decimator.factor / fs
    holds = {
        "drive gains": robot.gain_known and not evidence.gains,
        "efforts": True,
        "per-recording parameters": any(map(is_own, evidence.estimate.names)),
        "gear ratios": True,
        "link lengths": several,
        "sample rate": True,
        "control law": iv and evidence.ending != "by reference" and law.level == "skipped",
        "delay": lag is not None and lag.case in ("stated", "contradicted"),
        "filters": duration_s > MAX_SHORT_S,
        "encoder noise": not iv,
    }
    said = {
        "gains": ", ".join(stated),
        "recorded": not stated,
        "units": " and ".join(sorted({m.recorded_unit for m in robot.motors})),
        "common": several,
        "ratios": ", ".join(f"{x:g}" for x in np.diag(robot.R)),
        "lengths": "dh" if robot.urdf is None else "urdf",
        "fs": fs,
        "law": robot.controller.structure or "",
        "default": not robot.controller.structure,
        "bandwidth_hz": robot.bandwidth_hz,
        "reason": law.text,
        "lag": "".join(f"{x.value_s:g} s" for x in evidence.lags[:1]),
        "unseen": False,
        "duration_s": duration_s,
    }
    yield from gains.payload_assumptions(evidence)
    yield from (assume(what, **said) for what, it in holds.items() if it)


# Each file has tests as functions of the fit's data, with their rows below them.
FILES = efforts, gains, rows, drives, solution, physical, prior, columns, predictions
# Tests of the data come first, because a fault of the data explains other findings.
WORDS: Mapping[str, Words] = {
    row.test: row
    for row in sorted(
        (row for file in FILES for row in vars(file).values() if isinstance(row, Words)),
        key=lambda row: (not row.of_data, row.place),
    )
}


def trust_in(evidence: TrustInputs) -> Trust:
    """Return all tests of an estimate, worst first, and the assumptions.

    The result is `do not use` if M is not positive and cross-validation fails, or if the parameters
    are far from those of a physically consistent robot and a second sign confirms this.
    """
    lines = {
        row.test: line
        for row in sorted(WORDS.values(), key=lambda row: row.place)
        if (line := row.line(evidence)) is not None
    }
    held, of_robot = lines["cross-validation"], lines["physical plausibility"]
    if held.case == "far off" and (of_robot.value or 0.0) <= 0:
        text = WORDS["cross-validation"].part("not positive", text=held.text)
        lines["cross-validation"] = structs.replace(
            held, level=LEVELS[0], text=text, advice="Fit with --consistent."
        )
    if of_robot.level != LEVELS[0] and (found := _witness(evidence, lines)):
        text = WORDS["physical plausibility"].part("far", text=of_robot.text, witness=found)
        lines["physical plausibility"] = structs.replace(
            of_robot, level=LEVELS[0], text=text, finding=of_robot.finding or found
        )
    fixed, causes = lines.get("convergence"), (lines.get(test) for test in CAUSES)
    known = (x.finding for x in causes if x is not None and x.level in LEVELS[:2] and x.finding)
    if fixed is not None and fixed.level in LEVELS[:2] and (cause := next(known, "")):
        text = WORDS["convergence"].part("caused", text=fixed.text, cause=cause)
        lines["convergence"] = structs.replace(fixed, text=text, advice="", finding=cause)
    return Trust(
        lines=worst_first(structs.replace(line, assumed=()) for line in lines.values()),
        assumed=(
            *list_assumptions(evidence, lines),
            *(one for line in lines.values() for one in line.assumed),
        ),
    )


def _witness(evidence: TrustInputs, lines: Mapping[str, TrustResult]) -> str:
    """Return a second sign that parameters far from a physically consistent model are wrong.

    The text is "" if there is no such sign. Such signs are a negative factor of the a priori links,
    an effort sign that fits better reversed, or a large held-out error.
    """
    consistent, of_prior = lines.get("physically consistent"), lines.get("a priori links")
    if (lines["physical plausibility"].value or 0.0) > 0 and (
        consistent is None or consistent.case != "far"
    ):
        return ""
    held = lines["cross-validation"].value or 0.0
    if of_prior is not None and any(
        (x or 0.0) + (half or 0.0) < 0 for _, x, half, _ in of_prior.figures
    ):
        return of_prior.finding
    ratio, mistake = efforts.turned_sign(evidence, range(evidence.robot.n))
    if ratio < MAX_WITNESS_RATIO:
        return mistake
    # The sign of a single axis does not change its error, so a large held-out error proves nothing
    # there.
    return f"{held:.2g} % held out" * (held > MAX_WITNESS_PERCENT and evidence.robot.n > 1)


def worst_first(lines: Iterable[TrustResult]) -> tuple[TrustResult, ...]:
    """Sort results by level."""
    return tuple(sorted(lines, key=lambda line: LEVELS.index(line.level)))
