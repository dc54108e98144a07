"""Tests of identified drive gains and of the payloads that show them, and what these assume."""

from collections.abc import Iterator

import numpy as np

from ..arrays import Array
from ..estimation import by_rows_alone, differs, intervals_of
from ..report import Assumed, TrustResult, gain_name
from .evidence import Case, TrustInputs, Words, assume, figures_of, worst_of

MAX_HALF_PERCENT = 10.0  # of a gain; with more it is not determined
MAX_USABLE_PERCENT = 50.0  # the same of the best gain; with more no gain is usable
MAX_SCATTERS = 3.0  # of the catalogue's own: by more the described gains are all off by one factor
# Smaller factors are within the scatter of catalogues; up to the second one, three standard errors
# of the median must confirm it.
LEAST_FACTOR, SURE_FACTOR = 1.1, 1.6
MAX_OFF_ONE_PERCENT = 2.0  # of gains that are 1 N m/A, by themselves or with their ratio


def gains_test(evidence: TrustInputs) -> TrustResult | None:
    """Test whether identified drive gains are plausible.

    They must be positive, well determined, and not all wrong by one factor beyond the scatter of
    catalogue values.
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
    test="drive gains",
    place=40,
    by=gains_test,
    of_data=True,
    advice="Check which recording has the payload, and its mass.",
    detects="With `--gains` only: drive gains that are negative, imprecise, or all wrong "
    "by one factor",
    limit="`do not use`: a drive gain is negative, or no half-width is below 50 %. `caution`: none "
    "is below 10 %, or all gains differ from the given ones by one factor of more than 10 %",
    cases={
        "all negative": Case(
            "do not use",
            "all drive gains are negative, so the payload belongs to another recording",
            "Swap the payloads of the recordings.",
            "recordings swapped",
        ),
        "negative": Case(
            "do not use",
            "{wrong}: its drive gain is negative, the others are positive",
            "Check the sign of its effort and of its position.",
            "{wrong}",
        ),
        "none usable": Case(
            "do not use",
            "no drive gain is usable ({unsure})",
            "Check which recording has the payload.",
            "drive gains not well determined",
        ),
        "none determined": Case(
            "caution",
            "no drive gain is known to {limit:g} % ({unsure})",
            "Use a heavier payload.",
            "drive gains not well determined",
        ),
        "one factor": Case(
            "caution",
            "the drive gains are {factor:.3g} times the given ones (median), which scatter by "
            "{scatter:.2g} %",
            "Check the payload's mass, and whether catalogue values are peak or rms.",
            "drive gains wrong by one factor",
        ),
        "ok": Case("ok", "known to {least:.2g} to {value:.2g} %{some_unsure}{torques}"),
    },
    parts={
        "wrong": "wrong sign of {negative}",
        "some_unsure": "; not well determined: {unsure}",
        "torques": "; all are 1 N m per unit, so the recorded effort is already a torque",
    },
    unit="N m per unit of effort",
)


def _common_factor(factors: Array) -> tuple[float, float, bool]:
    """Return the median of the factors (m,), its scatter, and whether it differs from 1.

    Factors are nan where they are unknown. The scatter is the robust standard deviation of their
    logarithms. The median differs from 1 if its distance from 1 is large compared with the scatter.
    """
    of = np.log(np.maximum(np.abs(factors[np.isfinite(factors)]), 1e-300))
    if len(of) < 2:
        return 1.0, 0.0, False
    scatter, off = 1.4826 * np.median(np.abs(of - np.median(of))), np.median(of)
    limit = np.clip(MAX_SCATTERS * scatter, np.log(LEAST_FACTOR), np.log(SURE_FACTOR))
    of_median = scatter * np.sqrt(0.5 * np.pi / len(of))  # its deviation
    return float(np.exp(off)), float(scatter), bool(abs(off) > max(limit, MAX_SCATTERS * of_median))


def centre_of_mass_test(evidence: TrustInputs) -> TrustResult | None:
    """Compare the estimated centre of mass of each payload with the given one.

    The worst result is returned.
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
    advice="Measure it again, or give a larger `center_half_width_m`.",
    detects="With a given centre of mass only: its distance from the estimated one",
    limit="`caution`: outside the 95 % region of both (Hotelling's F); the given value is then not "
    "used",
    cases={
        "differs": Case(
            "caution",
            "{distance}, outside its ± {stated:g} mm, so the given one is not used",
            "Check centre, frame and mass of the payload.",
            "centre of mass differs",
        ),
        "ok": Case("ok", "{distance}"),
    },
    parts={
        "distance": "the estimated centre of mass is {value:.2g} ± {half:.2g} mm from the given one"
    },
    unit="mm",
)


def payload_assumptions(evidence: TrustInputs) -> Iterator[Assumed]:
    """Return mass and frame of the payloads as assumptions, since no test confirms them."""
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
