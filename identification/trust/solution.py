"""Tests of the solution: fixed point, instruments, how well the rows determine it.

Nothing is simulated again.
"""

from contextlib import suppress

import numpy as np

from .. import estimation
from ..errors import NoFitError
from ..model import JointTerm
from ..report import TrustResult
from .evidence import Case, Part, TrustInputs, Words

HALVES_LEVEL = 0.001  # of the Wald test
MIN_SQUARE_OF_HALF = 1e-10  # of a direction of Q in a half; below, it is undetermined
# Instruments are weak below the first limit (Staiger and Stock); above the second they are W
# itself.
MIN_FIRST_STAGE_F, MAX_FIRST_STAGE_F = 10.0, 1e10
MAX_CONDITION = 50.0  # of scaled columns; 7 to 11 of motions of five sines


def fixed_point_line(status: str, reason: str | None, *, gains: bool) -> TrustResult | None:
    """Test whether the iterations converged to a solution that the simulated robot confirms."""
    converged = status == "converged"
    return FIXED_POINT.judge(
        {
            "none": not converged and status != "not_confirmed",
            "no simulation": not converged and gains,
            "not confirmed": not converged,
            "by reference": reason is not None,
            "confirmed": True,
        },
        why=reason if converged else f"status {status}: {reason}",
    )


FIXED_POINT = Words(
    test="convergence",
    place=60,
    advice="Check signs, gains and `bandwidth_hz`, or record faster motion.",
    detects="Iterations of iv that do not converge, or to a solution that the simulated robot does "
    "not confirm",
    limit="`do not use`: the iterations do not converge. `caution`: the simulated robot does not "
    "confirm the solution",
    cases={
        "none": Case(
            "do not use", "{why}", "Check signs, gains and bandwidth_hz, or record faster motion."
        ),
        "no simulation": Case("caution", "{why}", "Record the reference, or check [controller]."),
        "not confirmed": Case(
            "caution", "{why}", "Check [controller], and compare with least squares."
        ),
        "least squares": Case("ok", "least squares has one solution"),
        "by reference": Case(
            "ok", "{why}: the solution is unique, but less efficient where joints stick"
        ),
        "confirmed": Case("ok", "converged, and the simulated robot confirms it"),
    },
    parts={"caused": "{text}. Likely cause: {cause}"},
)


POSITION_NOISE = Words(
    test="noise bias",
    place=220,
    of_data=True,
    advice="Use `--method iv`, which needs the reference.",
    detects="Bias of least squares by position noise: noise with the spectrum seen above the "
    "low-pass is added, and the change of the estimate counts. A large bias is underestimated",
    limit="`caution`: the change of an essential parameter is above 1 % and one half-width, or "
    "above 5 % and half a half-width",
    cases={
        "no noise": Case(
            "inconclusive", "{reason}", "Use --method iv, which needs a recorded reference."
        ),
        "ok": Case("ok", "{moves}"),
        "biased": Case(
            "caution",
            "{moves} or more",
            "Use --method iv, which needs a recorded reference.",
            "least squares biased by position noise",
        ),
    },
    parts={
        "moves": "position noise changes {name} by {value:.2g} half-widths ({percent:.2g} %)",
        "no low-pass": "without a low-pass, noise and motion cannot be separated",
        "wide": "too little of the noise is above the cut-off of {cutoff_hz:g} Hz",
        "interpolated": "interpolated samples have less noise",
    },
)


def instruments_test(evidence: TrustInputs) -> TrustResult | None:
    """Test whether the instruments explain the regressor, and differ from the regressor itself."""
    if (F := evidence.first_stage_F) is None:
        return None
    return INSTRUMENTS.judge(
        {"weak": F < MIN_FIRST_STAGE_F, "regressor": F > MAX_FIRST_STAGE_F, "ok": True},
        value=F,
        limit=MIN_FIRST_STAGE_F,
    )


