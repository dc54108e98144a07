"""Efforts and positions that are not what they are taken for: exchanged, or of the wrong sign;
identified drive gains, the payloads that tell them, and what these assume.

A mistake S of the motors' columns, an exchange or a sign, is its own inverse. Undoing it makes of
the drives' torques at joints Rᵀ G S (Rᵀ G)⁻¹ tau, and of positions R⁻¹ S R q; a table of joint
torques may have them exchanged by joint. Least squares shows which mistake fits. A wrong sign fits
nearly as well, but its motor takes power from the robot: it brakes.
"""

from collections.abc import Collection, Iterator
from itertools import combinations

import numpy as np

from ..arrays import Array, Bools, Ints
from ..estimation import by_rows_alone, differs, intervals_of, relative_residual
from ..regression import Problem, sample_weights
from ..report import Assumed, TrustResult, gain_name
from .evidence import Case, TrustInputs, Words, assume, figures_of, worst_of

MIN_BAD_PERCENT = 5.0  # torque error of a joint: below, nothing is tried unless a motor brakes
MAX_RATIO, MAX_RATIO_OF_BRAKE = 0.5, 0.95  # of the torque errors with a mistake undone and with it
MAX_RISE = 1.001  # the same for a sign that may be wrong: that of a lone axis changes no error
# Of identified gains:
MAX_HALF_PERCENT = 10.0  # of one; with more it is not determined
MAX_USABLE_PERCENT = 50.0  # the same of the best gain; with more no gain is usable
MAX_SCATTERS = 3.0  # of the catalogue's own: by more the described gains are all off by one factor
# no smaller one is reported; larger where 3 deviations of the median show it
LEAST_FACTOR, SURE_FACTOR = 1.1, 1.6
MAX_OFF_ONE_PERCENT = 2.0  # of gains that are 1 N m/A, by themselves or with their ratio


def signs_and_order_test(evidence: TrustInputs) -> TrustResult | None:
    """Whether a mistake undone halves the torque error, or, as a sign of a motor
    that brakes, lowers it.
    """
    rows, R = evidence.observed, evidence.robot.R
    rho, size = (
        np.linalg.norm(x * (rows.share > 0), axis=0)
        for x in (rows.tau - evidence.predicted, rows.tau)
    )
    power, brakes = _power(evidence)
    if len(R) == 1 or not ((100 * rho > MIN_BAD_PERCENT * size).any() or brakes.any()):
        return None
    with_it, undone = _undone(evidence)
    found = [
        (tried / (MAX_RATIO if m is None or not brakes[m] else MAX_RATIO_OF_BRAKE), tried, mistake)
        for tried, mistake, m, A in undone
        if (A * power).sum() > 0
    ]
    least, error, finding = min(found, default=(np.inf, 0.0, ""), key=lambda one: one[0])
    return SIGNS.judge(
        {"mistake": least < with_it},
        mistake=finding,
        undone=100 * error,
        error=100 * with_it,
    )


SIGNS = Words(
    test="signs and order",
    place=10,
    by=signs_and_order_test,
    of_data=True,
    wrong="two efforts are exchanged, or an effort or a position has the wrong sign; with "
    "the torque error once that is undone",
    advice="correct columns and signs in `map.toml`, import again",
    detects="Only printed if efforts of two motors or joints are exchanged, or an effort or "
    "a position of a motor has the wrong sign. Where a joint's torque error is over 5 %, or "
    "a motor takes power from the robot over the recording, each such mistake is undone and "
    "least squares solved again",
    limit="`do not use`: a mistake undone leaves half of the torque error at most; of a "
    "sign of a motor that takes power, 95 %",
    cases={
        "mistake": Case(
            "do not use",
            "{mistake}: undone, the torque errors of joints are {undone:.2g} % (rms) in "
            "place of {error:.2g} %",
            "check columns and signs of the recording",
            "{mistake}",
        )
    },
    parts={
        "exchanged": "the efforts of {one} and {other} are exchanged",
        "effort": "the effort of {one} has the wrong sign",
        "position": "the position of {one} has the wrong sign",
    },
)


def _power(evidence: TrustInputs) -> tuple[Array, Bools]:
    """Sums (n, n) of the speeds of joints times the torques at joints, and which motors (n,) take
    power from the robot.
    """
    power, R = evidence.observed.speed.T @ evidence.observed.tau, evidence.robot.R
    return power, np.diag(R @ power @ np.linalg.inv(R)) < 0


