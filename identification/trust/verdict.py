"""The whole trust block: every test, what was assumed, and witnesses of a sign that is wrong."""

from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np
from msgspec import structs

from ..report import Assumed, TrustLine, is_own
from . import columns, drives, efforts, physical, predictions, solution
from .drives import LAW, payload_assumptions
from .efforts import turned_sign
from .evidence import LEVELS, FitData, Trust, part_of
from .predictions import HELD_OUT
from .words import assume

MAX_SHORT_S = 100.0  # of motion: beyond, the error of the filters is as large as that of noise
CAUSES = "saturation", "rows", "added columns"  # of no fixed point, by what they find
MAX_WITNESS_PERCENT = 20.0  # held-out error: more is that of another robot
MAX_WITNESS_RATIO = 0.95  # of the torque errors with a sign turned and as it is


def list_assumptions(evidence: FitData, lines: Mapping[str, TrustLine]) -> Iterator[Assumed]:
    """Assumptions that no test covers, by the lines of tests."""
    signals, robot, several = evidence.problem.signals, evidence.robot, evidence.robot.n > 1
    fs, iv, law, lag = signals.sample_rate_hz, evidence.method == "iv", lines[LAW], lines.get("lag")
    gains = [
        f"{m.drive_gain:g} {m.drive_gain_unit}" for m in robot.motors if m.drive_gain is not None
    ]
    duration_s = len(evidence.observed.tau) * evidence.problem.settings.decimation / fs
    holds = {
        "drive gains": robot.gain_known and not evidence.gains,
        "efforts": True,
        "own parameters": any(map(is_own, evidence.estimate.names)),
        "ratios": True,
        "lengths": several,
        "sample rate": True,
        "control law": iv and evidence.ending != "by reference" and law.level == "not made",
        "lag": lag is not None and lag.case in ("stated", "contradicted"),
        "filters": duration_s > MAX_SHORT_S,
        "encoder noise": not iv,
    }
    said = {
        "gains": ", ".join(gains),
        "recorded": not gains,
        "units": " and ".join(sorted({m.recorded_unit for m in robot.motors})),
        "common": several,
        "ratios": ", ".join(f"{x:g}" for x in np.diag(robot.R)),
        "lengths": "dh" if robot.urdf is None else "urdf",
        "fs": fs,
        "law": robot.controller.structure or "",
        "default": not robot.controller.structure,
        "bandwidth_hz": robot.bandwidth_hz,
        "reason": law.text.removeprefix("not made: "),
        "lag": "".join(f"{x.value_s:g} s" for x in evidence.lags[:1]),
        "unseen": False,
        "duration_s": duration_s,
    }
    yield from payload_assumptions(evidence)
    yield from (assume(what, **said) for what, it in holds.items() if it)


def made_before(test: str) -> Callable[[FitData], TrustLine | None]:
    """A test whose line was made with the solution or with its predictions."""
    return lambda evidence: evidence.made.get(test)


# A test is a function of the fit's data, None where it does not apply. A new one is a line here,
# and a row of words.
TESTS: tuple[Callable[[FitData], TrustLine | None], ...] = (
    efforts.signs_and_order_test,
    efforts.saturation_test,
    efforts.positions_test,
    drives.gains_test,
    drives.centre_of_mass_test,
    made_before("fixed point"),
    physical.physical_test,
    solution.units_test,
    predictions.prior_test,
    solution.motion_test,
    solution.rows_test,
    made_before(LAW),
    solution.halves_test,
    solution.excitation_test,
    drives.lag_test,
    columns.added_columns_test,
    made_before(HELD_OUT),
    physical.consistent_test,
    solution.ends_test,
    solution.essential_test,
    solution.instruments_test,
    made_before("position noise"),
    efforts.effort_test,
)


def trust_in(evidence: FitData) -> Trust:
    """All tests of an estimate, worst first, and the assumptions: `do not use` if M is not positive
    and the held-out blocks fail, or if the parameters are far from those of a robot and a witness
    says why.
    """
    lines = {line.test: line for test in TESTS if (line := test(evidence)) is not None}
    held, of_robot = lines[HELD_OUT], lines["physical"]
    if held.case == "far off" and (of_robot.value or 0.0) <= 0:
        text = part_of(HELD_OUT, "not positive", text=held.text)
        lines[HELD_OUT] = structs.replace(held, level=LEVELS[0], text=text)
    if of_robot.level != LEVELS[0] and (found := _witness(evidence, lines)):
        text = part_of("physical", "far", text=of_robot.text, witness=found)
        lines["physical"] = structs.replace(
            of_robot, level=LEVELS[0], text=text, finding=of_robot.finding or found
        )
    fixed, causes = lines.get("fixed point"), (lines.get(test) for test in CAUSES)
    known = (x.finding for x in causes if x is not None and x.level in LEVELS[:2] and x.finding)
    if fixed is not None and fixed.level in LEVELS[:2] and (cause := next(known, "")):
        why = fixed.text.partition(": check")[0]
        text = part_of("fixed point", "caused", text=why, cause=cause)
        lines["fixed point"] = structs.replace(fixed, text=text, finding=cause)
    of_lines = (one for line in lines.values() for one in line.assumed)
    assumed = *list_assumptions(evidence, lines), *of_lines
    each = [structs.replace(line, assumed=()) for line in lines.values()]
    return Trust(lines=worst_first(each), assumed=assumed)


def _witness(evidence: FitData, lines: Mapping[str, TrustLine]) -> str:
    """What else tells that parameters are wrong that are far from those of a physical robot: a
    negative factor of the prior, a sign that fits better turned, or a large held-out error; "" for
    nothing.
    """
    consistent, prior = lines.get("consistent"), lines.get("prior")
    if (lines["physical"].value or 0.0) > 0 and (consistent is None or consistent.case != "far"):
        return ""
    held = lines[HELD_OUT].value or 0.0
    if prior is not None and any((x or 0.0) + (half or 0.0) < 0 for _, x, half, _ in prior.figures):
        return prior.finding
    ratio, mistake = turned_sign(evidence, range(evidence.robot.n))
    if ratio < MAX_WITNESS_RATIO:
        return mistake
    # a wrong sign of a lone axis changes no error
    return f"{held:.2g} % held out" * (held > MAX_WITNESS_PERCENT and evidence.robot.n > 1)


def worst_first(lines: Iterable[TrustLine]) -> tuple[TrustLine, ...]:
    """Lines sorted by level."""
    return tuple(sorted(lines, key=lambda line: LEVELS.index(line.level)))
