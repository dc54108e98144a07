"""Tests of the solution: fixed point, instruments, parts of the rows; and the whole trust block.

Nothing is simulated again.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from .. import estimation
from ..arrays import Array
from ..data import PositionSteps, position_steps
from ..model import JointTerm
from ..regression import Problem, base_name, base_places, standing_joints
from ..report import Assumed
from .columns import added_columns_test
from .control_law import control_law_test
from .efforts import effort_test, positions_test, saturation_test, signs_and_order_test
from .fit_data import FitData, Part
from .gains import centre_of_mass_test, gains_test, payload_assumptions
from .held_out import held_out_test
from .lag import lag_test
from .lines import LEVELS, Trust, TrustLine
from .physical import consistent_test, physical_test
from .prior import prior_test

HALVES_LEVEL = 0.001  # of the Wald test
MIN_SQUARE_OF_HALF = 1e-10  # of a direction of Q in a half; below, it is undetermined
MAX_ROBUST_DEVIATIONS = 6.0  # above: an outlier
MAX_END_DEVIATIONS = 30.0  # of a row at an end; above: caution
MAX_END_RATIO = 2.0  # of the largest deviation at an end over the largest elsewhere
END_ROWS = 5  # rows at each end that a bad edge affects
# below, weak; above, the instruments are W itself
MIN_FIRST_STAGE_F, MAX_FIRST_STAGE_F = 10.0, 1e10
MAX_MISSING_PERCENT = 0.1  # of the moving rows
MAX_HELD_RATIO = 0.3  # of missing or repeated rows over held rows
MAX_COARSE_PERCENT = 0.4  # of a joint's moving steps that are double or zero: a slow encoder
MAX_SHORT_S = 100.0  # of motion: beyond, the error of the filters is as large as that of noise


def fixed_point_test(evidence: FitData) -> TrustLine:
    """Whether the method ended in a fixed point that the simulated robot confirms."""
    name, why = "fixed point", evidence.unconfirmed
    if not evidence.fixed_point:
        text = f"{why or 'no fixed point'}: check signs, gains, bandwidth_hz; record faster motion"
        return TrustLine(name, "do not use", text)
    if why is not None:
        advice = "check [controller]; compare with least squares"
        if evidence.gains:
            advice = "record the reference, check [controller]"
        return TrustLine(name, "caution", f"{why}: {advice}")
    by_iv = "converged, and the simulated robot confirms it"
    if evidence.by_reference is not None:
        by_iv = f"{evidence.by_reference}: one solution, less efficient where joints stick"
    return TrustLine(
        name, "ok", by_iv if evidence.method == "iv" else "least squares has one solution"
    )


def instruments_test(evidence: FitData) -> TrustLine | None:
    """Whether the instruments explain the regressor, and are more than the regressor itself."""
    F = evidence.first_stage_F
    if F is None:
        return None
    if F < MIN_FIRST_STAGE_F:
        text = (
            f"weak: first-stage F = {F:.2g}, below {MIN_FIRST_STAGE_F:g}: record faster "
            "motion, check [controller]"
        )
        return TrustLine("instruments", "caution", text, F)
    if F > MAX_FIRST_STAGE_F:
        text = (
            "the instruments are W itself: this is least squares, with the same bias by "
            "position noise"
        )
        return TrustLine("instruments", "cannot tell", text, F)
    return TrustLine("instruments", "ok", f"strong: first-stage F = {F:.3g}", F)


def units_test(evidence: FitData) -> TrustLine:
    """Whether joints share parameters although their drive gains are not known: then the torques
    are in different units.
    """
    name, robot = "units", evidence.problem.signals.robot
    if robot.gain_known or robot.n == 1:
        return TrustLine(name, "ok", "torques of all joints are in known units")
    rows = evidence.observed.system
    by_joint = np.stack(
        [np.linalg.norm(rows.W[rows.joint_of_row == j], axis=0) for j in range(robot.n)]
    )
    acts = by_joint > estimation.MIN_COLUMN_NORM * np.linalg.norm(by_joint, axis=0)
    shared = [name for name, own in zip(rows.names, acts.T, strict=True) if own.sum() > 1]
    if not shared:
        return TrustLine(name, "ok", "drive gains are not known, but no joints share a parameter")
    text = (
        f"{', '.join(shared[:5])} act at several joints, and the drive gains are not known: "
        "state drive_gain"
    )
    text += ", or record with and without a weighed payload and fit with --gains"
    return TrustLine(name, "do not use", text, finding="drive gains not known")


def essential_test(evidence: FitData) -> TrustLine:
    """Whether the interval of some inertia is narrower than its value."""
    name, base, idm = "essential", evidence.problem.base, evidence.problem.model
    rows = [base.names.index(base_name(one)) for one in evidence.essential]
    sources = [idm.sources[c] for c in np.flatnonzero(base.K[rows].any(axis=0))]
    if any(not isinstance(x, JointTerm) or x.kind == "rotor" for x in sources):
        return TrustLine(
            name,
            "ok",
            f"{len(evidence.essential)} of {len(base_places(evidence.least_squares.names))}",
        )
    text = "no inertia has an interval narrower than its value: record faster, longer motion"
    return TrustLine(name, "caution", text, finding="no inertia is determined")


def ends_test(evidence: FitData) -> TrustLine:
    """Outliers of moving rows, beyond 6 robust deviations of their joint,
    especially at the ends.
    """
    rho = (evidence.observed.tau - evidence.predicted).T
    n, used = (
        len(rho),
        (evidence.observed.counts & estimation.are_moving(evidence.observed.speed)).T,
    )
    scale = np.array(
        [1.4826 * np.median(np.abs(rho[j, used[j]])) if used[j].any() else np.inf for j in range(n)]
    )
    size = np.where(used, np.abs(rho) / np.where(scale > 0, scale, np.inf)[:, None], 0.0)
    at_end = np.zeros(size.shape[1], dtype=bool)
    for part in estimation.spans_of(evidence.observed.parts):
        at_end[part.start : part.start + END_ROWS] = at_end[part.stop - END_ROWS : part.stop] = True
    ends, middle = size[:, at_end].max(axis=1), size[:, ~at_end].max(axis=1)
    worst = int((ends / np.maximum(middle, MAX_ROBUST_DEVIATIONS)).argmax())
    value = float(ends[worst])
    outliers, rows = int((size > MAX_ROBUST_DEVIATIONS).sum()), int(used.sum())
    finding = (
        f"{outliers} outliers in {rows} moving rows; largest {middle.max():.3g} robust deviations "
    )
    finding += f"(limit {MAX_ROBUST_DEVIATIONS:g}), at the ends {ends.max():.3g}"
    if value > max(MAX_END_DEVIATIONS, MAX_END_RATIO * float(middle[worst])):
        joint = evidence.problem.signals.robot.joints[worst].name
        finding += f"; joint {joint}: largest {middle[worst]:.3g}, at the ends {value:.3g}"
        text = (
            f'{finding}: set edges = "smooth", or cut the ends off (cut_start_samples, '
            "cut_end_samples)"
        )
        return TrustLine("ends", "caution", text, value)
    return TrustLine("ends", "ok", finding, value)


def halves_test(evidence: FitData) -> TrustLine:
    """Whether both halves of the recording give the same parameters: a Wald test, with the
    cosines of both as freedom.
    """
    name, T, cuts = "halves", len(evidence.observed.tau), np.cumsum(evidence.observed.parts)[:-1]
    # recordings are not cut
    cut = int(cuts[np.abs(cuts - T / 2).argmin()]) if len(cuts) else round(T / 2)
    parts = evidence.spans(2) if evidence.gains else [evidence.between(0, cut)]
    parts = [parts[0], ~parts[0]]
    first, second = (_solve_part(evidence, part) for part in parts)
    if first is None or second is None:
        return TrustLine(
            name,
            "not made",
            "not made: a half alone does not determine the parameters; record longer",
        )
    (beta_1, C_1, B_1), (beta_2, C_2, B_2) = first, second
    b, off = len(beta_1), beta_2 - beta_1
    sigma = np.sqrt(np.diag(C_1 + C_2))
    if not (sigma > 0).all():
        return TrustLine(name, "not made", "not made: the fit is exact")
    u = off / sigma
    values, vectors = np.linalg.eigh((C_1 + C_2) / np.outer(sigma, sigma))
    wald = float((((vectors.T @ u) ** 2) / np.maximum(values, 1e-12)).sum())
    p, worst = estimation.f_tail(wald / b, b, B_1 + B_2), int(np.abs(u).argmax())
    finding = f"Wald {wald:.3g} for {b} parameters, p = {p:.2g}"
    finding += f"; {evidence.estimate.names[worst]} differs most, by {abs(u[worst]):.2g} sigma"
    if p < HALVES_LEVEL:
        text = (
            f"{finding}: the torque changes with time: warm the robot up, check for drift, fit "
            "each half alone"
        )
        return TrustLine(name, "caution", text, wald)
    return TrustLine(name, "ok", finding, wald)


def _solve_part(evidence: FitData, part: Part) -> tuple[Array, Array, int] | None:
    """Parameters (b,) of a span of time, covariance D R D (b, b), degrees of freedom; None where
    they are undetermined.
    """
    Q, W, Y, rows = evidence.part(part)
    values, vectors = np.linalg.eigh(Q.T @ Q)
    if rows <= 2 * len(values) or not values[0] > MIN_SQUARE_OF_HALF * values[-1]:
        return None
    basis = vectors / np.sqrt(values)  # Q basis is orthonormal in the rows of the part
    A = basis.T @ (Q.T @ W)
    d = np.linalg.norm(A, axis=0)
    if not (d > 0).all() or not np.linalg.cond(A / d) < 1e8:
        return None
    bread = np.linalg.inv(A / d) / d[:, None]
    beta = bread @ (basis.T @ (Q.T @ Y))
    sigma, freedom = estimation.estimate_deviations(
        bread, evidence.scores(part, beta, bread, basis)
    )
    C = bread @ bread.T
    formula = np.sqrt(np.diag(C))
    return beta, C * np.outer(sigma / formula, sigma / formula), freedom


def position_noise_test(evidence: FitData) -> TrustLine | None:
    """Whether position noise biases least squares; made while the recording is read."""
    return evidence.position_noise


def motion_test(evidence: FitData) -> TrustLine | None:
    """Joints that stand in all recordings; friction of creeping differs from that of motion."""
    speed, joints = (
        np.abs(evidence.observed.speed).max(axis=0),
        evidence.problem.signals.robot.joints,
    )
    if not (names := standing_joints(speed, joints)):
        return None
    text = (
        f"joint {', '.join(names)} does not move: its friction values do not hold for motion: "
        "move it, or do not use them"
    )
    return TrustLine("motion", "caution", text, finding=f"{', '.join(names)} does not move")


def rows_test(e: FitData) -> TrustLine | None:
    """The recording with most missing or repeated rows; else those with rows that nobody measured,
    or one whose encoders are slower than the log.
    """
    every = [position_steps(problem.used_positions()) for problem in e.problems]
    places = [f"{name}: " if len(e.names) > 1 else "" for name in e.names]
    shares = [
        100 * np.array([steps.lost, steps.repeated, steps.held]) / max(steps.moving, 1)
        for steps in every
    ]
    surplus = [x[:2] * (x[:2] > max(MAX_MISSING_PERCENT, MAX_HELD_RATIO * x[2])) for x in shares]
    k = int(np.argmax([x.sum() for x in surplus]))
    if surplus[k].any():
        found = zip(surplus[k], ("missing", "repeated"), strict=True)
        finding = " and ".join(f"{x:.2g} % of the rows {what}" for x, what in found if x)
        text = f"{places[k]}{finding} (position steps that are double or zero)"
        text += ": record time stamps or a row counter ([time] in map.toml), or record again"
        return TrustLine("rows", "caution", text, float(surplus[k].sum()), finding=finding)
    notes = [
        one.signals.unmeasured or _slow_encoder(one, steps, float(x[2]))
        for one, steps, x in zip(e.problems, every, shares, strict=True)
    ]
    noted = (place + note for place, note in zip(places, notes, strict=True) if note)
    return next((TrustLine("rows", "ok", text) for text in noted), None)


def _slow_encoder(problem: Problem, steps: PositionSteps, held: float) -> str:
    """The note on positions that stand for one row and jump in the next,
    which are not missing rows.
    """
    percent = 100 * steps.coarse[:, 1:] / np.maximum(steps.coarse[:, :1], 1)
    both = (percent.min(axis=1) > MAX_MISSING_PERCENT) & (percent.sum(axis=1) > MAX_COARSE_PERCENT)
    names = ", ".join(
        joint.name for joint, slow in zip(problem.signals.robot.joints, both, strict=True) if slow
    )
    if held <= MAX_MISSING_PERCENT and not names:
        return ""
    where, share = (f" of joint {names}", percent.sum(axis=1).max()) if names else ("", held)
    return (
        f"the log is faster than the encoder{where}: {share:.2g} % of the steps are double or zero"
    )


def _combine_failures(lines: list[TrustLine]) -> list[TrustLine]:
    """`do not use` if the held-out blocks fail and M is not positive."""
    by_test = {line.test: line for line in lines}
    held, physical = by_test["held-out blocks"], by_test["physical"]
    why_not_positive = physical.value is not None and physical.value <= 0
    if not (why_not_positive and held.fails_held_out):
        return lines
    text = f"{held.text}; and the inertia matrix is not positive: fit with --consistent"
    return [
        replace(held, level="do not use", text=text) if line is held else line for line in lines
    ]


def list_assumptions(evidence: FitData, lines: Mapping[str, TrustLine]) -> Iterator[Assumed]:
    """Assumptions that no test of `lines` covers."""
    signals, settings = evidence.problem.signals, evidence.problem.settings
    robot, motors, several = signals.robot, signals.robot.motors, len(signals.robot.joints) > 1
    yield from payload_assumptions(evidence)
    if robot.gain_known and not evidence.gains:
        gains = [
            f"{m.drive_gain:g} {m.drive_gain_unit}" for m in motors if m.drive_gain is not None
        ]
        value = (
            ", ".join(gains)
            or f"torques recorded in {' and '.join(sorted({m.recorded_unit for m in motors}))}"
        )
        why = "a wrong gain scales all parameters, and fits equally well"
        yield Assumed(
            "drive gains", value, f"{why} if it is common to all joints" if several else why
        )
    ratios = ", ".join(f"{x:g}" for x in np.diag(robot.R))
    yield Assumed("ratios", ratios, "joint positions and torques are computed with them")
    if several:
        yield Assumed(
            "lengths",
            "dh" if robot.urdf is None else "urdf",
            "link parameters absorb an error of a length",
        )
    yield Assumed(
        "sample rate", f"{signals.sample_rate_hz:g} Hz", "speeds and accelerations scale with it"
    )
    if (
        evidence.method == "iv"
        and not evidence.by_reference
        and lines["control law"].level == "not made"
    ):
        law = robot.controller.structure or f"a {robot.bandwidth_hz:g} Hz PD"
        yield Assumed("control law", law, lines["control law"].text.removeprefix("not made: "))
    if evidence.lags and evidence.lags[0].prior.stated:
        yield Assumed("lag", f"{evidence.lags[0].value_s:g} s", "stated by torque_lag_s")
    if (
        duration_s := len(evidence.observed.tau) * settings.decimation / signals.sample_rate_hz
    ) > MAX_SHORT_S:
        why = (
            "intervals include noise only; filters distort a parameter by about 0.1 %, which "
            "is as much here"
        )
        yield Assumed("filters", f"{duration_s:.0f} s of motion", why)
    if evidence.method != "iv":
        why = "position noise biases least squares; only the noise above the low-pass is tested"
        yield Assumed("encoder noise", "the same spectrum below and above the low-pass", why)


# A test is a function of the fit's data, None where it does not apply. A new one is a line here.
TESTS: tuple[Callable[[FitData], TrustLine | None], ...] = (
    *(
        signs_and_order_test,
        saturation_test,
        positions_test,
        gains_test,
        centre_of_mass_test,
        fixed_point_test,
    ),
    *(physical_test, units_test, control_law_test, prior_test, added_columns_test, lag_test),
    *(held_out_test, halves_test, consistent_test, ends_test, essential_test, instruments_test),
    *(position_noise_test, motion_test, effort_test, rows_test),
)


def trust_in(evidence: FitData) -> Trust:
    """All tests of an estimate, worst first, and the assumptions."""
    lines = [line for test in TESTS if (line := test(evidence)) is not None]
    assumptions = [
        *list_assumptions(evidence, {x.test: x for x in lines}),
        *(one for x in lines for one in x.assumed),
    ]
    return Trust(lines=worst_first(_combine_failures(lines)), assumed=tuple(assumptions))


def worst_first(lines: list[TrustLine]) -> tuple[TrustLine, ...]:
    """Lines sorted by level."""
    return tuple(sorted(lines, key=lambda line: LEVELS.index(line.level)))