def sign_may_be_wrong(evidence: TrustInputs, joint: str) -> bool:
    """Whether a motor that moves a joint brakes, or a sign turned, of its effort or its position,
    does not raise the torque error.
    """
    j = [one.name for one in evidence.robot.joints].index(joint)
    motors = np.flatnonzero(evidence.robot.R[:, j])
    return bool(_power(evidence)[1][motors].any() or turned_sign(evidence, motors)[0] <= MAX_RISE)


def turned_sign(evidence: TrustInputs, motors: Collection[int] | Ints) -> tuple[float, str]:
    """Of the signs of some motors the one that, turned, leaves the smallest torque error: that over
    the error as it is, and the mistake that it would undo.
    """
    with_it, undone = _undone(evidence, motors)
    return min((tried / max(with_it, 1e-300), mistake) for tried, mistake, *_ in undone)


def _undone(
    evidence: TrustInputs, motors: Collection[int] | Ints | None = None
) -> tuple[float, list[tuple[float, str, int | None, Array]]]:
    """The torque error; and with each of the mistakes undone, of signs of `motors` only if these
    are given: error, mistake, motor of a sign, and the map (n, n) of torques times speeds.
    """
    problem, one = evidence.problem.with_samples().first_minutes(), np.eye(evidence.robot.n)
    factors = _factors(problem, decimated := _decimated(problem), one)
    return _error(factors, one), [
        (
            _error(factors if B is None else _factors(problem, decimated, B), A),
            mistake,
            motor,
            A if B is None else B.T @ A,
        )
        for mistake, motor, A, B in _mistakes(problem)
        if motors is None or motor in motors
    ]


def _mistakes(problem: Problem) -> Iterator[tuple[str, int | None, Array, Array | None]]:
    """Mistakes, the motor of a sign, and the maps (n, n) of torques at joints and of positions,
    None for that of efforts.
    """
    robot, one = problem.robot, np.eye(problem.robot.n)
    by_motors, to_motors = robot.R.T * robot.gain, np.linalg.inv(robot.R.T * robot.gain)
    for i, j in combinations(range(robot.n), 2):
        S = one[[j if k == i else i if k == j else k for k in range(robot.n)]]
        for names, A in ((robot.motors, by_motors @ S @ to_motors), (robot.joints, S)):
            pair = {"one": names[i].name, "other": names[j].name}
            yield SIGNS.part("exchanged", **pair), None, A, None
    for m, motor in enumerate(robot.motors):
        S = one - 2 * np.diag(one[m])
        effort, position = (SIGNS.part(part, one=motor.name) for part in ("effort", "position"))
        yield effort, m, by_motors @ S @ to_motors, None
        yield position, m, one, np.linalg.solve(robot.R, S @ robot.R)


def _decimated(problem: Problem) -> tuple[list[Array], Array]:
    """The decimated motion q, dq, ddq (rows, n) from the zeros, and by joint (n, rows, n + 1) all
    drives' torques and the known one. Columns are of this motion, not decimated themselves: ten
    times as fast, and as good for errors of this size. The lag is the known one: one that was found
    has the mistake in it.
    """
    signals, s = problem.signals, problem.settings
    motion = problem.motion.between(s.start, s.stop, s.cutoff_hz)
    moved = [
        s.decimator.filtered(x.T).T / s.decimator.gain
        for x in (motion.q - signals.robot.zero, motion.dq, motion.ddq)
    ]
    known = 0 * motion.tau if (x := signals.known_torque) is None else x[s.start : s.stop]
    drives, known = (
        s.decimator.filtered(one.T)
        for one in (problem.drives(s.start, s.stop, s.known_lag.value_s), known)
    )
    return moved, np.array([np.c_[drives.T, of_joint] for of_joint in known])


def _factors(problem: Problem, decimated: tuple[list[Array], Array], B: Array) -> Array:
    """QR factors (n, k, b + n + 1) of each joint's rows, positions mapped by B: columns, and
    torques of `decimated`.
    """
    (q, dq, ddq), torques = [x @ B.T for x in decimated[0]], decimated[1]
    W = problem.model.regressor(q + problem.signals.robot.zero, dq, ddq)[
        ..., problem.base.columns
    ].transpose(1, 0, 2)
    share = sample_weights(problem).of_rows.T[..., None]
    return np.asarray(np.linalg.qr(share * np.concatenate([W, torques], axis=2), mode="r"))


