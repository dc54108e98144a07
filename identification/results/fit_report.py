"""The report of a fit: verdict, parameters, errors, settings and tests."""

import math
from collections.abc import Mapping

import numpy as np
from msgspec import UNSET, UnsetType

from acquisition.errors import Location

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
CORRECTED = "The description was corrected. Check its joints before motion:"
HIDDEN = Section()  # the `short` of what only `--all` prints
PARAMETERS = "Parameters"  # title of the section of all values
METHODS = {
    "ols": "ordinary least squares (OLS)",
    "wls": "least squares weighted by joint (WLS)",
    "iv": "instrumental variables (IV)",
}
ENDINGS = {
    "converged": ", converged after {count}",
    "not_confirmed": ", converged after {count}, but not confirmed by a simulation",
    "max_iterations": ", not converged after {count}",
    "diverged": ", diverged after {count}",
}
BY_REFERENCE = " with instruments from the reference"


def fit_document(fit: FitFile) -> Document:
    """Make the report of a fit's file, the verdict first.

    Raises
    ------
    BadInputError : the file has known parameters.
    """
    provenance = Location("the fit").given(
        fit.provenance, text="contains known parameters, but no fit of a recording"
    )
    return Document(
        title=f"{provenance.robot}: {_method_line(fit)}",
        badge=f"{fit.verdict} · {_counted(fit)}" if fit.verdict else "",
        figures=shared.main_figures(fit),
        sections=(
            *([Section(title=CORRECTED, lines=tuple(fit.corrected))] if fit.corrected else []),
            _verdict_section(fit),
            _summary_section(fit),
            *shared.gain_sections(fit),
            *shared.payload_sections(fit),
            _parameters(fit),
            *_consistent(fit),
            *(_iv_sections(fit) if fit.iterations else ()),
            shared.errors_section(fit.errors),
            *([shared.recordings_section(fit)] if fit.recordings else []),
            Section(
                title="Settings",
                lines=(
                    *(() if fit.recordings else shared.settings_lines(fit, used="fitted")),
                    f"Condition number of W: {_number(fit.condition_number, '.4f')}, with columns "
                    f"of norm one {_number(fit.condition_number_scaled, '.4f')}. "
                    f"{_rows_line(fit)}.",
                    *(_iv_lines(fit) if fit.iterations else ()),
                    *(() if fit.recordings else shared.recording_lines(fit)),
                ),
                short=HIDDEN,
            ),
            *_expressions(fit),
        ),
    )


def _method_line(fit: FitFile) -> str:
    """Return the method and how it ended."""
    count, why = len(fit.iterations or ()), fit.method_reason or ""
    # the status alone has no reason where instruments are those of a simulated robot
    return (
        METHODS.get(fit.method or "", "")
        + BY_REFERENCE * (fit.status == "converged" and bool(fit.reason))
        # Drive gains need instruments, whatever the recordings have.
        + f", because there is {why}" * (why.startswith("no ") and fit.method != "iv")
        + ENDINGS.get(fit.status or "", "").format(count=f"{count} iteration{'s' * (count != 1)}")
    )


def _counted(fit: FitFile) -> str:
    """Return how many tests passed, or found a problem."""
    levels = [line.level for line in fit.trust or ()]
    bad, passed, every = sum(map(levels.count, LEVELS[:2])), levels.count("ok"), len(levels)
    if bad:
        return f"{bad} of {every} tests found a problem"
    return f"All {every} tests passed" if passed == every else f"{passed} of {every} tests passed"


def _verdict_section(fit: FitFile) -> Section:
    """Make the section of all tests, worst first; the short form has those with a finding."""
    tests = fit.trust or []
    title = f"Verdict: {fit.verdict}. {_counted(fit)}." * bool(tests)
    return Section(
        title=title,
        lines=tuple(
            _finding(line, f"{'passed' if line.level == 'ok' else line.level}: ") for line in tests
        ),
        warnings=tuple(fit.warnings),
        short=Section(
            title=title,
            lines=(
                *(_finding(line) for line in tests if line.level in LEVELS[:2]),
                *(
                    (level, ", ".join(line.test for line in tests if line.level == level))
                    for level in LEVELS[2:4]
                    if level in [line.level for line in tests]
                ),
            ),
            warnings=tuple(fit.warnings[:MAX_SHORT_WARNINGS]),
        ),
    )