INSTRUMENTS = Words(
    test="instruments",
    place=210,
    by=instruments_test,
    advice="Record faster motion, or describe the controller.",
    detects="Instruments that hardly explain the regressor matrix, or are equal to it",
    limit="`caution`: first-stage F below 10. `inconclusive`: they are equal",
    cases={
        "weak": Case(
            "caution",
            "the instruments are weak: first-stage F = {value:.2g}, below {limit:g}",
            "Record faster motion, or check [controller].",
        ),
        "regressor": Case(
            "inconclusive",
            "the instruments are the regressor matrix itself, so this is least squares, with its "
            "noise bias",
        ),
        "ok": Case("ok", "first-stage F = {value:.3g}"),
    },
)


def units_test(evidence: TrustInputs) -> TrustResult | None:
    """Test whether joints share parameters although their drive gains are not known.

    Their torques are then in different units.
    """
    robot, rows = evidence.robot, evidence.observed.system
    size = np.stack(
        [np.linalg.norm(rows.W[rows.joint_of_row == j], axis=0) for j in range(robot.n)]
    )
    acts = size > estimation.MIN_COLUMN_NORM * np.linalg.norm(size, axis=0)
    shared = [rows.names[i] for i in np.flatnonzero(acts.sum(axis=0) > 1)]
    return UNITS.judge(
        {"known": robot.gain_known or robot.n == 1, "shared": shared, "apart": True},
        shared=", ".join(shared[:5]),
    )


UNITS = Words(
    test="units",
    place=80,
    by=units_test,
    advice="Set `drive_gain`.",
    detects="Joints that share a parameter although their drive gains are not known",
    limit="`do not use`: there are such joints",
    cases={
        "known": Case("ok", "torques of all joints are in known units"),
        "shared": Case(
            "do not use",
            "{shared} act at several joints, and the drive gains are not known",
            "Set drive_gain, or record with and without a weighed payload and fit with --gains.",
            "drive gains not known",
        ),
        "apart": Case("ok", "drive gains are not known, but no joints share a parameter"),
    },
)


def essential_test(evidence: TrustInputs) -> TrustResult | None:
    """Test whether the interval of at least one inertia is narrower than its value."""
    base, idm, names = (
        evidence.problem.base,
        evidence.problem.model,
        [x.names for x in evidence.arms],
    )
    rows = np.isin(names, evidence.essential).any(axis=0)
    sources = [idm.sources[c] for c in np.flatnonzero(base.K[rows].any(axis=0))]
    inertia = any(not isinstance(x, JointTerm) or x.kind == "rotor" for x in sources)
    return ESSENTIAL.judge(
        {"ok": inertia, "no inertia": True},
        essential=len(evidence.essential),
        count=len(np.unique(names)),
    )


ESSENTIAL = Words(
    test="essential",
    place=200,
    by=essential_test,
    advice="Record faster, longer motion.",
    detects="Recordings that show no inertia precisely",
    limit="`caution`: no inertia has an interval narrower than its value",
    cases={
        "ok": Case("ok", "{essential} of {count} well determined"),
        "no inertia": Case(
            "caution",
            "no inertia has an interval narrower than its value",
            "Record faster, longer motion.",
            "no inertia is precise",
        ),
    },
)


def excitation_test(evidence: TrustInputs) -> TrustResult | None:
    """Test whether the motion excites all combinations of the essential parameters.

    A single sine moves joints as well, but always together.
    """
    names = np.array(evidence.estimate.names)
    essential = np.isin(names, evidence.essential)
    if not essential.any():
        return None
    W = np.linalg.qr(evidence.W[:, essential], mode="r")
    _, values, directions = np.linalg.svd(W / np.maximum(np.linalg.norm(W, axis=0), 1e-300))
    condition = float(values[0] / max(values[-1], 1e-300))
    worst = names[essential][np.argsort(-np.abs(directions[-1]))[:3]]
    return EXCITATION.judge(
        {"hardly": condition > MAX_CONDITION, "ok": True},
        value=condition,
        limit=MAX_CONDITION,
        names=", ".join(worst),
    )


