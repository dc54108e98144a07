"""Real recordings against published digits and an earlier identification of the same robot."""

import re

import pytest
from fits_of_records import ls_of, signals_of
from published import EARLIER, PAGE, error, page, without_seconds

from identification.regression import Overrides
from identification.results import identify_ls


def test_tx40_agrees_with_earlier_identification(tx40):
    """All rows, as in that identification.

    Those at low speed are what its error is mostly made of.
    """
    fit = identify_ls(signals_of(tx40), Overrides(low_speed_percent=0.0))
    assert error(fit) <= 5.6
    assert error(ls_of(tx40)) == pytest.approx(6.28, abs=0.05)
    estimate = fit.estimate
    found = {
        name: (x, s)
        for name, x, s in zip(estimate.names, estimate.beta, estimate.sigma, strict=True)
    }
    assert len(found) == 60
    for name, earlier in EARLIER.items():
        assert abs(found[name][0] - earlier) <= max(3 * found[name][1], 0.06 * earlier), name
    assert 26 <= len(fit.essential.names) <= 28
    assert fit.essential.p_effective > 0.01


def test_published_page_matches_code(emps, tx40):
    assert without_seconds(PAGE.read_text()) == without_seconds(page(emps, tx40)), (
        "run `python tests/published.py`"
    )


def test_page_has_every_digit_of_emps():
    """Value, value and command; 5 rows of least squares, cond(W), and friction by
    direction with its error.
    """
    rows = [
        line.strip("| ").split(" | ")
        for line in PAGE.read_text().splitlines()
        if line.startswith("| ")
    ][1:]
    assert all(len(row) == 4 and row[3].startswith("`robot-identify ") for row in rows)
    equal = [row for row in rows if re.match("EMPS, (least squares|asymmetric friction)", row[0])]
    assert len(equal) == 8
    assert [row[1] for row in equal] == [row[2] for row in equal]
