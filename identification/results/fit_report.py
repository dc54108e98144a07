"""The report of a fit: verdict, parameters, errors, settings and tests."""

import math
from collections.abc import Mapping

import numpy as np
from msgspec import UNSET, UnsetType

from ..regression import ROWS
from ..report import (
    NO_FIXED_POINT,
    Document,
    FitFile,
    Number,
    Section,
    Table,
    base_name,
    columns,
    known,
    value_form,
)
from ..trust import LEVELS, Trust
from . import recording_report as shared

MAX_SHORT_PARAMETERS, MAX_SHORT_WARNINGS = 10, 4
HIDDEN = Section()  # the `short` of what only `--all` prints
PARAMETERS = "parameters"  # title of the section of all values


def fit_document(fit: FitFile) -> Document:
    """Make the report of a fit's file, the verdict first."""
    finding = Trust(lines=tuple(fit.trust)).finding if fit.trust else ""
    held, several = known(fit.held_out_error_percent), fit.recordings or ()
    percents = shared.half_width_percents(fit.parameters)
    assert fit.provenance is not None
    prior = {f"held out, links of the {fit.prior_source}": known(fit.prior_held_out_error_percent)}
    return Document(
        title=f"{fit.provenance.robot}: {first_line(fit, finding, held, percents)}",
        badge=fit.verdict or "",
        figures=shared.main_figures(fit.moving_relative_error_percent, held, prior, percents),
        sections=(
            _verdict_section(fit),
            _trust_section(fit),
            *shared.gain_sections(fit),
            *shared.payload_sections(fit),
            _parameters(fit),
            *_consistent(fit),
            *(_iv_sections(fit) if fit.iterations else ()),
            shared.errors_section(fit.errors),
            *([shared.recordings_section(fit)] if several else []),
            Section(
                title="settings and tests",
                lines=(
                    *(() if several else shared.settings_lines(fit, used="fitted")),
                    f"cond(W) {_number(fit.condition_number, '.4f')}, with columns of norm one "
                    f"{_number(fit.condition_number_scaled, '.4f')}; {_rows_line(fit)}",
                    *(_iv_lines(fit) if fit.iterations else ()),
                    *(() if several else shared.recording_lines(fit)),
                ),
                short=HIDDEN,
            ),
            *_expressions(fit),
        ),
    )


def first_line(
    fit: FitFile, finding: str, held: float | None, percents: Mapping[str, float]
) -> str:
    """Return the first line: method, status, verdict with its worst finding, and the main
    figures.
    """
    verdict = ": ".join(text for text in (fit.verdict, finding) if text)
    figures = shared.headline(fit.errors) + ("" if held is None else f", {held:.2g} % held out")
    # the status alone has no reason where instruments are those of a simulated robot
    alone = " with instruments: reference" if fit.status == "converged" and fit.reason else ""
    return (
        f"{str(fit.method).upper()} ({fit.method_reason}), {fit.status}{alone}, "
        f"{verdict}; {figures}; {_determined(percents, fit.size)}"
    )


def _determined(percents: Mapping[str, float], of: int) -> str:
    """Return how many parameters are well determined, and how closely."""
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


def _verdict_section(fit: FitFile) -> Section:
    reason = f": {fit.reason}" if fit.reason else ""
    assumed = [one.what for one in fit.assumed or ()]
    first = [f"assumed: {', '.join(assumed)}"] if assumed else []
    status = [f"status: {fit.status}{reason}"]
    error = _percent(known(fit.least_squares_error_percent))
    by_ls = [f"least squares has a torque error of {error}: --method wls"]
    last = [
        shared.error_line(fit.errors, fit.error_cutoff_hz),
        *(f"note: {text}" for text in fit.notes),
        *(by_ls if fit.status in NO_FIXED_POINT else []),
    ]
    left_out = len(fit.warnings) - MAX_SHORT_WARNINGS
    more = [f"{left_out} more warnings (--all)"] if left_out > 0 else []
    return Section(
        lines=(*first, *status, *last, _essential_line(fit)),
        warnings=tuple(fit.warnings),
        short=Section(
            lines=(*first, *(status if reason else []), *last, *more),  # the title has the status
            warnings=tuple(fit.warnings[:MAX_SHORT_WARNINGS]),
        ),
    )


