"""The report of a fit: verdict, parameters, errors, settings and tests."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from msgspec import UNSET

from ..regression import ROWS
from ..report import (
    NO_FIXED_POINT,
    Cell,
    Document,
    Number,
    Parameter,
    Row,
    Section,
    Table,
    columns,
    value_form,
)
from ..trust import LEVELS
from . import recording_report as shared
from .fit import Fit
from .gain_results import gain_sections, payload_sections
from .parameters import fitted_parameters

MAX_SHORT_PARAMETERS, MAX_SHORT_WARNINGS = 10, 4
HIDDEN = Section()  # the `short` of what only `--all` prints
PARAMETERS = "parameters"  # title of the section of all values


def fit_document(fit: Fit) -> Document:
    """A fit as a report, the verdict first."""
    held, notes, several = fit.held_out_error_percent, fit.notes, len(fit.recordings) > 1
    signals, parameters = fit.problem.signals, tuple(fitted_parameters(fit).parameters.values())
    settings = Section(
        title="settings and tests",
        lines=(
            *(() if several else shared.settings_lines(signals, fit.settings, used="fitted")),
            f"cond(W) {fit.estimate.condition_number:.4f}, with columns of norm one "
            f"{fit.estimate.condition_number_scaled:.4f}; {_rows_line(fit)}",
            *(_iv_lines(fit) if fit.passes else ()),
            *(() if several else shared.recording_lines(signals)),
        ),
        short=HIDDEN,
    )
    percents = shared.half_width_percents(parameters)
    return Document(
        title=f"{signals.robot.name}: {first_line(fit, held, percents)}",
        badge=fit.trust.verdict,
        figures=shared.main_figures(
            fit.errors[-1].relative_error_percent,
            held,
            {f"held out, links of the {fit.data.prior_source}": fit.data.prior_error_percent},
            percents,
        ),
        sections=(
            _verdict_section(fit, notes),
            _trust_section(fit),
            *gain_sections(fit),
            *payload_sections(fit),
            _parameters(fit, parameters),
            *_consistent(fit),
            *(_iv_sections(fit) if fit.passes else ()),
            shared.errors_section(fit.errors, signals.robot.effort_units),
            *([shared.recordings_section(fit.recordings, fit.own)] if several else []),
            settings,
            *_expressions(fit),
        ),
    )


def first_line(fit: Fit, held: float | None, percents: Mapping[str, float]) -> str:
    """Method and its reason, status, verdict with its worst finding, and the main figures."""
    verdict = ": ".join(text for text in (fit.trust.verdict, fit.trust.finding) if text)
    figures = shared.headline(fit.errors) + ("" if held is None else f", {held:.2g} % held out")
    alone = (
        " with instruments: reference"
        if fit.passes and fit.passes[fit.solution.returned - 1].by_reference is not None
        else ""
    )
    return (
        f"{fit.method.upper()} ({fit.solution.method_reason}), {fit.status}{alone}, "
        f"{verdict}; {figures}; {_determined(percents, len(fit.full.names))}"
    )


def _determined(percents: Mapping[str, float], of: int) -> str:
    """How many parameters the recordings determine, and how closely."""
    text = f"{len(percents)} of {of} parameters determined"
    if not percents:
        return text
    worst = max(percents, key=percents.__getitem__)
    if len(percents) == 1:
        return f"{text}: {worst} to ±{percents[worst]:.2g} %"
    return (
        f"{text}, half of them to ±{np.median([*percents.values()]):.2g} %, the worst "
        f"({worst}) to ±{percents[worst]:.2g} %"
    )


def _verdict_section(fit: Fit, notes: Sequence[str]) -> Section:
    reason = f": {why}" if (why := fit.solution.reason) else ""
    lines = (
        [f"assumed: {', '.join(one.what for one in fit.trust.assumed)}"]
        if fit.trust.assumed
        else []
    )
    status, hz = f"status: {fit.status}{reason}", fit.problem.signals.sample_rate_hz
    error = shared.error_line(fit.errors, fit.settings.for_errors(hz))
    lines += [status, error, *(f"note: {text}" for text in notes)]
    if fit.status in NO_FIXED_POINT:
        by_ls = [
            shared.validated(one.problem, one.arm.values(fit.least_squares.estimate))
            for one in fit.recordings
        ]
        percent = _percent(shared.errors_on(by_ls)[-1].relative_error_percent)
        lines.append(f"least squares has a torque error of {percent}: --method wls")
    left_out = len(fit.warnings) - MAX_SHORT_WARNINGS
    more = [f"{left_out} more warnings (--all)"] if left_out > 0 else []
    stated = [line for line in lines if reason or line != status]  # the title has the status
    return Section(
        lines=(*lines, _essential_line(fit)),
        warnings=fit.warnings,
        short=Section(lines=(*stated, *more), warnings=fit.warnings[:MAX_SHORT_WARNINGS]),
    )


def _trust_section(fit: Fit) -> Section:
    """Every test of the fit, worst first; in short those that found something."""
    lines = tuple(
        f"{line.level}: {line.test}: {line.text.removeprefix('not made: ')}"
        for line in fit.trust.lines
    )
    tests = {
        level: [line.test for line in fit.trust.lines if line.level == level] for level in LEVELS
    }
    found = len(tests["do not use"]) + len(tests["caution"])
    passed = f"{len(tests['ok'])} of {len(lines)} checks passed"
    for what, names in (
        ("inconclusive", tests["cannot tell"]),
        ("not possible", tests["not made"]),
    ):
        passed += f"; {len(names)} {what}: {', '.join(names)}" if names else ""
    return Section(
        title=f"verdict: {fit.trust.verdict}",
        lines=lines,
        short=Section(lines=(*lines[:found], f"{passed} (--all)")),
    )


def _essential_line(fit: Fit) -> str:
    reduction, count, of = (
        fit.essential,
        len(fit.essential_names),
        len(fit.full.names),
    )
    by, kept = " (by least squares)" if fit.passes else "", len(reduction.names)
    line = f"{count} of {of} parameters determined{by}"
    line += f", {kept - count} unclear: an interval wider than the value" if kept > count else ""
    if reduction.F is None or not math.isfinite(reduction.F):
        return line
    return (
        f"{line}, {of - kept} without effect on the torque: F test p = {reduction.p_value:.2g} "
        f"(corrected for correlation p = {reduction.p_effective:.2g})"
    )


def _parameters(fit: Fit, parameters: Sequence[Parameter]) -> Section:
    rows: list[Row] = []
    prior, error = bool(fit.data.prior), fit.data.prior_error_percent
    for p in parameters:
        form, percent = value_form(p.sigma), 100 * p.half / abs(p.value) if p.value else math.inf
        numbers: list[Cell] = [
            Number(p.value, form),
            Number(p.half, form),
            Number(percent, ".2f", most=1000),
        ]
        numbers += ["" if p.prior is UNSET else Number(p.prior, form)] * prior
        mark = "yes" if p.essential else ""
        rows.append((p.name, *numbers, p.unit, Number(p.sigma, form), mark))
    heads = columns("parameter", numbers=("value", "±95%", "in %", *["prior"] * prior)) + columns(
        "unit"
    )
    torque = dict(
        zip(fit.data.estimate.names, np.linalg.norm(fit.data.W, axis=0).tolist(), strict=True)
    )
    essential = [k for k, p in enumerate(parameters) if p.essential]
    essential.sort(key=lambda k: -abs(parameters[k].value) * torque[parameters[k].name])
    places = sorted(essential[:MAX_SHORT_PARAMETERS])
    left_out = f"; {len(rows) - len(places)} others: --all" if len(places) < len(rows) else ""
    meaning = "±95%: half-width of the 95 % interval"
    if error is not None:
        meaning += (
            f"; torque error held out: links of the {fit.data.prior_source} {_percent(error)}, "
            f"fit {_percent(fit.held_out_error_percent)}"
        )
    return Section(
        title=PARAMETERS,
        table=Table(
            columns=heads + columns(numbers=("sigma",)) + columns("essential"), rows=tuple(rows)
        ),
        lines=(meaning, "sigma assumes a white residual, the interval does not"),
        short=Section(
            title=f"the {len(places)} that move the torque most, of {len(essential)} determined",
            table=Table(columns=heads, rows=tuple(rows[k][: len(heads)] for k in places)),
            lines=(meaning + left_out,),
        ),
    )


def _consistent(fit: Fit) -> list[Section]:
    """The physically consistent parameters and their moves from the estimate."""
    c = fit.consistent_set
    if c is None:
        return []
    alike = fit.trust.line("consistent").value == c.chi2
    own = "" if alike else " (the verdict's line `consistent` has its own)"
    heads = columns("parameter", numbers=("value", "±95%")) + columns("unit", "mostly from")
    rows, of_base = (
        [
            (
                p.name,
                Number(round(p.value, 12) + 0.0, ".5g"),
                Number(p.half_width or 0.0, ".2g"),
                p.unit,
                "prior" if p.from_prior else "recording",
                Number(p.move or 0.0, "+.2g"),
            )
            for p in parameters
        ]
        for parameters in (fit.standard_parameters, c.base_parameters or ())
    )
    moves = [(p.name, p.move or 0.0) for p in c.base_parameters or ()]
    left = [f"{name} ({move:+.2g})" for name, move in moves if abs(move) > 1]
    known = [p for p in fit.standard_parameters if p.from_prior]
    lines = (
        "all pseudo-inertias and rotor inertias are positive, friction adds no energy; prior: "
        f"{c.prior}{own}",
        f"added chi² {c.chi2:.3g} on {len(moves)} parameters; largest move "
        f"{c.largest_move:.2g} half-widths of the "
        f"95 % interval, of {c.moved_most}",
        *([f"moved by more than one half-width: {', '.join(left)}"] if left else []),
        f"relative torque error {_percent(fit.errors[-1].relative_error_percent)} → "
        f"{_percent(c.relative_error_percent)}",
        f"{len(known)} of {len(rows)} values are the prior's: the torques say nothing about them",
    )
    title = "physically consistent standard parameters"
    table = Table(columns=heads, rows=tuple(row[:-1] for row in rows))
    short = Section(title=title, lines=lines)
    base = Table(columns=heads + columns(numbers=("moved, half-widths",)), rows=tuple(of_base))
    whole = (*lines, f"certificate {c.certificate:.1e} (Newton decrement)")
    return [
        Section(title=title, table=table, lines=whole, short=short),
        Section(title="physically consistent base parameters", table=base, short=HIDDEN),
    ]


def _percent(error: float | None) -> str:
    return "-" if error is None else f"{error:.2f} %"


def _rows_line(fit: Fit) -> str:
    """The number of rows by their weights, and what weighs nothing."""
    percent = fit.settings.low_speed_percent
    slow = "4 % of the peak speed (1 % with root, load or Stribeck terms)"
    slow = (
        f"{slow}, or 4 deviations of its noise"
        if percent is None
        else f"{percent:g} % of the peak speed"
    )
    line = f"{fit.estimate.rows:.0f} of {fit.data.observed.share.size} rows"
    if percent == 0:
        return line
    if fit.settings.ramp_rows == ROWS:
        return f"{line}, those below {slow} left out"
    return f"{line}; samples below {slow} weigh nothing, ramps of {fit.settings.ramp_rows:g} rows"


def _iv_sections(fit: Fit) -> list[Section]:
    """The passes of the instrumental variable method, and the errors of the direct model."""
    passes = Table(
        columns=columns(numbers=("pass",))
        + columns("instruments", numbers=("|rho|", "largest change, sigma"))
        + columns("of", numbers=("tracking %", "gains from", "to", "cond ZᵀW")),
        rows=tuple(
            (
                Number(number, "d"),
                p.kind,
                Number(p.estimate.residual_norm, ".3f"),
                Number(p.change_sigma, ".2g"),
                p.changed,
                Number(p.tracking_percent, ".2f"),
                Number(float(p.gains.min()), ".3g"),
                Number(float(p.gains.max()), ".3g"),
                Number(p.estimate.condition_number_scaled, ".1f"),
            )
            for number, p in enumerate(fit.passes, 1)
        ),
    )
    title = f"passes from start: {fit.solution.start}"
    sections = [Section(title=title, table=passes, short=HIDDEN)]
    if fit.direct:
        direct = Table(
            columns=columns("joint", numbers=("position", "torque")),
            rows=tuple(
                (
                    d.name,
                    Number(d.position_error_percent, ".2f"),
                    Number(d.torque_error_percent, ".2f"),
                )
                for d in fit.direct
            ),
        )
        sections.append(
            Section(title="simulated robot against the recording, %", table=direct, short=HIDDEN)
        )
    return sections


def _iv_lines(fit: Fit) -> tuple[str, ...]:
    """Tests of the instruments, and why a pass could not be simulated."""
    used, (off, at) = fit.rows_used_percent, fit.contrast
    return (
        *(
            f"pass {k}: instruments {p.kind}: {p.reason}"
            for k, p in enumerate(fit.passes, 1)
            if p.reason
        ),
        f"instruments: smallest correlation with W {fit.solution.strength:.3f}, first-stage F "
        f"{fit.data.first_stage_F:.3g}",
        f"least squares differs by {off:.2g} half-widths, at {at}",
        f"{used:.1f} % of the rows used; reference {fit.reference}, controller {fit.controller}",
    )


def _expressions(fit: Fit) -> list[Section]:
    """The regrouped parameters as sums of standard parameters."""
    lines = tuple(
        f"{name} = {expression}"
        for name, expression in zip(fit.base.names, fit.base.expressions, strict=True)
        if expression != name and name in fit.estimate.names
    )
    return [Section(title="regrouped parameters", lines=lines, short=HIDDEN)] if lines else []
