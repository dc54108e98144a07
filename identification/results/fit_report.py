"""The report of a fit: verdict, parameters, errors, settings and tests."""

import math
from collections.abc import Mapping

import numpy as np
from msgspec import UNSET, UnsetType

from ..regression import ROWS
from ..report import (
    NO_FIXED_POINT,
    OF_LINKS,
    Document,
    FitFile,
    Number,
    Section,
    Table,
    TrustResult,
    base_name,
    columns,
    known,
    meaning_of,
    value_form,
)
from ..trust import LEVELS
from . import recording_report as shared

MAX_SHORT_PARAMETERS, MAX_SHORT_WARNINGS = 10, 4
HIDDEN = Section()  # the `short` of what only `--all` prints
METHODS = {
    "iv": "instrumental variables (IV)",
    "wls": "least squares weighted by joint (WLS)",
    "ols": "ordinary least squares (OLS)",
}
ENDED = {
    "converged": "converged",
    "not_confirmed": "converged, not confirmed",
    "max_iterations": "not converged",
    "diverged": "diverged",
}
PARAMETERS = "Parameters"  # title of the section of all values


def fit_document(fit: FitFile) -> Document:
    """Make the report of a fit's file, the verdict first."""
    several, percents = fit.recordings or (), shared.half_width_percents(fit.parameters)
    assert fit.provenance is not None
    return Document(
        title=f"{fit.provenance.robot}: {_method(fit)}",
        badge=fit.verdict or "",
        figures=shared.main_figures(
            fit.moving_relative_error_percent,
            known(fit.held_out_error_percent),
            {"held out, a priori links": known(fit.prior_held_out_error_percent)},
            percents,
        ),
        sections=(
            _verdict_section(fit, percents),
            *shared.gain_sections(fit),
            *shared.payload_sections(fit),
            _parameters(fit),
            *_consistent(fit),
            *(_iv_sections(fit) if fit.iterations else ()),
            shared.errors_section(fit.errors),
            *([shared.recordings_section(fit)] if several else []),
            Section(
                title="Tests",
                lines=tuple(f"{x.level}: {x.test}: {_finding(x)}" for x in fit.trust or ()),
                short=HIDDEN,
            ),
            Section(
                title="Settings",
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


def _method(fit: FitFile) -> str:
    """Return method, status and number of iterations in words."""
    if not fit.iterations:
        return METHODS[str(fit.method)]
    # the status alone has no reason where instruments are those of a simulated robot
    alone = ", instruments from the reference" if fit.status == "converged" and fit.reason else ""
    return (
        f"{METHODS[str(fit.method)]}, {ENDED[str(fit.status)]} after {len(fit.iterations)} "
        f"iteration{'s' * (len(fit.iterations) > 1)}{alone}"
    )


def _finding(line: TrustResult) -> str:
    """Return the text of a test with its advice."""
    return f"{line.text}. → {line.advice}" if line.advice else line.text


def _determined(percents: Mapping[str, float], of: int) -> str:
    """Return how many parameters are well determined, and how closely."""
    text = f"{len(percents)} of {of} parameters well determined"
    if not percents:
        return text
    worst = max(percents, key=percents.__getitem__)
    return (
        f"{text}; 95 % half-width: median {np.median([*percents.values()]):.2g} %, largest "
        f"{percents[worst]:.2g} % ({worst})"
    )


def _verdict_lines(fit: FitFile) -> list[str]:
    """Return the verdict as a sentence, and by finding the test with its fact and its advice."""
    tests = fit.trust or []
    of = {level: [line.test for line in tests if line.level == level] for level in LEVELS}
    found = [line for line in tests if line.level in LEVELS[:2]]
    summary = [
        f"{len(found)} of {len(tests)} tests found a problem"
        if found
        else f"All {len(tests)} tests passed"
        if len(of["ok"]) == len(tests)
        else f"{len(of['ok'])} of {len(tests)} tests passed",
        *(f"{len(of[x])} {x}: {', '.join(of[x])}" for x in LEVELS[2:4] if of[x]),
    ]
    return [
        f"Verdict: {fit.verdict}. {'; '.join(summary)}.",
        *(
            text
            for line in found
            for text in (f"{line.test}: {line.text}", f"→ {line.advice}" * bool(line.advice))
            if text
        ),
    ]


def _verdict_section(fit: FitFile, percents: Mapping[str, float]) -> Section:
    verdict = _verdict_lines(fit) if fit.trust else []
    held, prior = fit.line_of.get("cross-validation"), known(fit.prior_held_out_error_percent)
    lines = (
        shared.error_line(fit.errors, fit.error_cutoff_hz),
        *(
            [
                f"Cross-validation: {held.text}"
                + (f"; a priori links {prior:.3g} %" if prior else "")
            ]
            if held and held.level == "ok"
            else []
        ),
        _determined(percents, fit.size),
        *([f"Status: {fit.status}: {fit.reason}"] if fit.reason else []),
        *(f"Note: {text}" for text in fit.notes),
        *(
            [
                "Least squares (method wls) has a torque error of "
                + _percent(known(fit.least_squares_error_percent))
            ]
            if fit.status in NO_FIXED_POINT
            else []
        ),
        "Assumptions that no test covers: "
        + (", ".join(one.what for one in fit.assumed or ()) or "none"),
    )
    return Section(
        lines=(*verdict, *lines, f"Method: {fit.method_reason}", _left_out(fit)),
        warnings=tuple(fit.warnings),
        short=Section(
            lines=(*verdict, *lines),
            warnings=tuple(fit.warnings[:MAX_SHORT_WARNINGS]),
            hint=f"{len(fit.warnings) - MAX_SHORT_WARNINGS} more warnings: --all"
            * (len(fit.warnings) > MAX_SHORT_WARNINGS),
        ),
    )


def _left_out(fit: FitFile) -> str:
    """Return the F test of leaving out the parameters that are not essential."""
    e = fit.essential
    if not e or e.F is None or not math.isfinite(e.F):
        return "Essential parameters: no test of leaving others out"
    return (
        f"Essential parameters: {len(e.names)}; {len(fit.unclear)} have an interval wider than "
        f"their value, {fit.size - len(e.names) - len(fit.unclear)} have no effect: F test "
        f"p = {e.p_value:.2g} (corrected for correlation p = {e.p_effective:.2g})"
    )


def _parameters(fit: FitFile) -> Section:
    prior, joints = any(p.prior is not UNSET for p in fit.parameters), [x.name for x in fit.joints]
    # Readers look for masses and inertias first, so friction comes after them.
    ordered = sorted(fit.parameters, key=lambda p: not p.name.startswith(("Ia", *OF_LINKS)))
    rows = [
        (
            p.name,
            meaning_of(p.name, joints),
            Number(p.value, form),
            Number(p.half, form),
            Number(p.half_percent, ".2f", most=1000),
            *(["" if p.prior is UNSET else Number(p.prior, form)] if prior else []),
            p.unit,
            Number(p.sigma, form),
            "yes" if p.essential else "",
        )
        for p in ordered
        for form in [value_form(p.sigma)]
    ]
    heads = columns(
        "parameter",
        "meaning",
        numbers=("value", "95 % half-width", "relative %", *["a priori"] * prior),
    ) + columns("unit")
    note = ("R: a sum of several standard parameters",) * bool(_expressions(fit))
    essential = [k for k, p in enumerate(ordered) if p.essential]
    essential.sort(key=lambda k: -ordered[k].torque)
    places = sorted(essential[:MAX_SHORT_PARAMETERS])
    return Section(
        title=PARAMETERS,
        table=Table(
            columns=heads + columns(numbers=("classical standard error",)) + columns("essential"),
            rows=tuple(rows),
        ),
        lines=(
            *note,
            "The classical standard error assumes a white residual; the interval does not.",
        ),
        short=Section(
            title=f"The {len(places)} parameters with the largest torque, of {len(essential)} well "
            "determined",
            table=Table(
                columns=(*heads[:5], heads[-1]),
                rows=tuple((*rows[k][:5], rows[k][len(heads) - 1]) for k in places),
            ),
            lines=note,
            hint=f"{len(rows) - len(places)} more parameters: --all" * (len(places) < len(rows)),
        ),
    )


def _consistent(fit: FitFile) -> list[Section]:
    """Make the section of physically consistent parameters and their changes from the estimate."""
    if not (c := fit.consistent):
        return []
    standard, line = fit.standard_parameters or [], fit.line_of.get("physically consistent")
    own = " (the test `physically consistent` has its own)"
    heads = columns("parameter", numbers=("value", "95 % half-width")) + columns(
        "unit", "mostly from"
    )
    rows, of_base = (
        [
            (
                p.name,
                Number(round(p.value, 12) + 0.0, ".5g"),
                Number(p.half_width or 0.0, ".2g"),
                p.unit,
                "a priori" if p.from_prior else "recording",
                Number(p.move or 0.0, "+.2g"),
            )
            for p in parameters
        ]
        for parameters in (standard, c.base_parameters or [])
    )
    moves = [(p.name, p.move or 0.0) for p in c.base_parameters or ()]
    left = [f"{name} ({move:+.2g})" for name, move in moves if abs(move) > 1]
    lines = (
        "All pseudo-inertias and rotor inertias are positive, and friction dissipates; prior: "
        + c.prior
        + ("" if line is not None and line.value == c.chi2 else own),
        f"Increase of chi² {c.chi2:.3g} over {len(moves)} parameters; largest change "
        f"{c.largest_move:.2g} half-widths of the "
        f"95 % interval, of {c.moved_most}",
        *([f"Changed by more than one half-width: {', '.join(left)}"] if left else []),
        f"Torque error {_percent(fit.moving_relative_error_percent)} → "
        f"{_percent(c.relative_error_percent)}",
        f"{sum(p.from_prior for p in standard)} of {len(rows)} values are a priori ones, because "
        f"the "
        "torques do not depend on them",
    )
    title = "Physically consistent standard parameters"
    return [
        Section(
            title=title,
            table=Table(columns=heads, rows=tuple(row[:-1] for row in rows)),
            lines=(*lines, f"Newton decrement {c.certificate:.1e}"),
            short=Section(title=title, lines=lines),
        ),
        Section(
            title="Physically consistent base parameters",
            table=Table(
                columns=heads + columns(numbers=("change, half-widths",)), rows=tuple(of_base)
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
        "4 % of the peak speed (1 % with square-root, load-dependent or Stribeck friction), or 4 "
        "sd "
        "of its noise,"
        if percent is None
        else f"{percent:g} % of the peak speed"
    )
    line = f"{fit.rows} of {fit.recorded_rows} rows" if fit.recorded_rows else f"{fit.rows} rows"
    if percent == 0:
        return line
    if fit.ramp_rows == ROWS:
        return f"{line}, those slower than {slow} left out"
    return f"{line}; samples slower than {slow} have zero weight; taper {fit.ramp_rows:g} rows"


def _iv_sections(fit: FitFile) -> list[Section]:
    """Make the sections of the iterations, and of the errors of the direct model."""
    direct = tuple(
        (d.name, Number(d.position_error_percent, ".2f"), Number(d.torque_error_percent, ".2f"))
        for d in fit.direct_model or ()
    )
    sections = {
        f"Iterations from start: {fit.start}": Table(
            columns=columns(numbers=("iteration",))
            + columns("instruments", numbers=("residual norm", "largest change, standard errors"))
            + columns("of", numbers=("tracking %", "gain factor min", "max", "cond ZᵀW")),
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
        sections["Simulated robot against the recording, %"] = Table(
            columns=columns("joint", numbers=("position", "torque")), rows=direct
        )
    return [Section(title=title, table=table, short=HIDDEN) for title, table in sections.items()]


def _iv_lines(fit: FitFile) -> tuple[str, ...]:
    """Return lines on the tests of the instruments, and why an iteration could not be simulated."""
    tests = fit.instrument_tests or {}
    return (
        *(
            f"iteration {k}: instruments {p.instruments}: {p.reason}"
            for k, p in enumerate(fit.iterations or (), 1)
            if p.reason
        ),
        f"instruments: smallest correlation with W {_number(tests.get('strength'), '.3f')}, "
        f"first-stage F {_number(tests.get('first_stage_F'), '.3g')}",
        f"Durbin–Wu–Hausman contrast: least squares differs by "
        f"{_number(fit.contrast_half_widths, '.2g')} half-widths, at "
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
    return [Section(title="Regrouped parameters", lines=lines, short=HIDDEN)] if lines else []
