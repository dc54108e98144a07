"""What the reports of a fit and of a validation say: the verdict first, by the rows that move,
then what is essential.
"""

import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from conftest import REPLAY
from fits_of_records import iv_of, ls_of, signals_of

from identification.estimation import essential_names
from identification.report import Section
from identification.results import (
    fit_document,
    fit_file,
    recording_document,
    validation_document,
)

SCARA = REPLAY / "scara" / "session.mcap"


def with_essential(fit, names, **figures):
    essential = msgspec.structs.replace(fit.essential, names=names, **figures)
    solution = replace(fit.solution, essential=essential)
    narrow = essential_names(essential, fit.estimate, fit.intervals)
    data = replace(fit.data, essential=narrow)
    return replace(fit, solution=solution, data=data, warnings=("a wrong gain",))


def rows_of(table):
    heads = [heading for heading, _ in table.columns]
    return {row[0]: dict(zip(heads, row, strict=True)) for row in table.rows}


def test_the_verdict_comes_first_with_one_error():
    fit = with_essential(iv_of(SCARA), ("ZZ1R", "ZZ2"))
    document = fit_document(fit_file(fit))
    error = fit.errors[-1].relative_error_percent
    held, names = fit.trust.line("cross-validation").value, fit.estimate.names
    a, b = (
        100 * fit.intervals.half[k] / abs(fit.beta[k]) for k in map(names.index, ("ZZ1R", "ZZ2"))
    )
    assert a < b
    assert document.title == "SCARA: instrumental variables (IV), converged after 2 iterations"
    verdict, summary, *_ = document.short.sections
    assert document.badge == "trust · All 13 tests passed"
    assert (verdict.title, verdict.lines) == ("Verdict: trust. All 13 tests passed.", ())
    assert verdict.warnings == ("a wrong gain",)
    rest = fit.errors[-1].standing_relative_error_percent
    assert summary.lines == (
        (
            "Torque error",
            f"{error:.3g} % in motion, {rest:.3g} % at standstill (static friction is not "
            "modelled)",
        ),
        ("Cross-validation", f"{held:.3g} % held out, {error:.3g} % fitted, over the same rows"),
        (
            "Parameters",
            f"2 of 8 well determined; 95 % half-width: median {(a + b) / 2:.2g} %, largest "
            f"{b:.2g} % (ZZ2)",
        ),
        (
            "Assumed",
            "drive gains, efforts, gear ratios, link lengths, sample rate, joint zeros, rotor "
            "inertias (no test confirms them)",
        ),
    )
    assert "221 of 284 rows are in motion. Torque errors have a low-pass of 11.8 Hz." in (
        document.sections[1].lines
    )


@pytest.mark.parametrize("wide", [(), ("Fv1", "Fc2"), None])
@pytest.mark.parametrize("kept", [("ZZ1R", "Fv1", "Fc2", "ZZ2"), None])
def test_outputs_count_same_parameters(kept, wide):
    """Of the `kept` by the F test those with an interval narrower than the value; of `wide`,
    None for all, it is wider.
    """
    fit = iv_of(SCARA)
    names = fit.estimate.names
    kept, wide = names if kept is None else kept, names if wide is None else wide
    by = np.where(np.isin(names, wide), 1.5 * np.abs(fit.beta), fit.intervals.half)
    intervals = replace(fit.intervals, low=fit.beta - by, high=fit.beta + by)
    fit = replace(fit, data=replace(fit.data, intervals=intervals))
    fit = with_essential(fit, kept, F=1.0)
    expected = {name for name in kept if name not in wide}
    document, file = fit_document(fit_file(fit)), fit_file(fit)
    marked = rows_of(document.sections[2].table)
    assert {name for name, row in marked.items() if row["essential"] == "yes"} == expected
    flagged = [p for p in file.parameters if p.essential]
    assert {p.name for p in flagged} == set(file.essential.names) == expected
    percents = {p.name: 100 * p.half / abs(p.value) for p in flagged}
    text = f"{len(expected)} of 8 well determined"
    if percents:
        worst = max(percents, key=percents.get)
        median = np.median(list(percents.values()))
        text += (
            f"; 95 % half-width: median {median:.2g} %, largest {percents[worst]:.2g} % ({worst})"
        )
    assert ("Parameters", text) in document.sections[1].lines
    line = document.sections[1].lines[-1]
    counts = [re.search(rf"(\d+) {what}", line) for what in ("of", "unclear", "without effect")]
    assert sum(int(found[1]) for found in counts if found) == 8, line


