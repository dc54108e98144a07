"""Drive gains in a fit, equation (I): the recorded effort is a regressor, its instrument the effort
that the model predicts.

E_m is the torque of motor m by its described gain, kappa_m the factor on it: a term `Drives` like
the others. What is stated of gains, masses and centres of mass has half-widths, which intervals
count. Results of gains and payloads stand apart from the base parameters.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np

from .. import estimation
from ..arrays import Array
from ..estimation import Estimate, Intervals, System
from ..model import LINK
from ..regression import Lag, Rows, base_places
from ..report import DriveGain, Number, Row, Section, Table, columns
from .fit import EstimatedPayload, Fit
from .model import Model

MASS, MOMENTS = LINK.index("M"), [LINK.index(name) for name in ("MX", "MY", "MZ")]
MAX_GAIN_SHARE = 0.1  # half an interval over the gain: with more it is not determined


def held_and_counted(
    model: Model, estimate: Estimate, rows: Rows, lags: Sequence[Lag]
) -> Intervals:
    """Intervals that include how well lags, stated drive gains, masses, and centres of mass
    that are not estimated are known, which the estimate holds.
    """
    of, found = model.unknowns, estimation.intervals_of(rows.system, estimate)
    moved = [lag.moved for lag in lags]
    if of.held:
        places = [of.names.index(name) for name in estimate.names]
        half = np.array([[one.half] for one in of.held])
        moves = estimation.moves_of(rows.system, rows.L[:, : len(of.held)], estimate).T
        stated = np.array([one.stated[places] for one in of.held])
        moved += list(half * np.abs(stated - moves) / found.reach)
    return estimation.intervals_from(
        estimate, np.hypot.reduce([found.sigma, *moved]), found.freedom
    )


def smallest_cragg_donald(system: System, Z: Array, weights: Array, gains: slice) -> float:
    """Smallest eigenvalue of the Cragg-Donald statistic of (E, Ê) projected off W
    and L, per instrument.

    Cragg, Donald, Testing identifiability and specification in instrumental variable models,
    Econometric Theory 9 (1993). First-stage F of a gain is blind: W explains the current.
    """
    w = weights[system.joint_of_row][:, None]
    others, E, known = np.delete(Z, gains, axis=1) * w, system.W[:, gains] * w, Z[:, gains] * w
    basis = np.linalg.qr(others / np.maximum(np.linalg.norm(others, axis=0), 1e-300))[0]
    E, known = (x - basis @ (basis.T @ x) for x in (E, known))
    Q = np.linalg.qr(known)[0]
    explained = Q.T @ E
    left = E - Q @ explained
    m, freedom = E.shape[1], float(system.rows.sum()) - Z.shape[1]
    root = np.linalg.cholesky(left.T @ left / max(1.0, freedom) + 1e-300 * np.eye(m))
    half = np.linalg.solve(root, explained.T)
    return float(np.linalg.eigvalsh(half @ half.T)[0] / m)


def with_gains_and_payloads(model: Model, fit: Fit) -> Fit:
    """The fit with the results of gains and payloads, apart from its base parameters."""
    of, evidence, ls = model.unknowns, fit.data, fit.least_squares
    estimate, found, robot = evidence.estimate, evidence.intervals, model.problem.signals.robot
    base, of_ls, kept = map(base_places, (estimate.names, ls.estimate.names, fit.essential.names))
    payloads, gains, cragg_donald = [], list[DriveGain](), None
    for one in of.payloads:
        own = np.array(
            [estimate.names.index(name) for name in one.names if name in estimate.names],
            dtype=np.intp,
        )
        covariance = found.covariance[np.ix_(own, own)] if len(own) == len(one.names) else None
        values, sigma, prior = one.nearest_body(estimate.values_of(one.names), covariance)
        pairs = zip(model.problems, of.arms, strict=True)
        name = next(problem.signals.recording for problem, arm in pairs if arm.payload is one)
        half = found.reach * sigma
        payloads.append(
            EstimatedPayload(
                recording=name,
                payload=one.payload,
                values=values,
                half=half,
                from_prior=prior,
                near=not one.names or bool(half.any()),
            )
        )
    for m, name in zip(of.motors, of.names[of.gains], strict=True):
        motor, at = robot.motors[m], estimate.names.index(name)
        value = float(robot.gain[m] * estimate.beta[at])
        width = float(np.abs(robot.gain[m]) * found.half[at])
        gains.append(
            DriveGain(
                motor=motor.name,
                unit=f"{robot.effort_units[m]}/{motor.recorded_unit}",
                described=motor.gain,
                value=value,
                half_width=width,
                determined=width < MAX_GAIN_SHARE * abs(value),
            )
        )
    if gains:
        cragg_donald = smallest_cragg_donald(
            evidence.observed.system, evidence.Z, estimate.weights, of.gains
        )
    far = [one.recording for one in payloads if not one.near]
    text = "no body of positive density is near: its values are stated or a ball's"
    return replace(
        fit,
        estimate=estimate.part(base),
        intervals=found.part(base),
        least_squares=replace(
            ls, estimate=ls.estimate.part(of_ls), intervals=ls.intervals.part(of_ls)
        ),
        essential=msgspec.structs.replace(
            fit.essential, names=tuple(fit.essential.names[k] for k in kept)
        ),
        gains=tuple(gains),
        cragg_donald=cragg_donald,
        payloads=tuple(payloads),
        warnings=(*fit.warnings, *(f"payload of {name}: {text}" for name in far)),
    )


def gain_sections(gains: Sequence[DriveGain], cragg_donald: float | None) -> list[Section]:
    """Identified drive gains beside those of the description, and how well they are told apart from
    the arm: the smallest eigenvalue of the statistic of Cragg and Donald.
    """
    if not gains:
        return []
    table = Table(
        columns=columns("motor", numbers=("described", "identified", "±95%", "in %"))
        + columns("unit", ""),
        rows=tuple(
            (
                one.motor,
                Number(one.described, ".4g"),
                Number(one.value, ".4g"),
                Number(one.half_width, ".2g"),
                Number(
                    100 * one.half_width / abs(one.value) if one.value else math.inf,
                    ".2f",
                    most=1000,
                ),
                one.unit,
                "" if one.determined else "not determined",
            )
            for one in gains
        ),
    )
    line = (
        f"smallest Cragg-Donald eigenvalue {cragg_donald:.3g}: how well the payload "
        "separates gains and arm"
    )
    values = [f"{one.motor} {one.value:.4g} ± {one.half_width:.2g} {one.unit}" for one in gains]
    short = Section(lines=(f"drive gains: {', '.join(values)}",))
    return [Section(title="drive gains", table=table, lines=(line,), short=short)]


def payload_sections(payloads: Sequence[EstimatedPayload], joint: str) -> list[Section]:
    """The payloads as the nearest bodies of positive density."""
    found = list[Section]()
    heads = columns("", numbers=("value", "±95%")) + columns("unit", "mostly from")
    for one in payloads:
        names, units = ("mass", "centre of mass x", "y", "z", *LINK[:6]), ("kg", *["m"] * 3)
        order = [MASS, *MOMENTS, *range(6)]
        values, half, prior = one.values[order], one.half[order], one.from_prior[order]
        m, moments, width = one.values[MASS], one.values[MOMENTS], one.half[MOMENTS]
        # of the centre of mass: that of the mass is included
        values[1:4], half[1:4] = moments / m, np.hypot(width / m, moments / m**2 * one.half[MASS])
        if one.payload.mass_kg:
            half[0] = one.payload.mass_half_width_kg or np.nan
        known = (one.payload.mass_kg is not None, *[one.payload.center_of_mass_m is not None] * 3)
        rows: list[Row] = [
            (
                name,
                Number(float(value), ".4g"),
                Number(float(width), ".2g"),
                unit,
                "stated" if is_known else "prior" if from_prior else "recording",
            )
            for name, value, width, unit, is_known, from_prior in zip(
                names,
                values,
                half,
                (*units, *["kg m²"] * 6),
                (*known, *[False] * 6),
                prior,
                strict=True,
            )
        ]
        line = (
            f"stated: {one.payload.describe(joint)}; values in the frame of {joint}, inertia "
            "about its origin"
        )
        table = Table(columns=heads, rows=tuple(rows))
        mass = f"payload of {one.recording}: mass {one.values[9]:.4g} kg"
        title, short = f"payload of {one.recording}", Section(lines=(mass,))
        found.append(Section(title=title, table=table, lines=(line,), short=short))
    return found