def _trust_section(fit: FitFile) -> Section:
    """Make the section of all tests, worst first; the short form has those with a finding."""
    tests = fit.trust or []
    lines = tuple(
        f"{line.level}: {line.test}: {line.text.removeprefix('not made: ')}" for line in tests
    )
    of = {level: [line.test for line in tests if line.level == level] for level in LEVELS}
    others = [("inconclusive", of["cannot tell"]), ("not possible", of["not made"])]
    passed = (
        f"{len(of['ok'])} of {len(lines)} checks passed",
        *(f"{len(names)} {what}: {', '.join(names)}" for what, names in others if names),
    )
    found = lines[: len(of["do not use"]) + len(of["caution"])]
    return Section(
        title=f"verdict: {fit.verdict}",
        lines=lines,
        short=Section(lines=(*found, f"{'; '.join(passed)} (--all)")),
    )


def _essential_line(fit: FitFile) -> str:
    if not fit.essential:  # a file of an earlier version
        return f"{fit.size} parameters"
    count, unclear = len(fit.essential.names), len(fit.unclear)
    line = (
        f"{count} of {fit.size} parameters determined"
        + (" (by least squares)" if fit.iterations else "")
        + (f", {unclear} unclear: an interval wider than the value" if unclear else "")
    )
    if fit.essential.F is None or not math.isfinite(fit.essential.F):
        return line
    return (
        f"{line}, {fit.size - count - unclear} without effect on the torque: F test "
        f"p = {fit.essential.p_value:.2g} (corrected for correlation "
        f"p = {fit.essential.p_effective:.2g})"
    )


def _parameters(fit: FitFile) -> Section:
    error = known(fit.prior_held_out_error_percent)
    prior = any(p.prior is not UNSET for p in fit.parameters)
    rows = [
        (
            p.name,
            Number(p.value, form),
            Number(p.half, form),
            Number(p.half_percent, ".2f", most=1000),
            *(["" if p.prior is UNSET else Number(p.prior, form)] if prior else []),
            p.unit,
            Number(p.sigma, form),
            "yes" if p.essential else "",
        )
        for p in fit.parameters
        for form in [value_form(p.sigma)]
    ]
    heads = columns("parameter", numbers=("value", "±95%", "in %", *["prior"] * prior)) + columns(
        "unit"
    )
    essential = [k for k, p in enumerate(fit.parameters) if p.essential]
    essential.sort(key=lambda k: -fit.parameters[k].torque)
    places = sorted(essential[:MAX_SHORT_PARAMETERS])
    left_out = f"; {len(rows) - len(places)} others: --all" if len(places) < len(rows) else ""
    meaning = "±95%: half-width of the 95 % interval" + (
        ""
        if error is None
        else f"; torque error held out: links of the {fit.prior_source} {_percent(error)}, "
        f"fit {_percent(known(fit.held_out_error_percent))}"
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


def _consistent(fit: FitFile) -> list[Section]:
    """Make the section of physically consistent parameters and their changes from the estimate."""
    if not (c := fit.consistent):
        return []
    standard, line = fit.standard_parameters or [], fit.line_of.get("consistent")
    own = " (the verdict's line `consistent` has its own)"
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
        for parameters in (standard, c.base_parameters or [])
    )
    moves = [(p.name, p.move or 0.0) for p in c.base_parameters or ()]
    left = [f"{name} ({move:+.2g})" for name, move in moves if abs(move) > 1]
    lines = (
        "all pseudo-inertias and rotor inertias are positive, friction adds no energy; prior: "
        + c.prior
        + ("" if line is not None and line.value == c.chi2 else own),
        f"added chi² {c.chi2:.3g} on {len(moves)} parameters; largest move "
        f"{c.largest_move:.2g} half-widths of the "
        f"95 % interval, of {c.moved_most}",
        *([f"moved by more than one half-width: {', '.join(left)}"] if left else []),
        f"relative torque error {_percent(fit.moving_relative_error_percent)} → "
        f"{_percent(c.relative_error_percent)}",
        f"{sum(p.from_prior for p in standard)} of {len(rows)} values are the prior's: the "
        "torques say nothing about them",
    )
    title = "physically consistent standard parameters"
    return [
        Section(
            title=title,
            table=Table(columns=heads, rows=tuple(row[:-1] for row in rows)),
            lines=(*lines, f"certificate {c.certificate:.1e} (Newton decrement)"),
            short=Section(title=title, lines=lines),
        ),
        Section(
            title="physically consistent base parameters",
            table=Table(
                columns=heads + columns(numbers=("moved, half-widths",)), rows=tuple(of_base)
            ),
            short=HIDDEN,
        ),
    ]


