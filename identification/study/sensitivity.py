"""The sensitivity of estimates to filter, decimation, position noise, start and gain update.

This is the question of Janot2014. Each variant changes one of them, and is fitted by least squares
and by instrumental variables.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..arrays import Array
from ..data import RecordingFile, Work
from ..errors import NoFitError, RobotIdimError
from ..estimation import one_thread
from ..methods import Iteration
from ..model import described_parameters
from ..regression import Overrides, make_settings
from ..report import Document, Number, Row, Section, Table, columns, value_form
from ..results import identify_iv

CUTOFFS = {"2.5 x bandwidth": 2.5, "10 x bandwidth": 10.0, "none": 0.0}  # times the bandwidth
DECIMATIONS = (0.5, 2.0)  # times that of the rules
NOISES = (4e-6, 4e-5, 8e-5)  # of the position, times the travel of the joint that travels least
STARTS = (0.001, 1000.0)  # initial inertias (`regular`), kg m² or kg


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A fit with the default settings in which one thing is `changed`, to the value `to`.

    Attributes:
        changed: what is changed; `none` for the fit with the default settings.
        to: its value, in words.
        overrides: settings that replace those of the description.
        noise: white noise, rad or m rms, that is added to the recorded position after the control
            loop.
        start: initial inertias, kg m² or kg; None to start from least squares.
        gain_update: False if the simulated robot keeps the recorded gains.
    """

    changed: str
    to: str
    overrides: Overrides = field(default_factory=Overrides)
    noise: float = 0.0
    start: float | None = None
    gain_update: bool = True


@dataclass(frozen=True, kw_only=True)
class VariedFit:
    """The estimates of a variant by both methods.

    Attributes:
        variant: what was changed.
        ended: status of iv, or why there is no fit.
        passes: number of iterations of iv.
        values: LS, its 95 % half-width, IV, and its 95 % half-width by parameter; empty without a
            fit.
        essential: names of the essential parameters.
        units: units by parameter; empty without a fit.
        known: `true`, of a simulation, or `described`; and the values of `[parameters]` by
            parameter.
    """

    variant: Variant
    ended: str
    passes: int = 0
    values: Mapping[str, tuple[float, float, float, float]] = field(default_factory=dict)
    essential: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    known: tuple[str, Mapping[str, float]] = ("", {})


def vary(source: RecordingFile, noises: Sequence[float] | None, work: Work) -> list[VariedFit]:
    """Fit a recording with the default settings, and once per variant.

    Parameters
    ----------
    source : the recording.
    noises : noises to be added to the position, rad or m rms; None for shares of the travel of the
        joint that travels least.
    work : where the variants are fitted.

    Returns
    -------
    The fits; the first has the default settings. A variant that cannot be fitted has the reason in
    `ended`.

    Raises
    ------
    BadInputError : the recording cannot be read, a setting does not suit it, or a worker ends
        early.
    NoFitError : the fit with the default settings failed.
    """
    signals = source.load()
    robot, decimation = signals.robot, make_settings(signals, Overrides()).decimation
    if noises is None:
        noises = [float(f"{part * np.ptp(signals.q, axis=0).min():.1g}") for part in NOISES]
    units = " or ".join(
        {"rad" if joint.type == "revolute" else "m": None for joint in robot.joints}
    )
    variants = [
        Variant(changed="none", to="default settings"),
        *(
            Variant(changed="cut-off", to=to, overrides=Overrides(cutoff_hz=x * robot.bandwidth_hz))
            for to, x in CUTOFFS.items()
        ),
        *(
            Variant(changed="decimation", to=f"{x}", overrides=Overrides(decimation=x))
            for x in (max(1, round(factor * decimation)) for factor in DECIMATIONS)
        ),
        *(Variant(changed="position noise", to=f"{x:g} {units} rms", noise=x) for x in noises),
        *(Variant(changed="start", to=f"{x:g}", start=x) for x in STARTS),
        Variant(changed="gain update", to="off", gain_update=False),
    ]
    fits = list(work.run(fit_variant, [(source, variant) for variant in variants]))
    if not fits[0].values:
        raise NoFitError(fits[0].ended)
    return fits