def _error(factors: Array, A: Array) -> float:
    """Relative torque error, rms of the joints, of least squares weighted by it, where the drives'
    torques are mapped by A.
    """
    b = factors.shape[2] - len(A) - 1
    Y = np.einsum("jkm,jm->jk", factors[..., b:], np.c_[A, np.ones(len(A))])
    weight = 1 / np.maximum(np.linalg.norm(Y, axis=1), 1e-300)
    rows = np.concatenate([factors[..., :b], Y[..., None]], axis=2) * weight[:, None, None]
    R = np.asarray(np.linalg.qr(rows.reshape(-1, b + 1), mode="r"))
    return relative_residual(R[:, :-1], R[:, -1])


def gains_test(evidence: TrustInputs) -> TrustResult | None:
    """Whether identified gains are positive, determined, and not all off by one factor beyond the
    catalogue's own scatter.
    """
    if not evidence.gains:
        return None
    robot, of = evidence.problem.signals.robot, evidence.estimate.names
    motors = [m for m, motor in enumerate(robot.motors) if gain_name(motor.name) in evidence.gains]
    names = [robot.motors[m].name for m in motors]
    at = [of.index(gain_name(name)) for name in names]
    factor = evidence.estimate.beta[at]
    half = 100 * evidence.intervals.half[at] / np.abs(factor)
    described = np.array([robot.motors[m].gain for m in motors], dtype=float)  # nan for None
    K = factor * np.nan_to_num(described, nan=1.0)
    usable, expected = half <= MAX_USABLE_PERCENT, np.where(np.isnan(described), K, described)
    unsure = ", ".join(
        f"{n} ±{h:.2g} %" for n, h in zip(names, half, strict=True) if h >= MAX_HALF_PERCENT
    )
    factor_of_all, scatter, is_common = _common_factor((K / described)[half < MAX_HALF_PERCENT])
    torques = any(
        (np.abs(np.abs(K * by) - 1) < 0.01 * MAX_OFF_ONE_PERCENT).all()
        for by in (np.ones(len(K)), np.abs(np.diag(robot.R))[motors])
    )
    return GAINS.judge(
        {
            "all negative": (K < 0).all() and usable.any(),
            "negative": usable[K <= 0].all() and (K < 0).any(),
            "none usable": (K <= 0).any() or not usable.any(),
            "none determined": (half >= MAX_HALF_PERCENT).all(),
            "one factor": is_common,
            "ok": True,
        },
        value=float(half.max()),
        figures=figures_of(names, K, np.abs(K) * half / 100, expected),
        negative=" and ".join(np.array(names)[(K < 0) & usable]),
        unsure=unsure or "one is negative",
        some_unsure=bool(unsure),
        limit=MAX_HALF_PERCENT,
        factor=factor_of_all,
        scatter=100 * scatter,
        least=half.min(),
        torques=torques,
    )


GAINS = Words(
    test="gains",
    place=40,
    by=gains_test,
    of_data=True,
    wrong="identified drive gains are negative, not determined, or off by one common factor",
    advice="check which recording has the payload, and its mass",
    detects="With `--gains` only: whether the drive gains are positive and determined, and "
    "not all off by one factor",
    limit="`do not use`: a drive gain is negative, or the best one is known to no better "
    "than 50 %. `caution`: none is known to 10 %, or all differ from the described ones by "
    "one common factor of over 10 %",
    cases={
        "all negative": Case(
            "do not use",
            "all drive gains are negative: the recordings are exchanged, the payload "
            "belongs to another",
            finding="recordings exchanged",
        ),
        "negative": Case(
            "do not use",
            "{wrong}: its drive gain is negative, others are positive",
            "check the sign of its effort and of its position",
            "{wrong}",
        ),
        "none usable": Case(
            "do not use",
            "no drive gain is usable ({unsure})",
            "check which recording has the payload",
            "drive gains not determined",
        ),
        "none determined": Case(
            "caution",
            "no drive gain is known to {limit:g} % ({unsure})",
            "use a heavier payload",
            "drive gains not determined",
        ),
        "one factor": Case(
            "caution",
            "drive gains are {factor:.3g} times those described (median), which scatter by "
            "{scatter:.2g} %",
            "check the payload's mass, or peak against rms",
            "drive gains off by one factor",
        ),
        "ok": Case("ok", "known to {least:.2g} to {value:.2g} %{some_unsure}{torques}"),
    },
    parts={
        "wrong": "wrong sign of {negative}",
        "some_unsure": "; not determined: {unsure}",
        "torques": "; all are 1 N m per unit: the recorded effort is a torque already",
    },
    unit="N m per unit of effort",
)