def _percent(error: float | None) -> str:
    return "-" if error is None else f"{error:.2f} %"


def _number(value: float | UnsetType | None, form: str) -> str:
    return format(value, form) if isinstance(value, float) else "-"


def _rows_line(fit: FitFile) -> str:
    """Return a line on the number of rows by their weights, and on what has zero weight."""
    percent = (fit.low_speed_percent or {}).get("iv" if fit.method == "iv" else "ls")
    slow = (
        "4 % of the peak speed (1 % with root, load or Stribeck terms), or 4 deviations of its "
        "noise"
        if percent is None
        else f"{percent:g} % of the peak speed"
    )
    line = f"{fit.rows} of {fit.recorded_rows} rows" if fit.recorded_rows else f"{fit.rows} rows"
    if percent == 0:
        return line
    if fit.ramp_rows == ROWS:
        return f"{line}, those below {slow} left out"
    return f"{line}; samples below {slow} weigh nothing, ramps of {fit.ramp_rows:g} rows"


def _iv_sections(fit: FitFile) -> list[Section]:
    """Make the sections of the iterations, and of the errors of the direct model."""
    direct = tuple(
        (d.name, Number(d.position_error_percent, ".2f"), Number(d.torque_error_percent, ".2f"))
        for d in fit.direct_model or ()
    )
    sections = {
        f"passes from start: {fit.start}": Table(
            columns=columns(numbers=("pass",))
            + columns("instruments", numbers=("|rho|", "largest change, sigma"))
            + columns("of", numbers=("tracking %", "gains from", "to", "cond ZᵀW")),
            rows=tuple(
                (
                    Number(number, "d"),
                    p.instruments,
                    Number(p.residual_norm, ".3f"),
                    Number(p.largest_change_sigma, ".2g"),
                    p.changed_most,
                    Number(p.tracking_error_percent, ".2f"),
                    *(Number(end(gains), ".3g") for end in (min, max)),
                    Number(p.condition_number_ztw, ".1f"),
                )
                for number, p in enumerate(fit.iterations or (), 1)
                for gains in [[math.nan if gain is None else gain for gain in p.gains]]
            ),
        )
    }
    if direct:
        sections["simulated robot against the recording, %"] = Table(
            columns=columns("joint", numbers=("position", "torque")), rows=direct
        )
    return [Section(title=title, table=table, short=HIDDEN) for title, table in sections.items()]


def _iv_lines(fit: FitFile) -> tuple[str, ...]:
    """Return lines on the tests of the instruments, and why an iteration could not be simulated."""
    tests = fit.instrument_tests or {}
    return (
        *(
            f"pass {k}: instruments {p.instruments}: {p.reason}"
            for k, p in enumerate(fit.iterations or (), 1)
            if p.reason
        ),
        f"instruments: smallest correlation with W {_number(tests.get('strength'), '.3f')}, "
        f"first-stage F {_number(tests.get('first_stage_F'), '.3g')}",
        f"least squares differs by {_number(fit.contrast_half_widths, '.2g')} half-widths, at "
        f"{fit.contrast_parameter}",
        f"{_number(fit.rows_used_percent, '.1f')} % of the rows used; reference {fit.reference}, "
        f"controller {fit.controller}",
    )


def _expressions(fit: FitFile) -> list[Section]:
    """Make the section of regrouped parameters as sums of standard parameters."""
    lines = tuple(
        f"{p.name} = {p.expression}"
        for p in fit.parameters
        if p.expression not in (None, base_name(p.name)) and base_name(p.name) == p.name
    )
    return [Section(title="regrouped parameters", lines=lines, short=HIDDEN)] if lines else []
