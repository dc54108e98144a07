"""How estimates from one recording depend on filter, decimation, position noise and start: the question of Janot2014.

Each variant changes one of them, and is fitted by least squares and by instrumental variables.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..arrays import Array
from ..data import RecordingFile, Work
from ..errors import IdentificationError
from ..estimation import one_thread
from ..methods import Iteration, identify_iv
from ..regression import Overrides, make_settings
from ..report import Document, Number, Row, Section, Table, columns, value_form

CUTOFFS = {"2.5 x bandwidth": 2.5, "10 x bandwidth": 10.0, "none": 0.0}  # times the bandwidth
DECIMATIONS = (0.5, 2.0)  # times that of the rules
STARTS = (0.001, 1000.0)  # inertias of the first pass, kg m² or kg
Values = tuple[float, float, float, float]  # LS and its half-width of the 95 % interval, IV and its half-width


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A fit by the rules in which one thing is `changed`, to the value `to`.

    `noise` is white noise, rad or m rms, that is added to the recorded position after the control loop; `start` are the
    inertias of the first pass, kg m² or kg.
    """

    changed: str
    to: str
    overrides: Overrides = field(default_factory=Overrides)
    noise: float = 0.0
    start: float = 1.0


@dataclass(frozen=True, kw_only=True)
class VariedFit:
    """The `values` of a variant by parameter, empty without a fit; `ended` is the status of iv, or why there is no fit."""

    variant: Variant
    ended: str
    values: Mapping[str, Values] = field(default_factory=dict)
    essential: tuple[str, ...] = ()


def vary(source: RecordingFile, noises: Sequence[float], work: Work) -> list[VariedFit]:
    """The fit by the rules, and a fit per variant; `noises` of the position are in rad or m rms.

    Raises `IdentificationError`: the recording cannot be fitted by the rules.
    """
    signals = source.load()
    robot, decimation = signals.robot, make_settings(signals, Overrides()).decimation
    variants = [Variant(changed="none", to="the rules")]
    for to, factor in CUTOFFS.items():
        overrides = Overrides(cutoff_hz=factor * robot.bandwidth_hz)
        variants.append(Variant(changed="cut-off", to=to, overrides=overrides))
    for factor in DECIMATIONS:
        overrides = Overrides(decimation=max(1, round(factor * decimation)))
        variants.append(Variant(changed="decimation", to=f"{overrides.decimation}", overrides=overrides))
    units = " or ".join({"rad" if joint.type == "revolute" else "m": None for joint in robot.joints})
    variants += [Variant(changed="position noise", to=f"{x:g} {units} rms", noise=x) for x in noises]
    variants += [Variant(changed="start", to=f"{x:g}", start=x) for x in STARTS]
    fits = list(work.run(fit_variant, [(source, variant) for variant in variants]))
    if not fits[0].values:
        raise IdentificationError(fits[0].ended)
    return fits


@one_thread
def fit_variant(source: RecordingFile, variant: Variant) -> VariedFit:
    """Both fits of a variant; the noise of all variants has one seed."""
    signals = source.load()
    noise = np.random.default_rng(0).standard_normal(signals.q.shape)
    signals = replace(signals, q=signals.q + variant.noise * noise)
    try:
        iteration = Iteration(inertias=np.full(signals.robot.n, variant.start))
        fit = identify_iv(signals, variant.overrides, iteration)
    except IdentificationError as error:
        return VariedFit(variant=variant, ended=str(error))
    ls = fit.least_squares
    numbers = (ls.estimate.beta, ls.intervals.half, fit.estimate.beta, fit.intervals.half)
    values = dict(zip(fit.estimate.names, zip(*(x.tolist() for x in numbers), strict=True), strict=True))
    return VariedFit(variant=variant, ended=fit.status, values=values, essential=fit.essential_names)


def moves_of(fits: Sequence[VariedFit], name: str) -> Array:
    """(fits, 2) moves of LS and of IV from the fit by the rules, in half-widths of IV there; NaN without a fit."""
    ls, _, iv, half = fits[0].values[name]
    none = (np.nan,) * 4
    values = np.array([fit.values.get(name, none) for fit in fits])
    return np.asarray(np.abs(values[:, [0, 2]] - [ls, iv]) / half)


def sensitivity_document(recording: str, fits: Sequence[VariedFit]) -> Document:
    """The largest moves of both methods by variant, and all values; the title says where least squares moves most."""
    names = fits[0].essential or tuple(fits[0].values)
    moves = np.nan_to_num([moves_of(fits, name) for name in names])  # (parameters, fits, methods)
    largest, of = moves.max(axis=0), moves.argmax(axis=0)
    rows, values = list[Row](), list[Row]()
    for k, fit in enumerate(fits):
        what = (fit.variant.changed, fit.variant.to)
        cells = [x for m in (0, 1) for x in (Number(largest[k, m] if fit.values else None, ".2g"), names[of[k, m]])]
        rows += [(*what, *cells, fit.ended)] if k else []
        for name in names:
            if name in fit.values:
                form = value_form(fit.values[name][3] / 2)
                values.append((name, *what, *(Number(x, form) for x in fit.values[name])))
    worst = fits[k := int(largest[:, 0].argmax())].variant
    ls, iv = (f"{x:.2g}" for x in largest[k])
    title = f"{recording}: LS moves by up to {ls} half-widths with {worst.changed} {worst.to}, IV by {iv}"
    heads = columns("changed", "to", numbers=("LS moves",)) + columns("at", numbers=("IV moves",))
    lines = (
        f"moves from the fit by the rules, in half-widths of its 95 % interval of IV: the largest of {len(names)} essential "
        "parameters",
        "position noise is added to the recording, after the control loop; start: inertias of the first pass",
    )
    moves_table = Table(columns=heads + columns("at", "iv ended"), rows=tuple(rows))
    whole = columns("parameter", "changed", "to", numbers=("LS", "±95%", "IV", "±95%"))
    table = Table(columns=whole, rows=tuple(values))
    sections = Section(table=moves_table, lines=lines), Section(title="values", table=table, short=Section())
    return Document(title=title, sections=sections)