def _common_factor(factors: Array) -> tuple[float, float, bool]:
    """Of factors (m,), nan where unknown, the median, the robust deviation of their logarithms, and
    whether the median is off beyond that.
    """
    of = np.log(np.maximum(np.abs(factors[np.isfinite(factors)]), 1e-300))
    if len(of) < 2:
        return 1.0, 0.0, False
    scatter, off = 1.4826 * np.median(np.abs(of - np.median(of))), np.median(of)
    limit = np.clip(MAX_SCATTERS * scatter, np.log(LEAST_FACTOR), np.log(SURE_FACTOR))
    of_median = scatter * np.sqrt(0.5 * np.pi / len(of))  # its deviation
    return float(np.exp(off)), float(scatter), bool(abs(off) > max(limit, MAX_SCATTERS * of_median))


def centre_of_mass_test(evidence: TrustInputs) -> TrustResult | None:
    """How far the centre of mass by the recordings alone is from the stated one; the
    line of the worst payload.
    """
    names, lines = evidence.estimate.names, list[TrustResult | None]()
    for one in filter(None, dict.fromkeys(arm.payload for arm in evidence.arms)):
        stated = {name: of for name, of in one.stated.items() if name in names}
        if not stated or not one.payload.mass_kg:
            continue
        alone = by_rows_alone(evidence.estimate, evidence.W, evidence.Y)
        found, at = intervals_of(evidence.observed.system, alone), list(map(names.index, stated))
        value, half = np.array(list(stated.values())).T
        off, C = alone.beta[at] - value, found.covariance[np.ix_(at, at)]
        size, mm = float(np.linalg.norm(off)), 1e3 / one.payload.mass_kg
        far, along = mm * size, off / max(size, 1e-300)
        width = mm * found.reach * float(np.sqrt(along @ C @ along))
        lines.append(
            CENTRE_OF_MASS.judge(
                {
                    "differs": differs(off, C + np.diag((half / found.reach) ** 2), found.freedom),
                    "ok": True,
                },
                value=far,
                figures=figures_of(["distance"], [far], [width], [0.0]),
                half=width,
                stated=1e3 * one.payload.center_half_width_m,
            )
        )
    return worst_of(lines)


CENTRE_OF_MASS = Words(
    test="centre of mass",
    place=50,
    by=centre_of_mass_test,
    of_data=True,
    wrong="the data contradict the stated centre of mass of a payload",
    advice="measure it again, or state a larger `center_half_width_m`",
    detects="Only printed for a payload whose centre of mass is stated: how far the centre "
    "by the recordings alone is from it",
    limit="`caution`: beyond the 95 % region of the statement and the data together "
    "(Hotelling's F); the statement is then not used",
    cases={
        "differs": Case(
            "caution",
            "{distance}, beyond its ± {stated:g} mm, and not used",
            "check centre, frame and mass",
            "centre of mass differs",
        ),
        "ok": Case("ok", "{distance}"),
    },
    parts={
        "distance": "centre of mass by the data {value:.2g} ± {half:.2g} mm from the stated one"
    },
    unit="mm",
)


def payload_assumptions(evidence: TrustInputs) -> Iterator[Assumed]:
    """Mass and frame of the payloads, which no test covers."""
    found = dict.fromkeys(arm.payload for arm in evidence.arms)
    for one in filter(None, found):
        weighed, always = one.payload.mass_kg is not None, None not in found
        if weighed or always:
            yield assume(
                "payload",
                payload=one.payload.describe(evidence.robot.joints[-1].name),
                scales=weighed and evidence.gains,
                taken_off=weighed and not evidence.gains,
                both=weighed and always,
                exact=not one.payload.mass_half_width_kg,
                always=always,
            )
