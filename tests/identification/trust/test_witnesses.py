"""What makes a fit one that is not to be used, or names a cause, where a test alone does not."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hunt import clean, fit_by_least_squares
from hunt_kinds import SetUp, two_signs, white
from independent_simulator import Reference, references, simulate
from msgspec import structs

from identification.report import TrustResult
from identification.trust import WORDS, efforts, trust_in, verdict


def told(monkeypatch, **changed):
    """The verdict with some lines changed, by test; nothing is tested again."""
    data = clean("scara").data
    lines = {of.test: of for row in WORDS.values() if (of := row.line(data)) is not None}
    for name, changes in changed.items():
        name = {"held": "cross-validation", "fixed": "convergence"}.get(name, name)
        plain = TrustResult(test=name, level="ok", value=None, text="")
        lines[name] = structs.replace(lines.get(name, plain), **changes)
    rows = {name: replace(WORDS[name], by=lambda _, of=of: of) for name, of in lines.items()}
    monkeypatch.setattr(verdict, "WORDS", rows)
    return trust_in(data)


LOW = {"level": "caution", "value": -0.3}
FAR = {"level": "caution", "case": "far"}
NEGATIVE = {
    "finding": "wrist_2: effort or position has the wrong sign",
    "figures": (("wrist_1", 1.0, 0.1, 1.0), ("wrist_2", -0.9, 0.2, 1.0)),
}


@pytest.mark.parametrize("doubt", [{"physical plausibility": LOW}, {"physically consistent": FAR}])
def test_far_from_a_robot_needs_a_witness(monkeypatch, doubt):
    assert told(monkeypatch, **doubt).verdict == "caution"
    for name, witness, named in (
        ("held", {"value": 20.5}, "20 % held out"),
        ("a priori links", NEGATIVE, NEGATIVE["finding"]),
    ):
        both = told(monkeypatch, **doubt, **{name: witness})
        assert (both.verdict, both.lines[0].finding) == ("do not use", named)
        assert named in both.line("physical plausibility").text
        assert told(monkeypatch, **{name: witness}).verdict == "trust"
    assert told(monkeypatch, **doubt, held={"value": 19.5}).verdict == "caution"


def test_turned_sign_is_a_witness(monkeypatch):
    monkeypatch.setattr(
        efforts, "turned_sign", lambda *_: (0.9, "the effort of motor_2 has the wrong sign")
    )
    assert told(monkeypatch).verdict == "trust"
    assert (
        told(monkeypatch, **{"physical plausibility": LOW}).lines[0].finding
        == "the effort of motor_2 has the wrong sign"
    )
    monkeypatch.setattr(efforts, "turned_sign", lambda *_: (0.97, "another"))
    assert told(monkeypatch, **{"physical plausibility": LOW}).verdict == "caution"


@pytest.mark.parametrize("seed", [0, 2])
def test_two_wrong_signs_make_fit_do_not_use(seed):
    wrong = two_signs(white("scara"), np.random.default_rng(seed))
    fit = fit_by_least_squares(wrong.recording(3))
    assert fit.trust.verdict == "do not use"
    assert fit.trust.lines[0].finding.endswith("has the wrong sign")


def test_findings_explain_no_fixed_point(monkeypatch):
    none = {"level": "do not use", "text": "status diverged: it ran away"}
    rows = {"level": "caution", "text": "", "finding": "1.9 % of the rows missing"}
    both = told(monkeypatch, fixed=none, rows=rows)
    assert (
        both.line("convergence").text
        == "status diverged: it ran away. Likely cause: 1.9 % of the rows missing"
    )
    assert both.lines[0].finding == "1.9 % of the rows missing"
    assert told(monkeypatch, fixed=none).line("convergence").text == none["text"]


def on_one_sine(setup: SetUp, path: Reference, hz: float) -> Reference:
    """Of the same travel."""
    t = np.arange(path.q.shape[1])[None, :, None] / setup.controller.rate_hz
    size = 0.5 * np.ptp(path.q, axis=1, keepdims=True)
    size = np.minimum(size, np.abs(path.dq).max(axis=1, keepdims=True) / (2 * np.pi * hz))
    fade = np.clip(np.minimum(t, t[:, -1:] - t) / 1.0, 0.0, 1.0)
    w = fade**3 * (10 - 15 * fade + 6 * fade**2)
    q = path.q[:, :1] + w * size * np.sin(2 * np.pi * hz * t)
    dq = np.gradient(q, 1 / setup.controller.rate_hz, axis=1)
    return Reference(q=q, dq=dq, ddq=np.gradient(dq, 1 / setup.controller.rate_hz, axis=1))


def test_single_sine_hardly_excites_arm():
    setup = white("tx40")
    path = references(
        setup.body, range(1), duration_s=7.0, rate_hz=setup.controller.rate_hz, highest_hz=1.0
    )
    sine = on_one_sine(setup, path, 0.5)
    both = {name: np.concatenate([x, vars(sine)[name]]) for name, x in vars(path).items()}
    runs = simulate(setup.body, setup.controller, Reference(**both), setup.cell, seed=1, substeps=1)
    for run, level in enumerate(("ok", "caution")):
        line = fit_by_least_squares(runs.signals(setup.robot, run)).trust.line("excitation")
        assert line.level == level, line.text
    assert "Record a more varied motion" in line.advice
    assert line.value > 60


def with_torque(setup: SetUp, of):
    """The torque of a thing that nobody described, beside the drives: taken off what they gave."""
    return setup.changed(lambda signals: replace(signals, effort=signals.effort + of(signals)))


def test_nonlinear_spring_and_effort_limit_are_named():
    setup = white("scara")

    def stop(signals):
        q = signals.q - signals.q.mean(axis=0)
        beyond = np.maximum(np.abs(q) - 0.5 * np.abs(q).max(axis=0), 0.0)
        return np.sign(q) * beyond * [0.0, 4.0]

    def unlimited(signals, joint=(0.0, 1.0)):
        tau, most = signals.effort, 0.7 * np.abs(signals.effort).max(axis=0)
        return np.sign(tau) * np.maximum(np.abs(tau) - most, 0.0) * joint

    for change, kind in (
        (stop, "spring that is not linear of joint elbow"),
        (unlimited, "limit of the effort of joint elbow"),
        (partial(unlimited, joint=(1.0, 0.0)), "limit of the effort of joint shoulder"),
    ):
        signals = with_torque(setup, change).recording(3)
        effort = np.array(signals.effort)
        effort[3000] *= 2.0  # one bad sample hides nothing
        fit = fit_by_least_squares(replace(signals, effort=effort))
        line = fit.trust.line("missing terms")
        assert line.level == "caution", line.text
        assert line.finding.startswith(kind), line.text
    assert fit_by_least_squares(setup.recording(3)).trust.line("missing terms").level == "ok"
