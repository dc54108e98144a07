"""How far settings, noise of the position and the start move least squares and
instrumental variables.
"""

from dataclasses import replace

import numpy as np
import pytest
from conftest import REPLAY, ROOT
from fits_of_records import short_recording

from identification.commands import main
from identification.data import RecordingFile, Work
from identification.errors import NoFitError
from identification.report import print_whole
from identification.study import (
    Variant,
    VariedFit,
    changes_of,
    fit_variant,
    sensitivity_document,
    vary,
)
from identification.view.charts import noise_chart

SCARA = REPLAY / "scara" / "session.mcap"


class Tasks:
    def __init__(self, values):
        self.variants, self.values = [], values

    def run(self, function, tasks):
        assert function is fit_variant
        self.variants = [variant for _, variant in tasks]
        return (
            VariedFit(variant=variant, ended="converged", values=self.values)
            for variant in self.variants
        )


def test_real_noise_moves_ls_not_iv(emps, capsys):
    fits = vary(RecordingFile.at(emps), None, Work())
    largest = np.max([changes_of(fits, name) for name in fits[0].values], axis=0)
    moves = dict(zip((fit.variant.to for fit in fits), largest, strict=True))
    ls, iv, *_ = moves["1e-05 m rms"]
    assert (ls > 5, iv < 1) == (True, True)
    of_starts = [moves[start][1] for start in ("0.001", "1000")]
    assert (0 < max(of_starts) < 1e-4, np.ptp(of_starts) < 1e-9) == (True, True)
    assert {fit.ended for fit in fits} == {"converged"}
    print_whole(sensitivity_document("emps.mcap", fits), short=True)
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    page = (ROOT / "identification" / "docs" / "howto" / "excitation.md").read_text()
    block = page.split("\n    emps.mcap:")[1].split("\n\n")[0]
    shown = [line.split() for line in f"emps.mcap:{block}".splitlines()]
    assert len(shown) == 6
    assert [line for line in shown if line not in printed] == [], "the page shows the real record"


def test_each_variant_changes_one_thing():
    work = Tasks({"M1": (1.0, 0.1, 1.0, 0.1)})
    vary(RecordingFile.at(SCARA), (1e-6, 2e-6), work)
    rules, *variants = work.variants
    assert rules == Variant(changed="none", to="default settings")
    cutoffs = [v.overrides.cutoff_hz for v in variants if v.changed == "cut-off"]
    assert cutoffs == [12.5, 50.0, 0.0], "of a bandwidth of 5 Hz"
    assert [v.overrides.decimation for v in variants if v.changed == "decimation"] == [20, 80], (
        "of 40"
    )
    assert [v.noise for v in variants if v.changed == "position noise"] == [1e-6, 2e-6]
    assert [v.start for v in variants if v.changed == "start"] == [0.001, 1000.0]
    assert variants[5].to == "1e-06 rad rms"
    for variant in variants:
        changed = [
            getattr(variant, x) != getattr(rules, x)
            for x in ("overrides", "noise", "start", "gain_update")
        ]
        assert sum(changed) == 1


def test_noise_and_settings_reach_fit(tmp_path):
    rules, source = Variant(changed="none", to="default settings"), RecordingFile.at(SCARA)
    starts = [fit_variant(source, replace(rules, start=start)) for start in (None, 1000.0)]
    assert 0 < changes_of(starts, "ZZ1R")[1][1] < 1e-3
    source = RecordingFile.at(short_recording(tmp_path / "short.mcap", SCARA))
    one, noisy, again = (fit_variant(source, replace(rules, noise=x)) for x in (0.0, 1e-3, 1e-3))
    assert noisy == again
    assert set(one.essential) <= set(one.values)
    assert all(one.values[name][0] != noisy.values[name][0] for name in one.values)
    decimated = fit_variant(
        source, replace(rules, overrides=replace(rules.overrides, decimation=20))
    )
    assert decimated.values != one.values
    refused = fit_variant(
        source, replace(rules, overrides=replace(rules.overrides, cutoff_hz=600.0))
    )
    assert refused.values == {}
    assert "600" in refused.ended


