"""Real recordings against published digits and an earlier identification of the same robot."""

import re

import pytest
from conftest import REPLAY
from fits_of_records import ls_of, signals_of
from published import PAGE, available, page, without_seconds

from acquisition.robot import load_robot
from identification.data import load_signals
from identification.methods import identify_ls
from identification.regression import Overrides


def digits(values, places=4):
    return [f"{value:.{places}f}" for value in values]


def published(emps, name="robot_published.toml"):
    return load_signals(emps, load_robot(REPLAY / "emps" / name))


def test_emps_gives_every_printed_digit(emps):
    fit = identify_ls(published(emps), Overrides())
    assert digits(fit.estimate.beta) == ["95.1089", "203.5034", "20.3935", "-3.1648"]
    assert digits(fit.estimate.sigma) == ["0.1085", "1.1460", "0.1012", "0.0444"]
    assert f"{fit.errors[-1].relative_error_percent:.4f}" == "4.0834"
    assert f"{fit.estimate.condition_number:.4f}" == "25.9883"


def test_emps_with_friction_by_direction_gives_every_printed_digit(emps):
    fit = identify_ls(published(emps, "robot_published_asymmetric.toml"), Overrides())
    assert digits(fit.estimate.beta) == ["95.1540", "166.7061", "20.1440", "240.4236", "20.6277"]
    assert f"{fit.errors[-1].relative_error_percent:.4f}" == "3.1117"


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
    signals = signals_of(tx40)
    fit, default = identify_ls(signals, Overrides(low_speed_percent=0.0)), ls_of(tx40)
    whole, fast = fit.errors[-1], default.errors[-1]
    # Nothing fits these rows better than a fit that has them all: samples that stand without a weight cost little.
    assert fast.moving_relative_error_percent < 1.04 * whole.moving_relative_error_percent
    assert fast.relative_error_percent == pytest.approx(6.28, abs=0.05)
    value = dict(zip(fit.estimate.names, fit.estimate.beta, strict=True))
    sigma = dict(zip(fit.estimate.names, fit.estimate.sigma, strict=True))
    assert len(value) == 60
    assert fit.settings.span == "the span between first and last motion"
    assert fit.errors[-1].relative_error_percent <= 5.6
    assert value["ZZ1R"] == pytest.approx(1.24, abs=0.03)
    for name, earlier in EARLIER.items():
        assert abs(value[name] - earlier) <= max(3 * sigma[name], 0.06 * earlier), name
    assert 26 <= len(fit.essential.kept) <= 28
    assert fit.essential.p_effective > 0.01


def test_tx40_with_the_standstill_fits_less_well(tx40):
    fit = identify_ls(signals_of(tx40), Overrides(span="all", low_speed_percent=0.0))
    assert 5.6 < fit.errors[-1].relative_error_percent <= 7.8
    assert fit.errors[-1].moving_relative_error_percent < fit.errors[-1].standing_relative_error_percent


@pytest.mark.skipif(not available(), reason="the real recordings are not here (see replay_data/README.md)")
def test_the_page_of_published_digits_is_that_of_the_code():
    assert without_seconds(PAGE.read_text()) == without_seconds(page()), "run `python tests/published.py`"


def test_the_page_of_published_digits_has_value_value_and_command():
    rows = [line.strip("| ").split(" | ") for line in PAGE.read_text().splitlines() if line.startswith("| ")][1:]
    assert len(rows) > 20
    assert all(len(row) == 4 and row[3].startswith("`robot-identify ") for row in rows)
    assert {re.split("[,:]", row[0])[0] for row in rows} == {"EMPS", "TX40", "SCARA"}
