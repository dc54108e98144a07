"""The hunt's own parts: every kind of fault can be recorded, names tests that there are, and is counted as it is defined."""

from dataclasses import replace

import numpy as np
import pytest
from hunt import Outcome, fit_by_default, is_harmed, row, true_values
from hunt_kinds import ASSUMED, CLEAN, KINDS, sound


@pytest.mark.parametrize("what", KINDS)
def test_every_kind_can_be_recorded(what):
    kind = KINDS[what]
    for name in kind.robots:
        rng = np.random.default_rng(1)
        signals = replace(kind.change(sound(name, rng), rng), duration_s=0.2).recording(1)
        assert np.isfinite(signals.effort).all()
        assert (signals.q_ref is None) == ("no reference" in what)


@pytest.fixture(scope="module")
def fit():
    """Of a sound axis."""
    return fit_by_default(replace(sound("emps", np.random.default_rng(1)), duration_s=4.0).recording(1))


def test_kinds_are_named_by_tests_that_there_are(fit):
    where_found = {"rows", "signs and order", "positions"}  # lines where there is something to say
    named = {test for kind in KINDS.values() for test, _ in kind.named} - where_found
    assert named - {"", ASSUMED} <= {line.test for line in fit.trust.lines}
    assert CLEAN.named == ()


def test_harmed_is_off_by_three_half_widths_and_two_percent(fit):
    assert list(true_values("emps")) == list(fit.estimate.names)
    true = np.array(list(true_values("emps").values()))

    def harmed(off_percent: float, half_percent: float) -> bool:
        beta, half = true * (1 + 0.01 * off_percent), np.abs(true) * 0.01 * half_percent
        intervals = replace(fit.intervals, low=beta - half, high=beta + half)
        return is_harmed(replace(fit, estimate=replace(fit.estimate, beta=beta), intervals=intervals), "emps")

    assert not harmed(1.9, 0.1)
    assert not harmed(2.9, 1.0)
    assert harmed(3.1, 1.0)
    assert harmed(2.1, 0.1)


def test_a_row_counts_refused_fits_as_not_trusted():
    trusted = Outcome(verdict="trust", named=False, harmed=True, first="")
    refused = Outcome(verdict="refused", named=True, harmed=False, first="refused")
    text = row("fault", [(trusted, refused), (trusted, refused)])
    assert text == "| fault | 0/2 · 2/2 (2 refused) | 0 · 2 | 2 · 0 | 2 · 0 | - · refused 2 |"
