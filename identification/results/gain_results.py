"""Drive gains in a fit, equation (I): the recorded effort is a regressor, its instrument the effort
that the model predicts.

E_m is the torque of motor m by its described gain, kappa_m the factor on it: a term `Drives` like
the others. What is stated of gains, masses and centres of mass has half-widths, which intervals
count. Results of gains and payloads stand apart from the base parameters.
"""

import math

import numpy as np

from ..methods import Model
from ..model import LINK
from ..report import (
    DriveGain,
    FitFile,
    Number,
    PayloadOfFit,
    Row,
    Section,
    StandardParameter,
    Table,
    columns,
    known,
)
from ..trust import FitData
from .consistent import standard_parameters

UNITS = (*["kg m²"] * 6, *["kg m"] * 3, "kg")  # of LINK
MAX_GAIN_SHARE = 0.1  # half an interval over the gain: with more it is not determined


def smallest_cragg_donald(data: FitData) -> float:
    """Smallest eigenvalue of the Cragg-Donald statistic of (E, Ê) projected off W
    and L, per instrument.

    Cragg, Donald, Testing identifiability and specification in instrumental variable models,
    Econometric Theory 9 (1993). First-stage F of a gain is blind: W explains the current.
    """
    system, Z, w = data.observed.system, data.observed.Z, data.weight[:, None]
    gains = [system.names.index(name) for name in data.gains]
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


def gains_of(model: Model, data: FitData) -> tuple[DriveGain, ...]:
    """The drive gains that were identified, in the order of their motors."""
    of, robot = model.unknowns, model.problem.signals.robot
    motors, places = [*of.motors], [data.estimate.names.index(name) for name in of.names[of.gains]]
    values = (robot.gain[motors] * data.estimate.beta[places]).tolist()
    widths = (np.abs(robot.gain[motors]) * data.intervals.half[places]).tolist()
    return tuple(
        DriveGain(
            motor=robot.motors[m].name,
            unit=f"{robot.effort_units[m]}/{robot.motors[m].recorded_unit}",
            described=robot.motors[m].gain,
            value=value,
            half_width=width,
            determined=width < MAX_GAIN_SHARE * abs(value),
        )
        for m, value, width in zip(motors, values, widths, strict=True)
    )


def payloads_of(model: Model, data: FitData) -> tuple[tuple[PayloadOfFit, ...], list[str]]:
    """The payloads as the nearest bodies of positive density, and warnings of those that are near
    none.
    """
    estimate, found, base = data.estimate, data.intervals, model.problem.base
    payloads, far = list[PayloadOfFit](), list[str]()
    for one in model.unknowns.payloads:
        own = [estimate.names.index(name) for name in one.names if name in estimate.names]
        covariance = found.covariance[np.ix_(own, own)] if len(own) == len(one.names) else None
        values, sigma, prior = one.nearest_body(estimate.values_of(one.names), covariance)
        pairs = zip(model.recordings, model.unknowns.arms, strict=True)
        name = next(recording for recording, arm in pairs if arm.payload is one)
        if one.names and not sigma.any():
            far.append(
                f"payload of {name}: no body of positive density is near: its values are stated or "
                "a ball's"
            )
        half, stated = found.reach * sigma, one.payload
        payloads.append(
            PayloadOfFit(
                recording=name,
                stated=stated.text,
                parameters=list(standard_parameters(LINK, UNITS, values, half, prior)),
                base_parameters=dict(zip(base.names, one.values(estimate).tolist(), strict=True)),
                described=stated.describe(model.problem.signals.robot.joints[-1].name),
                given=["mass"] * (stated.mass_kg is not None)
                + ["center"] * (stated.center_of_mass_m is not None),
                mass_half_width_kg=stated.mass_half_width_kg or None,
            )
        )
    return tuple(payloads), far


def gain_sections(fit: FitFile) -> list[Section]:
    """Identified drive gains beside those of the description, and how well they are told apart from
    the arm: the smallest eigenvalue of the statistic of Cragg and Donald.
    """
    if not fit.gains:
        return []
    heads = columns("motor", numbers=("described", "identified", "±95%", "in %"))
    rows = tuple(
        (
            one.motor,
            Number(one.described, ".4g"),
            Number(one.value, ".4g"),
            Number(one.half_width, ".2g"),
            Number(
                100 * one.half_width / abs(one.value) if one.value else math.inf, ".2f", most=1000
            ),
            one.unit,
            "" if one.determined else "not determined",
        )
        for one in fit.gains
    )
    line = (
        f"smallest Cragg-Donald eigenvalue {known(fit.cragg_donald) or 0.0:.3g}: how well the "
        "payload separates gains and arm"
    )
    values = [f"{one.motor} {one.value:.4g} ± {one.half_width:.2g} {one.unit}" for one in fit.gains]
    return [
        Section(
            title="drive gains",
            table=Table(columns=heads + columns("unit", ""), rows=rows),
            lines=(line,),
            short=Section(lines=(f"drive gains: {', '.join(values)}",)),
        )
    ]


def payload_sections(fit: FitFile) -> list[Section]:
    """The payloads as the nearest bodies of positive density."""
    return [_payload_section(one, fit.joints[-1].name) for one in fit.payloads or ()]


def _payload_section(one: PayloadOfFit, joint: str) -> Section:
    (*inertias, x, y, z, mass), title = one.parameters, f"payload of {one.recording}"
    m, width, weighed = mass.value, mass.half_width or 0.0, "mass" in one.given
    centre = zip(("centre of mass x", "y", "z"), (x, y, z), strict=True)
    rows = (
        _row(
            "mass",
            m,
            one.mass_half_width_kg or math.nan if weighed else width,
            mass,
            known=weighed,
        ),
        *(
            _row(
                name,
                of.value / m,
                # that of the mass is included
                float(np.hypot((of.half_width or 0.0) / m, of.value / m**2 * width)),
                of,
                "m",
                known="center" in one.given,
            )
            for name, of in centre
        ),
        *(_row(of.name, of.value, of.half_width or 0.0, of) for of in inertias),
    )
    line = f"stated: {one.described}; values in the frame of {joint}, inertia about its origin"
    short = f"{title}: mass {m:.4g} kg"
    if mass.from_prior and not weighed:
        short = (
            f"{title}: it has no scale, as nothing tells it from the arm: record without it too, "
            "or state its mass"
        )
    return Section(
        title=title,
        table=Table(
            columns=columns("", numbers=("value", "±95%")) + columns("unit", "mostly from"),
            rows=rows,
        ),
        lines=(line,),
        short=Section(lines=(short,)),
    )


def _row(
    name: str,
    value: float,
    half: float,
    of: StandardParameter,
    unit: str = "",
    *,
    known: bool = False,
) -> Row:
    source = "stated" if known else "prior" if of.from_prior else "recording"
    return name, Number(value, ".4g"), Number(half, ".2g"), unit or of.unit, source