@pytest.mark.parametrize("everything", [False, True])
def test_table_has_essential_parameters_or_all(everything):
    essential = ("ZZ1R", "Fc2")
    fit = with_essential(ls_of(SCARA), essential)
    document = fit_document(fit_file(fit))
    document = document if everything else document.short
    section = document.sections[2]
    rows = rows_of(section.table)
    ordered = sorted(fit.estimate.names, key=lambda name: name[0] == "F")  # friction last
    assert tuple(rows) == (tuple(ordered) if everything else essential)
    for name, row in rows.items():
        k = fit.estimate.names.index(name)
        half = fit.intervals.half[k]
        assert (row["value"].value, row["95 % half-width"].value) == (fit.beta[k], half)
        assert row["relative %"].value == pytest.approx(100 * half / abs(fit.beta[k]))
        if everything:
            assert row["classical standard error"].value == fit.estimate.sigma[k]
            assert row["essential"] == ("yes" if name in essential else "")
        else:
            assert not {"classical standard error", "essential"} & {*row}
    assert section.hint == ("" if everything else "all 8")
    assert rows["Fc2"]["meaning"] == "Coulomb friction of elbow"
    assert rows["ZZ1R"]["meaning"] == "moment of inertia zz of link 1 (regrouped)"
    assert ("ZZ1R = ZZ1 + 0.25 M2" in document.sections[-1].lines) == everything


def test_short_report_has_ten_largest_and_findings():
    fit = ls_of(SCARA)
    finding, *others = fit.trust.lines
    lines = (
        msgspec.structs.replace(finding, level="caution"),
        msgspec.structs.replace(others[0], level="skipped"),
        *others[1:],
    )
    fit = replace(
        fit, trust=replace(fit.trust, lines=lines), warnings=tuple(f"warning {k}" for k in range(6))
    )
    verdict, summary, parameters, errors, *rest = fit_document(fit_file(fit)).short.sections
    assert verdict.warnings == fit.warnings[:4]
    assert summary.hint == "all 6 warnings"
    assert "Status" not in dict(summary.lines), "the title has it"
    assert verdict.title == f"Verdict: caution. 1 of {len(lines)} tests found a problem."
    levels = {line.test: line.level for line in lines}
    assert verdict.lines == (
        (finding.test, finding.text, *([f"→ {finding.advice}"] if finding.advice else [])),
        *(
            (level, ", ".join(test for test, of in levels.items() if of == level))
            for level in ("inconclusive", "skipped")
            if level in levels.values()
        ),
    )
    torque = dict(zip(fit.estimate.names, np.abs(fit.data.W * fit.beta).max(axis=0), strict=True))
    essential = {name: torque[name] for name in fit.essential_names}
    assert {row[0] for row in parameters.table.rows} == set(
        sorted(essential, key=lambda x: -essential[x])[:10]
    )
    assert errors.lines[0].startswith("Torque error in motion by joint: shoulder ")
    assert rest == [Section()] * len(rest), "all else needs --all"


def test_validation_and_recording_name_themselves():
    signals, fit = signals_of(SCARA), ls_of(SCARA)
    document = validation_document(fit.recordings, "fit.json", fit.errors, ("another robot",))
    assert document.title.startswith("fit.json on session.mcap: ")
    assert document.sections[0].warnings == ("another robot",)
    assert [row[0] for row in document.sections[1].table.rows] == ["shoulder", "elbow", "all"]
    recorded = recording_document(signals, None, "no joint moves")
    assert recorded.sections[0].lines[0] == "This recording cannot be fitted: no joint moves"
    low, high = (recorded.sections[1].table.rows[1][k].value for k in (2, 3))
    assert (low, high) == (signals.q[:, 1].min(), signals.q[:, 1].max())
