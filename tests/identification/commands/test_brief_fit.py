"""`fit --brief`: its words, and that the recording that it advises makes intervals narrower."""

import shlex
import shutil
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_runs import run
from conftest import REPLAY

from acquisition.errors import NoFitError
from acquisition.robot import fourier_reference, load_robot, table_reference
from identification import design
from identification.commands.fit import _next_step
from identification.design import ExcitationSettings, excitation, expected_after, search
from identification.report import by_joint, read_fit
from identification.study import Noise, closed_loop, write_signals

MOST_LINES, WIDTH, TOML = 10, 80, "my robot.toml"


def test_parameters_in_words_by_joint():
    names = ["XX1R", "YZ1", "Ia2", "MX2", "MY2R", "M2", "Fvp1", "Fvn1", "Off1@a.b", "K:a", "MX:b"]
    assert by_joint([*names, "mu2", "Fcm2", "alpha"], ["base", "arm"]) == (
        "base: 2 inertias, viscous friction forwards, viscous friction backwards, offset; arm: "
        "rotor inertia, 2 first moments, mass, load-dependent friction, Coulomb friction"
    )
    assert by_joint([], ["base"]) == ""


@pytest.fixture
def brief(tmp_path, monkeypatch, capsys):
    """Run `fit --brief` with other arguments on a terminal of 80 columns, with short searches."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    monkeypatch.setattr(search, "STARTS", 1)
    monkeypatch.setattr(search, "MAX_ITERATIONS", 15)
    return partial(run, capsys, "fit", "--method", "wls", "--robot", TOML, "--brief")


def recorded(path, robot, q_ref, rate_hz, seed):
    noise = Noise(effort_percent=3.0)
    signals = closed_loop(robot, q_ref, rate_hz, noise=noise, seed=seed)
    write_signals(Path(path), signals, source="simulated")


@pytest.mark.parametrize(
    ("name", "rate_hz", "share"), [("scara", 1000.0, 0.02), ("tx40", 250.0, 0.2)]
)
def test_advised_recording_narrows_intervals(name, rate_hz, share, brief, capsys, monkeypatch):
    """After a small motion; the advice ends with the recording of its command."""
    expected = []
    monkeypatch.setattr(
        design, "expected_after", lambda *of: expected.append(expected_after(*of)) or expected[-1]
    )
    shutil.copy(REPLAY / name / "robot.toml", TOML)
    robot = load_robot(TOML)
    small = fourier_reference(robot, period_s=8.0, seed=4, share=share)
    recorded("log.mcap", robot, small.at(np.arange(0, 8, 1 / rate_hz))[0], rate_hz, 1)
    status, out, _ = brief("log.mcap", "--json", "before.json")
    *lines, told, command = out.splitlines()
    before = read_fit("before.json")
    poor = {p.name for p in before.parameters if not p.essential}
    assert status == 0
    assert len(lines) < MOST_LINES
    assert max(map(len, [*lines, told])) <= WIDTH
    assert f"  Parameters     {before.size - len(poor)} of {before.size} well determined" in lines
    assert command == f"robot-identify excite '{TOML}' --after log.mcap -o log_next.csv"
    helped = {x: share for x, share in expected[0][1].items() if x in poor and share < 0.5}
    count, most = len(helped), 1 / min(helped.values())
    assert told == (
        f"One more recording should narrow {count} of their intervals, up to {most:.3g} times:"
    )
    assert run(capsys, *shlex.split(command)[1:])[0] == 0
    recorded("b.mcap", robot, table_reference(Path("log_next.csv"), robot, 1 / rate_hz), rate_hz, 2)
    status, out, _ = brief("log.mcap", "b.mcap", "--json", "after.json")
    old, new = (
        {p.name: p.half for p in fit.parameters} for fit in (before, read_fit("after.json"))
    )
    ratios = np.array([new[name] / old[name] for name in helped])
    assert (ratios < 0.5).all()
    assert 0.3 < np.median(ratios / [*helped.values()]) < 1.5
    assert "excite" not in out


def test_delay_is_estimated_first(brief):
    shutil.copy(REPLAY / "scara" / "robot.toml", TOML)
    log = str(REPLAY / "scara" / "session.mcap")
    status, out, _ = brief(log, "--method", "iv")
    assert (status, out.splitlines()[-1]) == (0, "  Parameters     8 of 8 well determined")
    status, out, _ = brief(log)
    assert (status, out.splitlines()[-2:]) == (
        0,
        [
            "  The others     shoulder: viscous friction",
            "To narrow their intervals, estimate the delay first: fit with --method iv.",
        ],
    )


EXCITE, SAVED = "robot-identify excite robot.toml --after a/b.mcap", "-o a/b_next.csv"
NONE = "One more recording would not halve their intervals: their values may be 0."


@pytest.mark.parametrize(
    ("verdict", "level", "period_s", "share", "told"),
    [
        ("trust", "ok", 10.0, 0.4, f"{EXCITE} {SAVED}"),
        ("caution", "caution", 20.0, 0.4, f"{EXCITE} --period 20 {SAVED}"),
        ("trust", "ok", 10.0, 0.6, NONE),
        ("do not use", "ok", 10.0, 0.4, ""),
    ],
)
def test_advice_ends(verdict, level, period_s, share, told, monkeypatch):
    monkeypatch.setattr(design, "expected_after", lambda *_: (period_s, {"A": 0.1, "B": share}))
    fit = SimpleNamespace(
        trust=SimpleNamespace(verdict=verdict, lines=[SimpleNamespace(test="delay", level=level)]),
    )
    options = SimpleNamespace(robot=None, recordings=[Path("a/b.mcap")])
    assert "".join(_next_step(fit, ["B"], options)[-1:]) == told


@pytest.mark.parametrize(("bandwidth_hz", "period_s"), [(3.0, 10.0), (1.5, 20.0), (1.4, 22.0)])
def test_slow_position_loop_gets_longer_period(bandwidth_hz, period_s, monkeypatch):
    """Of as many harmonics, which `excite` accepts."""
    asked = []

    def excite(robot, settings, *_, **__):
        asked.append(settings)
        raise NoFitError("enough")

    monkeypatch.setattr(excitation, "excite", excite)
    for name in ("prior_information", "fit_file"):
        monkeypatch.setattr(excitation, name, lambda *_, **__: None)
    signals = SimpleNamespace(robot=SimpleNamespace(bandwidth_hz=bandwidth_hz))
    problem = SimpleNamespace(signals=signals)
    fit = SimpleNamespace(recordings=[SimpleNamespace(problem=problem)], problem=problem)
    with pytest.raises(NoFitError, match="enough"):
        expected_after(fit, Path("robot.toml"))
    assert asked == [ExcitationSettings(period_s=period_s)]
    excitation._refuse_fast(signals.robot, *asked, "robot.toml")
