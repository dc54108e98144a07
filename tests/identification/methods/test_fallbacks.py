"""What a fit does where a step is impossible, it says."""

from dataclasses import replace

import pytest
from conftest import REPLAY, robot_named

from acquisition.robot import Payload
from identification.commands import main
from identification.data import Recordings, load_signals, signals_from_arrays
from identification.errors import NoFitError
from identification.regression import Overrides
from identification.results import identify, identify_ls

COLUMNS = ("t_s", "q", "effort", "q_ref")


def refused(*_: object) -> None:
    raise NoFitError("none")


def test_recording_too_short_for_default_low_pass():
    whole = load_signals(REPLAY / "scara" / "session.mcap")
    part = slice(2000, 2400)
    signals = signals_from_arrays(
        whole.q[part], whole.effort[part], whole.sample_rate_hz, robot_named("scara")
    )
    fit = identify_ls(signals, Overrides(cutoff_hz=400.0, decimation=2))
    assert any("include noise" in text for text in fit.warnings)


@pytest.mark.parametrize("near", [True, False])
def test_payload_without_body(monkeypatch, near):
    whole = load_signals(REPLAY / "scara" / "session.mcap")
    halves = tuple(
        replace(
            whole,
            **{name: getattr(whole, name)[part] for name in COLUMNS},
            payload=load,
            track=None,
            recording=label,
            sha256=label,
        )
        for label, part, load in (
            ("free", slice(6000), None),
            ("loaded", slice(6000, None), Payload(1.0)),
        )
    )
    if not near:
        monkeypatch.setattr("identification.regression.payload.consistent_parameters", refused)
    fit = identify_ls(Recordings(sources=halves), Overrides())
    assert any("no body" in text for text in fit.warnings) != near


def test_no_consistent_model_nearby(monkeypatch):
    signals = load_signals(REPLAY / "scara" / "session.mcap")
    part = replace(signals, **{name: getattr(signals, name)[:4000] for name in COLUMNS}, track=None)
    monkeypatch.setattr("identification.simulation.instruments.nearest_consistent", refused)
    fit = identify(part, Overrides(), method="iv")
    assert all("no physically consistent model is near" in one.reason for one in fit.passes)


def test_unknown_payload_alone_has_no_scale(capsys):
    assert (
        main(["fit", str(REPLAY / "scara" / "session.mcap"), "--payload", "session=unknown"]) == 0
    )
    printed = " ".join(capsys.readouterr().out.split())
    assert "Payload of session.mcap the recordings do not separate its mass from the arm" in printed
    assert "→ Record without it too, or specify its mass." in printed
    assert "mass 1 kg" not in printed