def _finding(line: TrustResult, level: str = "") -> tuple[str, ...]:
    return line.test, f"{level}{line.text}", *([f"→ {line.advice}"] if line.advice else [])


def _summary_section(fit: FitFile) -> Section:
    """Make the section of the main figures, and of what qualifies them."""
    held, percents = known(fit.held_out_error_percent), shared.half_width_percents(fit.parameters)
    fitted, by_prior = fit.fitted_error_percent, known(fit.prior_held_out_error_percent)
    by_ls = shared.percent(known(fit.least_squares_error_percent))
    assumed = ", ".join(one.what for one in fit.assumed or ())
    texts = {
        "Torque error": shared.error_text(fit.errors),
        "Cross-validation": ""
        if held is None
        else f"{shared.percent(held)} held out"
        + ("" if fitted is None else f", {shared.percent(fitted)} fitted, over the same rows")
        + ("" if by_prior is None else f"; a priori links {shared.percent(by_prior)}"),
        "Parameters": _determined(percents, fit.size),
        "Assumed": f"{assumed} (no test confirms them)" if assumed else "",
        "Status": fit.reason or "",
        "Least squares": f"{by_ls} torque error (wls)" if fit.status in NO_FIXED_POINT else "",
    }
    lines = (
        *((label, text) for label, text in texts.items() if text),
        *(("Note", text) for text in fit.notes),
    )
    return Section(
        lines=(
            *lines,
            shared.rows_line(fit.errors, fit.error_cutoff_hz),
            _essential_line(fit),
        ),
        short=Section(
            lines=lines,
            hint=f"all {len(fit.warnings)} warnings" * (len(fit.warnings) > MAX_SHORT_WARNINGS),
        ),
    )


def _determined(percents: Mapping[str, float], of: int) -> str:
    """Return how many parameters are well determined, and how closely."""
    worst = max(percents, key=percents.__getitem__, default="")
    return f"{len(percents)} of {of} well determined" + (
        f"; 95 % half-width: median {np.median([*percents.values()]):.2g} %, largest "
        f"{percents[worst]:.2g} % ({worst})"
        if percents
        else ""
    )


def _essential_line(fit: FitFile) -> str:
    if not fit.essential:  # a file of an earlier version
        return f"{fit.size} parameters."
    count, unclear, F = len(fit.essential.names), len(fit.unclear), fit.essential.F
    return (
        f"{count} of {fit.size} parameters are well determined"
        + (" (by least squares)" if fit.iterations else "")
        + (f", {unclear} unclear (interval wider than the value)" if unclear else "")
        + (
            f", {fit.size - count - unclear} without effect on the torque: F test "
            f"p = {fit.essential.p_value:.2g} (corrected for correlation "
            f"p = {fit.essential.p_effective:.2g})"
            if F is not None and math.isfinite(F)
            else ""
        )
        + "."
    )


def _parameters(fit: FitFile) -> Section:
    """Make the section of all parameters, masses and inertias before friction."""
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
            p.unit,
            *(["" if p.prior is UNSET else Number(p.prior, form)] if prior else []),
            Number(p.sigma, form),
            "yes" if p.essential else "",
        )
        for p in ordered
        for form in [value_form(p.sigma)]
    ]
    heads = columns("parameter", "meaning", numbers=("value", "95 % half-width", "relative %"))
    heads += columns("unit")
    essential = [k for k, p in enumerate(ordered) if p.essential]
    essential.sort(key=lambda k: -ordered[k].torque)
    places = sorted(essential[:MAX_SHORT_PARAMETERS])
    most = " that contribute most to the torque" * (len(places) < len(essential))
    return Section(
        title=PARAMETERS,
        table=Table(
            columns=heads
            + columns(numbers=(*["a priori"] * prior, "classical standard error"))
            + columns("essential"),
            rows=tuple(rows),
        ),
        lines=(
            "The classical standard error assumes a white residual. The 95 % interval does not.",
        ),
        short=Section(
            title=f"The {len(places)} well-determined parameters{most}"
            if len(places) < len(rows)
            else PARAMETERS,
            hint=f"all {len(rows)}" * (len(places) < len(rows)),
            table=Table(columns=heads, rows=tuple(rows[k][: len(heads)] for k in places)),
        ),
    )


