"""What a study counts: verdicts against the truth, coverage of intervals, spread, bias."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import robot_named

from identification.control import law_of
from identification.study import (
    FALSE_TRUST,
    Noise,
    Run,
    RunFit,
    Study,
    false_trust,
    one_run,
    study_document,
    summaries,
)

TRUE = np.array([1.0, 2.0])


def fit_of_run(off: tuple[float, float], verdict: str = "trust", **others: object) -> RunFit:
    middle = TRUE + 0.1 * np.array(off)
    known = {"essential": np.array([True, False]), "positive": True}
    known |= {"beta": TRUE, "error": 0.1, "low": middle - 0.1, "high": middle + 0.1, **others}
    return RunFit(verdict=verdict, **known)


def run(iv: RunFit, status: str = "converged") -> Run:
    return Run(number=7, status=status, iv=iv)


@pytest.mark.parametrize(
    ("one", "wrong"),
    [
        (fit_of_run((FALSE_TRUST - 0.1, 9.0)), False),  # the second is not essential
        (fit_of_run((FALSE_TRUST + 0.1, 0.0)), True),
        (fit_of_run((-FALSE_TRUST - 0.1, 0.0)), True),
        (fit_of_run((FALSE_TRUST + 0.1, 0.0), verdict="caution"), False),
        (fit_of_run((FALSE_TRUST + 0.1, 0.0), verdict="do not use"), False),
        (fit_of_run((0.0, 0.0), positive=False), True),
        (fit_of_run((0.0, 0.0), positive=False, verdict="caution"), False),
    ],
)
def test_false_trust_is_large_error_or_inconsistent(one, wrong):
    assert false_trust(one, TRUE) == wrong
    runs = [run(one), run(fit_of_run((0.0, 0.0), beta=1.1 * TRUE))]
    iv = summaries(runs, TRUE)[1]
    assert (iv.runs, iv.false_trust) == (2, int(wrong))
    assert iv.trusted == 1 + (one.verdict == "trust")
    told = study_document("x", Study(runs=2), runs, TRUE).sections[0].lines[1]
    assert told.endswith("iv in run 7" if wrong else "no run")


def test_coverage_spread_bias_match_intervals():
    offs = {-1: (0.5, -0.9), 0: (1.1, 0.0), 1: (0.0, -2.0)}
    runs = [
        run(fit_of_run(off, beta=1.01 * TRUE + k * np.array([0.1, 0.2]))) for k, off in offs.items()
    ]
    ls, iv = summaries([*runs, run(fit_of_run((9.0, 9.0), beta=9 * TRUE), "diverged")], TRUE)
    assert (ls.runs, iv.runs) == (0, 3), "of iv, those that converged"
    assert np.isnan(ls.bias_percent)
    assert iv.coverage_percent == pytest.approx(100 * 4 / 6)
    assert iv.spread_over_interval == pytest.approx(np.median([1.96 * 0.1 / 0.1, 1.96 * 0.2 / 0.1]))
    assert iv.bias_percent == pytest.approx(1.0)


def test_run_has_intervals_and_verdicts_of_fits(monkeypatch):
    study, laws = Study(noise=Noise(effort_percent=1.0), duration_s=4.0), []
    monkeypatch.setattr(
        "identification.methods.model.law_of",
        lambda problem: laws.append(law_of(problem)) or laws[-1],
    )
    files = robot_named("scara").files
    found, again, other = (one_run(files, study, number) for number in (1, 1, 2))
    # once per run, for both of its fits
    assert (len(laws), len({law.gains.tobytes() for law in laws})) == (3, 2)
    for one in (found.ls, found.iv):
        np.testing.assert_allclose(0.5 * (one.low + one.high), one.beta)
        assert (one.high > one.low).all()
        assert (one.positive, one.essential.any(), one.error < 0.05) == (True, True, True)
        assert one.verdict in ("trust", "caution", "do not use")
    assert found.ls.beta.tolist() == again.ls.beta.tolist()
    assert not np.isin(found.ls.beta, other.ls.beta).any()
    assert not np.isin(found.ls.beta, one_run(files, replace(study, seed=1), 1).ls.beta).any()
