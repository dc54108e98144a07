"""Real recordings against published digits and an earlier identification of the same robot."""

import re

import pytest
from fits_of_records import ls_of, signals_of
from published import PAGE, page, without_seconds

from identification.methods import identify_ls
from identification.regression import Overrides

# The earlier identification of this arm, in the source's configuration (figaroh-examples, examples/staubli_TX40).
EARLIER = {
    **{f"Fv{j}": v for j, v in enumerate([8.05, 5.53, 1.97, 1.11, 1.86, 0.65], 1)},
    **{f"Fc{j}": v for j, v in enumerate([7.14, 8.26, 6.34, 2.48, 3.03, 0.282], 1)},
    **{f"Ia{j}": v for j, v in enumerate([0.0988, 0.0313, 0.0468, 0.0105], 3)},
    "Fvm6": 0.616,
    "Fcm6": 1.95,
}


def test_tx40_agrees_with_the_earlier_identification(tx40):
    """All rows, as in that identification. Those at low speed are what its error is mostly made of."""
    fit, default = identify_ls(signals_of(tx40), Overrides(low_speed_percent=0.0)), ls_of(tx40)
    whole, fast = fit.errors[-1], default.errors[-1]
    # Nothing fits these rows better than a fit that has them all: samples that stand without a weight cost little.
    assert fast.moving_relative_error_percent < 1.04 * whole.moving_relative_error_percent
    assert fast.relative_error_percent == pytest.approx(6.28, abs=0.05)
    assert whole.relative_error_percent <= 5.6
    estimate = fit.estimate
    found = {name: (x, s) for name, x, s in zip(estimate.names, estimate.beta, estimate.sigma, strict=True)}
    assert len(found) == 60
    assert found["ZZ1R"][0] == pytest.approx(1.24, abs=0.03)
    for name, earlier in EARLIER.items():
        assert abs(found[name][0] - earlier) <= max(3 * found[name][1], 0.06 * earlier), name
    assert 26 <= len(fit.essential.kept) <= 28
    assert fit.essential.p_effective > 0.01


def test_the_page_of_published_digits_is_that_of_the_code(emps, tx40):
    assert without_seconds(PAGE.read_text()) == without_seconds(page(emps, tx40)), "run `python tests/published.py`"


def test_the_page_has_every_printed_digit_of_the_emps():
    """Value, value and command; 5 rows of least squares, cond(W), and friction by direction with its error."""
    rows = [line.strip("| ").split(" | ") for line in PAGE.read_text().splitlines() if line.startswith("| ")][1:]
    assert all(len(row) == 4 and row[3].startswith("`robot-identify ") for row in rows)
    equal = [row for row in rows if re.match("EMPS, (least squares|asymmetric friction)", row[0])]
    assert len(equal) == 8
    assert [row[1] for row in equal] == [row[2] for row in equal]