def _consistent(fit: FitFile) -> list[Section]:
    """Make the section of physically consistent parameters and their changes from the estimate."""
    if not (c := fit.consistent):
        return []
    standard, line = fit.standard_parameters or [], fit.line_of.get("physically consistent")
    own = ". The test `physically consistent` has a prior of its own."
    heads = columns("parameter", numbers=("value", "95 % half-width"))
    heads += columns("unit", "mostly from")
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
        "All pseudo-inertias and rotor inertias are positive, and friction adds no energy. A "
        f"priori values are from {c.prior}"
        + ("." if line is not None and line.value == c.chi2 else own),
        f"chi² increases by {c.chi2:.3g} over {len(moves)} parameters. Largest change: "
        f"{c.moved_most} by {c.largest_move:.2g} half-widths of its 95 % interval.",
        *([f"Changed by more than one half-width: {', '.join(left)}."] if left else []),
        f"The torque error changes from {shared.percent(fit.moving_relative_error_percent)} to "
        f"{shared.percent(c.relative_error_percent)}.",
        f"{sum(p.from_prior for p in standard)} of {len(rows)} values are a priori values, because "
        "the torques do not depend on them.",
    )
    title = "Physically consistent standard parameters"
    return [
        Section(
            title=title,
            table=Table(columns=heads, rows=tuple(row[:-1] for row in rows)),
            lines=(*lines, f"Newton decrement: {c.certificate:.1e}."),
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


def _number(value: float | UnsetType | None, form: str) -> str:
    return Number(known(value), form).text


def _rows_line(fit: FitFile) -> str:
    """Return a line on the number of rows by their weights, and on what has zero weight."""
    percent = (fit.low_speed_percent or {}).get("iv" if fit.method == "iv" else "ls")
    slow = (
        "4 % of the peak speed (1 % with square-root, load-dependent or Stribeck friction), or "
        "than 4 standard deviations of its noise,"
        if percent is None
        else f"{percent:g} % of the peak speed"
    )
    line = f"{fit.rows} of {fit.recorded_rows} rows" if fit.recorded_rows else f"{fit.rows} rows"
    if percent == 0:
        return line
    return line + (
        f"; rows slower than {slow} are left out"
        if fit.ramp_rows == ROWS
        else f"; samples slower than {slow} have zero weight, taper {fit.ramp_rows:g} rows"
    )


def _iv_sections(fit: FitFile) -> list[Section]:
    """Make the sections of the iterations, and of the errors of the direct model."""
    sections = {
        f"Iterations from start: {fit.start}": Table(
            columns=columns(numbers=("iteration",))
            + columns("instruments", numbers=("residual norm", "largest change, standard errors"))
            + columns("parameter", numbers=("tracking error, %",))
            + columns(numbers=("controller gain factor, min", "max", "cond(ZᵀW)")),
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
        ),
        "Difference between simulated robot and recording": Table(
            columns=columns("joint", numbers=("position, %", "torque, %")),
            rows=tuple(
                (
                    d.name,
                    Number(d.position_error_percent, ".2f"),
                    Number(d.torque_error_percent, ".2f"),
                )
                for d in fit.direct_model or ()
            ),
        ),
    }
    return [
        Section(title=title, table=table, short=HIDDEN)
        for title, table in sections.items()
        if table.rows
    ]


def _iv_lines(fit: FitFile) -> tuple[str, ...]:
    """Return lines on the tests of the instruments, and why an iteration could not be simulated."""
    tests = fit.instrument_tests or {}
    return (
        *(
            f"Iteration {k} has {p.instruments} instruments: {p.reason}."
            for k, p in enumerate(fit.iterations or (), 1)
            if p.reason
        ),
        f"Instruments: smallest correlation with W {_number(tests.get('strength'), '.3f')}, "
        f"first-stage F = {_number(tests.get('first_stage_F'), '.3g')}.",
        "Durbin–Wu–Hausman contrast: least squares differs by up to "
        f"{_number(fit.contrast_half_widths, '.2g')} half-widths ({fit.contrast_parameter}).",
        f"{_number(fit.rows_used_percent, '.1f')} % of the rows are used. Reference: "
        f"{fit.reference}; controller: {fit.controller}.",
    )


def _expressions(fit: FitFile) -> list[Section]:
    """Make the section of regrouped parameters as sums of standard parameters."""
    lines = tuple(
        f"{p.name} = {p.expression}"
        for p in fit.parameters
        if p.expression not in (None, base_name(p.name)) and base_name(p.name) == p.name
    )
    return [Section(title="Regrouped parameters", lines=lines, short=HIDDEN)] if lines else []