@one_thread
def fit_variant(source: RecordingFile, variant: Variant) -> VariedFit:
    """Fit a variant by both methods.

    The noise of all variants has one seed.

    Parameters
    ----------
    source : the recording.
    variant : what is changed.

    Returns
    -------
    Both fits. If one cannot be made, there are no values, and `ended` says why.

    Raises
    ------
    BadInputError : the recording cannot be read.
    """
    signals = source.load()
    signals = replace(
        signals,
        q=signals.q + variant.noise * np.random.default_rng(0).standard_normal(signals.q.shape),
    )
    is_regular = variant.start is not None
    iteration = Iteration(
        gain_update=variant.gain_update,
        start="regular" if is_regular else "ls",
        inertias=np.full(signals.robot.n, variant.start) if is_regular else None,
    )
    try:
        fit = identify_iv(signals, variant.overrides, iteration)
    except RobotIdimError as error:
        return VariedFit(variant=variant, ended=str(error))
    ls = fit.least_squares
    numbers = (ls.estimate.beta, ls.intervals.half, fit.estimate.beta, fit.intervals.half)
    base, model = fit.base, fit.problem.model
    described = described_parameters(model, base).tolist() if signals.robot.parameters else ()
    return VariedFit(
        variant=variant,
        ended=fit.status,
        passes=len(fit.passes),
        values=dict(
            zip(fit.estimate.names, zip(*(x.tolist() for x in numbers), strict=True), strict=True)
        ),
        essential=fit.essential_names,
        units=dict(zip(base.names, base.units, strict=True)),
        known=(
            "true" if signals.provenance.startswith("simulated") else "described",
            dict(zip(base.names, described, strict=False)),
        ),
    )


def changes_of(fits: Sequence[VariedFit], name: str) -> Array:
    """Return the changes of a parameter from the fit with the default settings.

    Parameters
    ----------
    fits : fits of `vary`; the first has the default settings.
    name : name of the parameter.

    Returns
    -------
    Absolute changes, shape (fits, 4): of LS and of IV in half-widths of IV in the first fit, then
    of LS and of IV in half-widths of the changed fit. Missing values are NaN.
    """
    ls, _, iv, half = fits[0].values[name]
    values = np.array([fit.values.get(name, (np.nan,) * 4) for fit in fits])
    moved = np.abs(values[:, [0, 2]] - [ls, iv])
    return np.asarray(np.c_[moved / half, moved / values[:, [1, 3]]])


def sensitivity_document(recording: str, fits: Sequence[VariedFit]) -> Document:
    """Make the report of the largest changes of both methods by variant, and all values.

    The title says where least squares changes most.

    Parameters
    ----------
    recording : name of the recording.
    fits : fits of `vary`; the first has the default settings.

    Returns
    -------
    The report.
    """
    names = fits[0].essential or tuple(fits[0].values)
    # (parameters, fits, both methods twice)
    moves = np.nan_to_num([changes_of(fits, name) for name in names])
    largest, of = moves.max(axis=0), moves.argmax(axis=0)
    rows: list[Row] = [
        (
            fit.variant.changed,
            fit.variant.to,
            *(cell for m in (0, 1) for cell in (shown[m], names[of[k, m]], shown[m + 2])),
            Number(fit.passes or None, "d"),
            fit.ended,
        )
        for k, fit in list(enumerate(fits))[1:]
        for shown in [[Number(x if fit.values else None, ".2g") for x in largest[k]]]
    ]
    values = Table(
        columns=columns(
            "parameter",
            "changed",
            "to",
            numbers=("LS", "95 %\nhalf-width", "IV", "95 %\nhalf-width"),
        ),
        rows=tuple(
            # with the digits that the interval of IV leaves
            (
                name,
                fit.variant.changed,
                fit.variant.to,
                *(Number(x, value_form(found[3] / 2)) for x in found),
            )
            for fit in fits
            for name in names
            if (found := fit.values.get(name))
        ),
    )
    worst = fits[k := int(largest[:, 0].argmax())].variant
    return Document(
        title=f"{recording}: LS changes by up to {largest[k, 0]:.2g} half-widths with "
        f"{worst.changed} {worst.to}, IV by {largest[k, 1]:.2g}",
        sections=(
            Section(
                table=Table(
                    columns=(
                        *columns("changed", "to", numbers=("change\nof LS",)),
                        *columns("of", numbers=("own", "change\nof IV")),
                        *columns("of", numbers=("own", "iterations")),
                        *columns("status of iv"),
                    ),
                    rows=tuple(rows),
                ),
                lines=(
                    f"change: the largest of {len(names)} essential parameters from the fit with "
                    "the default settings, in its 95 % half-widths of IV; own: in half-widths of "
                    "the changed fit",
                    "position noise is added to the recording, that is, outside the control loop; "
                    "start: initial inertias of all links, kg m² or kg",
                ),
            ),
            Section(title="values", table=values, short=Section()),
        ),
    )