EXCITATION = Words(
    test="excitation",
    place=140,
    by=excitation_test,
    advice="Record a more varied motion: `excite` designs one.",
    detects="Motion that hardly excites a combination of the essential parameters, by the "
    "condition number of their scaled columns",
    limit="`caution`: above 50 (a motion of five sines has 7 to 11, a single sine 80 to 100)",
    cases={
        "hardly": Case(
            "caution",
            "a combination of parameters, mostly {names}, is hardly excited: condition number "
            "{value:.3g}, limit {limit:g}",
            "Record a more varied motion, as `robot-identify excite` designs one.",
            "hardly excited",
        ),
        "ok": Case(
            "ok", "condition number {value:.3g} of the essential parameters (limit {limit:g})"
        ),
    },
)


def halves_test(evidence: TrustInputs) -> TrustResult | None:
    """Test whether both halves of the recording give the same parameters.

    This is a Wald test, with the cosines of both halves as degrees of freedom.
    """
    T, cuts = len(evidence.observed.tau), evidence.ends[1:-1]
    # Cut between recordings where possible, because a half of a recording may excite too little.
    cut = int(cuts[np.abs(cuts - T / 2).argmin()]) if len(cuts) else round(T / 2)
    half = evidence.spans(2)[0] if evidence.gains else evidence.between(0, cut)
    first, second = (_solve_part(evidence, part) for part in (half, ~half))
    if first is None or second is None:
        return HALVES.judge({"undetermined": True})
    C = first.covariance + second.covariance
    sigma, b = np.sqrt(np.diag(C)), len(C)
    if not (sigma > 0).all():
        return HALVES.judge({"exact": True})
    u = 0.5 * (second.low + second.high - first.low - first.high) / sigma
    values, vectors = np.linalg.eigh(C / np.outer(sigma, sigma))
    wald = float((((vectors.T @ u) ** 2) / np.maximum(values, 1e-12)).sum())
    p = estimation.f_tail(wald / b, b, first.freedom + second.freedom)
    return HALVES.judge(
        {"differ": p < HALVES_LEVEL, "ok": True},
        value=wald,
        count=b,
        p=p,
        name=evidence.estimate.names[np.abs(u).argmax()],
        most=np.abs(u).max(),
    )


HALVES = Words(
    test="first against second half",
    place=130,
    by=halves_test,
    advice="Warm the robot up, and look for changes with time.",
    detects="Torque that changes with time, so that the two halves give different parameters",
    limit="`caution`: a Wald test at 0.1 %",
    cases={
        "undetermined": Case(
            "skipped", "a half alone does not determine the parameters", "Record longer."
        ),
        "exact": Case("skipped", "the fit is exact"),
        "differ": Case(
            "caution",
            "{wald}. The torque changes with time",
            "Warm the robot up, check for drift, or fit each half alone.",
        ),
        "ok": Case("ok", "{wald}"),
    },
    parts={
        "wald": "Wald {value:.3g} for {count} parameters, p = {p:.2g}; {name} differs most, by "
        "{most:.2g} standard errors"
    },
)


def _solve_part(evidence: TrustInputs, part: Part) -> estimation.Intervals | None:
    """Return the intervals of the parameters by a time block.

    The result is None if the parameters are not well determined.
    """
    rows = part[evidence.observed.system.span]
    values = np.linalg.eigvalsh(evidence.estimate.Q[rows].T @ evidence.estimate.Q[rows])
    determined = values[0] > MIN_SQUARE_OF_HALF * values[-1]
    if not determined or evidence.count(part) <= 2 * len(values):
        return None
    system = evidence.observed.system.part(rows).with_columns(evidence.places)
    with suppress(NoFitError):
        Z = evidence.Z[np.ix_(rows, evidence.places)]
        own = estimation.instrumental_variables(system, Z, evidence.estimate.weights)
        return estimation.intervals_of(system, own, part)
    return None