def made_up():
    rules = VariedFit(
        variant=Variant(changed="none", to="default settings"),
        ended="converged",
        values={
            "M1": (10.0, 2.0, 10.5, 0.5),
            "Fc1": (3.0, 1.0, 3.0, 1.0),
            "Off1": (0.0, 1.0, 0.0, 1e-9),
        },
        essential=("M1", "Fc1"),
    )
    noise, cut = (
        Variant(changed="position noise", to="1e-05 m rms"),
        Variant(changed="cut-off", to="none"),
    )
    moved = {
        "M1": (14.0, 2.0, 10.25, 0.5),
        "Fc1": (3.0, 1.0, 3.75, 1.0),
        "Off1": (9.0, 1.0, 9.0, 1.0),
    }
    noisy = VariedFit(variant=noise, ended="max_iterations", passes=40, values=moved)
    return [rules, VariedFit(variant=cut, ended="too short"), noisy]


def test_changes_in_half_widths_of_default_iv():
    fits = made_up()
    np.testing.assert_array_equal(
        changes_of(fits, "M1"), [[0, 0, 0, 0], [np.nan] * 4, [8, 0.5, 2, 0.5]]
    )
    document = sensitivity_document("log.mcap", fits)
    assert document.title == (
        "log.mcap: LS changes by up to 8 half-widths with position noise 1e-05 m rms, IV by 0.75"
    )
    cut, noise = (
        [x if isinstance(x, str) else x.text for x in row]
        for row in document.sections[0].table.rows
    )
    assert noise == [
        "position noise",
        "1e-05 m rms",
        "8",
        "M1",
        "2",
        "0.75",
        "Fc1",
        "0.75",
        "40",
        "max_iterations",
    ]
    assert cut[2] == cut[4] == "-"
    assert cut[-1] == "too short"
    assert [row[0] for row in document.sections[1].table.rows] == ["M1", "Fc1", "M1", "Fc1"]
    assert document.short.sections[1].table is None


def test_mass_over_noise_plot_of_both_methods():
    known = {"units": {"M1": "kg"}, "known": ("true", {"M1": 10.25})}
    rules, _, noisy = made_up()
    strong = replace(noisy, variant=replace(noisy.variant, noise=1e-5))
    weak = replace(
        noisy,
        variant=replace(noisy.variant, noise=2e-6),
        values={**noisy.values, "M1": (11.0, 1.5, 10.4, 0.5)},
    )
    chart = noise_chart([replace(rules, **known), strong, weak])
    assert chart.title == "M1 [kg] over position noise [µm rms]"
    drawn = {
        name: [[x.tolist() for x in c.line] for c in chart.curves if c.name == name]
        for name in ("LS, 95 % interval", "IV, 95 % interval", "true")
    }
    ls, *bars = drawn["LS, 95 % interval"]
    assert ls == [pytest.approx([0.0, 2.0, 10.0]), [10.0, 11.0, 14.0]], "by the size of the noise"
    assert [y for _, y in bars] == [[8.0, 12.0], [9.5, 12.5], [12.0, 16.0]]
    assert drawn["IV, 95 % interval"][0][1] == [10.5, 10.4, 10.25]
    assert drawn["true"] == [[pytest.approx([0.0, 10.0]), [10.25, 10.25]]]
    assert "true" not in {curve.name for curve in noise_chart([rules, strong]).curves}
    assert noise_chart([rules]) is None


def test_simulated_recording_has_true_values():
    fit = fit_variant(
        RecordingFile.at(REPLAY / "emps" / "session.mcap"),
        Variant(changed="none", to="default settings"),
    )
    assert fit.known == ("true", {"M1": 95.1089, "Fv1": 203.5034, "Fc1": 20.3935, "Off1": -3.1648})
    assert fit.units["M1"] == "kg"
    assert abs(fit.values["M1"][2] - 95.1089) < fit.values["M1"][3]


def test_unfittable_recording_refused():
    with pytest.raises(NoFitError, match="converged"):
        vary(RecordingFile.at(SCARA), (1e-6,), Tasks({}))


@pytest.mark.parametrize(
    ("file", "option", "said"),
    [
        ("session.mcap", "--seed 1", "--seed requires ROBOT.toml, not a recording"),
        ("session.mcap", "--json a", "--json requires ROBOT.toml, not a recording"),
        ("session.mcap", "--position-noise 0,1", "expected numbers greater than 0 for a recording"),
        ("robot.toml", "--all", "--all requires LOG.mcap, not a description"),
        ("robot.toml", "--position-noise 1,2", "expected one value for a simulated robot"),
    ],
)
def test_options_of_other_study_refused(file, option, said, capsys):
    assert main(["study", str(SCARA.with_name(file)), *option.split()]) == 1
    err = capsys.readouterr().err
    assert (said in err, err.count("\n")) == (True, 1)
