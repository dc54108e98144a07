"""The robots that come along: each recording fits as it stands and gives the fit
and the truth beside it.
"""

import json
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from blueprints import has_one_parent_each
from conftest import DATA, REPLAY, ROOT
from fits_of_records import iv_of, signals_of

from identification.commands import main
from identification.data import load_signals
from identification.model import InverseModel, base_parameters, described_parameters
from identification.study import CATALOGUE, PAYLOAD, TRUE_FACTORS, simulated_cell


@pytest.mark.parametrize(("name", "count"), [("scara", 8), ("emps", 4), ("tx40", 60)])
def test_shipped_sessions_give_stored_fit_and_truth(name, count):
    folder = REPLAY / name
    signals, fit = signals_of(folder / "session.mcap"), iv_of(folder / "session.mcap")
    stored = json.loads((folder / "fit.json").read_text())["parameters"]
    true = json.loads((folder / "truth.json").read_text())["parameters"]
    assert (fit.status, len(fit.beta)) == ("converged", count)
    assert [p["name"] for p in stored] == [p["name"] for p in true] == list(fit.base.names)
    half = fit.intervals.half
    np.testing.assert_array_less(np.abs(fit.beta - [p["value"] for p in stored]), 0.025 * half)
    off = np.abs(fit.beta - [p["value"] for p in true]) / half
    assert (off < 1.5).sum() >= count - (2 if count == 60 else 0)
    # The truth is that of the description's [parameters].
    idm = InverseModel(signals.robot)
    np.testing.assert_allclose(
        [p["value"] for p in true],
        described_parameters(idm, base_parameters(idm)),
        rtol=1e-9,
        atol=1e-15,
    )


def compare_with_readme(out: str) -> None:
    """Compare the lines that the README shows of a demo with those of this one."""
    shown, against = (ROOT / "README.md").read_text(), out
    for start in ("TX40", "wls", "iv"):
        line, now = (
            next(
                line.strip() for line in text.splitlines() if line.strip().startswith(f"{start}: ")
            )
            for text in (shown, against)
        )
        line = line.removesuffix(" ...")  # for the rest of a line
        a, b = (
            [float(x) for x in re.findall(r"[0-9.]+", text.split(": ")[1])] for text in (line, now)
        )
        words, words_now = (re.sub(r"[0-9.]+", "x", text) for text in (line, now))
        assert words_now.startswith(words)
        assert a[0] == pytest.approx(b[0], abs=1)
        assert a[-1] == pytest.approx(b[-1], rel=0.05, abs=0.011)  # printed to two decimals


def test_demo_runs_from_bus_to_plot(capsys, tmp_path):
    """Six simulated drives on a bus, recorded, identified by both methods,
    compared with the truth.
    """
    assert main(["demo", "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "TX40: instrumental variables (IV), converged after " in out
    compare_with_readme(out)
    assert int(out.split("iv: ")[1].split(" of 60 true values lie inside")[0]) >= 56
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "session.mcap", "ls.json", "iv.json", "truth.json", "demo.rrd"
    }  # fmt: skip
    assert has_one_parent_each(tmp_path / "out" / "demo.rrd")
    iv, ls, true = (
        json.loads((tmp_path / "out" / f"{n}.json").read_text()) for n in ("iv", "ls", "truth")
    )
    # ls: the lag
    assert (ls["verdict"], iv["status"], iv["reference"]) == ("caution", "converged", "recorded")
    found, off, values = (
        np.array([p["value"] for p in fit["parameters"]]) for fit in (iv, ls, true)
    )
    assert np.linalg.norm(found - values) < 0.01 * np.linalg.norm(values)
    # of all rows it is 18 times
    assert np.linalg.norm(off - values) < 2.0 * np.linalg.norm(found - values)
    compare_with_shipped("tx40", tmp_path / "out" / "session.mcap")


def test_demo_finds_drive_gains(capsys, tmp_path, monkeypatch):
    """Drives whose gains differ from the catalogue's by motor; the second recording states 2 kg.

    Sessions of a quarter.
    """
    monkeypatch.setattr(simulated_cell, "SESSION_S", 3.0)
    assert main(["demo", "--gains", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert len(out.splitlines()) <= 40
    assert {p.name for p in tmp_path.iterdir()} == {"free.mcap", "loaded.mcap", "k.json"}
    gains = json.loads((tmp_path / "k.json").read_text())["gains"]
    for gain, stated, factor in zip(gains, CATALOGUE, TRUE_FACTORS, strict=True):
        assert gain["described"] == pytest.approx(stated)
        assert abs(gain["value"] - stated * factor) < 1.5 * gain["half_width"]
        assert gain["half_width"] < 0.02 * gain["value"]
    assert re.search(
        r"[4-6] of 6 true values lie inside their 95 % intervals\. Verdict of the fit: trust\.", out
    )
    signals = [load_signals(tmp_path / f"{name}.mcap") for name in ("free", "loaded")]
    assert [one.payload for one in signals] == [None, PAYLOAD]
    assert signals[1].robot.gain.tolist() == list(CATALOGUE)  # recordings know no other
    assert main(["demo", "--gains", "--out", str(tmp_path)]) == 1
    assert "--overwrite" in capsys.readouterr().err


def compare_with_shipped(name: str, made: Path) -> None:
    """Simulated time: the same session again.

    Rounding differs from processor to processor, and moves a count now and then.
    """
    again, shipped = load_signals(made), signals_of(REPLAY / name / "session.mcap")
    np.testing.assert_allclose(again.q, shipped.q, atol=2e-5)
    assert (again.q == shipped.q).mean() > 0.9
    assert np.linalg.norm(again.effort - shipped.effort) < 0.01 * np.linalg.norm(shipped.effort)
    for key in ("effort_timing", "provenance", "sample_rate_hz", "track"):
        assert getattr(again, key) == getattr(shipped, key), key
    assert again.robot.files["robot.toml"] == shipped.robot.files["robot.toml"]
    assert rounded(again.robot.files) == rounded(shipped.robot.files)


def rounded(files: dict[str, bytes]) -> dict[str, str]:
    """Files with their decimal fractions to ten digits: gains follow from inertias,
    whose rounding differs.
    """
    return {
        name: re.sub(r"\d+\.\d{6,}", lambda found: f"{float(found[0]):.10g}", text.decode())
        for name, text in files.items()
    }


def test_axis_session_is_as_readme_makes_it(tmp_path):
    made = tmp_path / "session.mcap"
    (line,) = re.findall(
        r"robot-identify (simulate .*)", (REPLAY / "emps" / "README.md").read_text()
    )
    assert (
        main(line.replace("replay_data", str(REPLAY)).replace("session.mcap", str(made)).split())
        == 0
    )
    compare_with_shipped("emps", made)


def test_results_of_paper_hold(capsys, monkeypatch):
    """LS is biased by noise of the position, IV is not; any start leads to it, and with the gain
    update is simulated and followed by smaller changes.
    """
    known = [str(DATA / "emps" / "DATA_EMPS.mat")] if (DATA / "emps").exists() else []
    monkeypatch.setattr(sys, "argv", [str(REPLAY / "paper.py"), *known])
    runpy.run_path(sys.argv[0], run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    numbers = [[float(x) for x in re.findall(r"\d+\.\d+", line)] for line in lines]
    noisy, clean = numbers[lines.index(next(x for x in lines if "20 µm" in x))], numbers[1]
    assert clean[0] == pytest.approx(95.1089, abs=clean[1])
    assert abs(noisy[0] - 95.1089) > 15
    assert noisy[2] == pytest.approx(95.1089, abs=noisy[3])
    starts = [re.split(r"  +", line.strip()) for line in lines if re.search(r" o(n|ff) ", line)]
    assert [line[2] for line in starts] == ["simulated"] * 4 + ["reference"]
    changes = [float(line[3].split()[0]) for line in starts]
    assert (len({line[-1] for line in starts[:3]}), changes[3] > 2 * max(changes[:3])) == (1, True)
    assert any("60 parameters, converged" in line for line in lines)
    if known:
        assert lines[-1] == "real EMPS: 95.1089, 203.5034, 20.3935, -3.1648, 4.0834 %"
