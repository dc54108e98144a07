"""What the description denies or holds fixed: rotors, zeros of joints, one clock.

Named as missing, or as assumed.
"""

from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from conftest import REPLAY
from hunt import clean, fit_by_default, fit_by_least_squares
from hunt_kinds import KINDS, SetUp, clocks_apart, denied_rotor, white
from independent_robots import plant
from independent_simulator import Imperfections, description, designed_pd, without_settings

from identification.data import Recordings
from identification.regression import Overrides
from identification.results import Evidence, identify_ls
from identification.trust import columns
from identification.trust.candidates import MissingTerm
from identification.trust.columns import missing_terms
from identification.trust.kinds import IN_PARTS


def arm() -> SetUp:
    toml = REPLAY / "tx40" / "robot.toml"
    body = plant(toml)
    controller = designed_pd(body, 10.0, 500.0)
    cell = Imperfections(encoder_noise=1e-5, torque_noise_percent=0.5)
    return SetUp(
        name="tx40", body=body, controller=controller, cell=cell,
        robot=without_settings(description(toml, controller)), timing="command", duration_s=6.0,
        substeps=2,
    )  # fmt: skip


def assumed(fit: Evidence) -> dict[str, str]:
    return {
        one.what: one.value
        for one in fit.trust.assumed
        if one.what in ("joint zeros", "rotor inertias")
    }


def figures(fit: Evidence, kind: str) -> list[tuple[str, float, float]]:
    return [(x.where, x.value, x.t) for x in missing_terms(fit.data) if x.kind == kind]


@cache
def denied() -> tuple[SetUp, Evidence]:
    setup = denied_rotor(white("scara"), np.random.default_rng(1))
    return setup, fit_by_default(setup.recording(3))


def test_disabled_rotor_named_with_size():
    setup, fit = denied()
    told = fit.trust.line("missing terms")
    assert (told.level, told.finding) == (
        "caution",
        "ratio of joint elbow off, or rotor of joint elbow missing",
    )
    ((_, value, t),) = figures(fit, "rotor")
    assert value == pytest.approx(0.3 * setup.robot.parameters["ZZ2"], rel=0.15)
    assert abs(t) > 10
    assert "rotor inertias" not in assumed(fit)
    # that of the shoulder is a part of ZZ1R
    ((where, value, t),) = figures(clean("scara"), "rotor")
    assert where == "of joint elbow"
    assert abs(t) < 4
    assert clean("scara").trust.verdict == "trust"


def test_rotor_not_advised_if_ratio_explains():
    """With the rotor allowed, the ratio is named all the same."""
    setup, fit = denied()
    line = fit.trust.line("missing terms")
    advice = "rotor of joint elbow missing", "rotor_inertia = true"
    assert [text in line.advice for text in advice] == [True, False]
    signals = setup.recording(3)
    joints = tuple(
        msgspec.structs.replace(joint, rotor_inertia=True) for joint in signals.robot.joints
    )
    followed = fit_by_default(replace(signals, robot=replace(signals.robot, joints=joints)))
    assert followed.trust.verdict == "trust"
    rotor_2 = followed.estimate.names.index("Ia2")
    assert (
        abs(followed.beta[rotor_2] - setup.body.rotor[1, 1]) < 2 * followed.intervals.half[rotor_2]
    )


def test_unseen_zeros_and_rotors_assumed():
    """The SCARA's last zero turns its link; its first and that of a level axis are
    nowhere in the torque.
    """
    assert assumed(clean("scara")) == {
        "joint zeros": "right at elbow",
        "rotor inertias": "none at elbow (rotor_inertia = false)",
    }
    assert assumed(clean("emps")) == {}
    zero = KINDS["zero of a joint 2°"].change(white("scara"), np.random.default_rng(1))
    off = fit_by_default(zero.recording(3))
    moved = np.abs(off.estimate.beta - clean("scara").estimate.beta) / off.intervals.half
    assert moved[off.estimate.names.index("MY2")] > 3
    assert (off.trust.line("missing terms").level, assumed(off)["joint zeros"]) == (
        "ok",
        "right at elbow",
    )


def test_joint_zero_named_in_degrees_or_assumed():
    signals = arm().recording(3)
    clean = fit_by_least_squares(signals)
    assert max(abs(t) for _, _, t in figures(clean, "zero")) < 4
    assert "joint_6" in assumed(clean)["joint zeros"]
    off = np.deg2rad(2.0) * (np.arange(6) == 2)
    fit = fit_by_least_squares(replace(signals, q=signals.q - off, q_ref=signals.q_ref - off))
    value, t = {where: x for where, *x in figures(fit, "zero")}["of joint joint_3"]
    assert "joint_3" not in assumed(fit).get("joint zeros", "")
    assert abs(t) > 5
    assert value == pytest.approx(2.0, abs=3 * abs(value / t))
    assert fit.trust.line("missing terms").level == "caution"


def test_clock_drift_named():
    fit = fit_by_default(clocks_apart(white("scara"), np.random.default_rng(0)).recording(3))
    told = fit.trust.line("missing terms")
    assert (told.level, told.finding) == ("caution", "clock drift between positions and efforts")
    ((_, value, t),) = figures(fit, "clock drift")
    assert abs(value) == pytest.approx(0.1, rel=0.1)
    assert abs(t) > 20
    ((_, value, t),) = figures(clean("scara"), "clock drift")
    assert abs(t) < 4


@pytest.mark.parametrize(
    ("what", "name", "kind", "found"),
    [
        ("torque constant drifts 3-10 %", "scara", "drift of the torque constant", 6.6),
        ("friction drifts 20-40 %", "emps", "drift of friction", 30.2),
        ("hysteresis 10-20 %", "scara", "hysteresis", None),
        ("brake drags for 30 % of the time", "scara", IN_PARTS, None),
        ("ratio of one joint 5-10 %", "scara", "ratio", 7.6),
    ],
)
def test_time_and_ratio_faults_named_with_size(what, name, kind, found):
    """Least squares of white noise; values as drawn, where the description says what is right."""
    fit = fit_by_least_squares(
        KINDS[what].change(white(name), np.random.default_rng(4)).recording(3)
    )
    told = fit.trust.line("missing terms")
    assert (told.level, told.finding.startswith(kind)) == ("caution", True), told.text
    value, t = max((x[1:] for x in figures(fit, kind)), key=lambda x: abs(x[1]))
    assert abs(t) > 7
    assert found is None or value == pytest.approx(found, rel=0.2)
    sound_t = [t for _, _, t in figures(clean(name), kind)]
    assert max(map(abs, sound_t), default=0.0) < 4.5


def test_delay_needs_fast_rows_alone(monkeypatch):
    """Of the elbow; the rows of the shoulder stay."""
    data, scored, shares = clean("scara").data, columns._scored, []
    orthonormal, joint = columns.orthonormal, data.observed.system.joint_of_row

    def of_rows(A):
        shares.append([A[joint == j].any(axis=1).mean() for j in range(2)])
        return orthonormal(A)

    def lag_of_elbow(in_fast_rows: float) -> MissingTerm:
        def of_t(evidence, kind, terms, *, fast):
            with pytest.MonkeyPatch.context() as within:
                if kind == "delay":
                    within.setattr(columns, "orthonormal", of_rows)
                found = scored(evidence, kind, terms, fast=fast)
            t = in_fast_rows if fast else 6.0
            return [
                replace(x, t=t, moves=2.0) if x.finding == "delay of joint elbow" else x
                for x in found
            ]

        monkeypatch.setattr(columns, "_scored", of_t)
        return next(x for x in missing_terms(data) if x.finding == "delay of joint elbow")

    assert lag_of_elbow(5.5).found
    assert not lag_of_elbow(4.0).found
    assert not lag_of_elbow(-5.5).found
    assert all(shoulder == 1.0 and elbow < 1 for shoulder, elbow in shares)
    assert len(shares) == 3


def test_delay_found_with_frequent_reversals():
    """A command acts for the period after it: half a sample early. Behind a filter of six rows no
    joint has enough.
    """
    fit = fit_by_default(replace(white("scara"), highest_hz=2.0).recording(0))
    (lag,), line = fit.data.lags, fit.trust.line("delay")
    assert (lag.order, fit.trust.verdict) == (2, "trust")
    assert line.text.endswith("whitened over 2 rows, not 6, because joints reverse often")
    assert lag.found[0] == pytest.approx(-0.0005, abs=lag.half_width_s)
    assert lag.half_width_s < 0.0002


def test_late_elbow_named():
    def late(signals):
        effort = signals.effort.copy()
        effort[2:, 1] = effort[:-2, 1]
        return replace(signals, effort=effort)

    fit = fit_by_default(white("scara").changed(late).recording(3))
    assert fit.trust.lines[0].finding == "delay of joint elbow"
    assert figures(fit, "delay")[1][1] == pytest.approx(2.0, abs=0.3)


def test_terms_same_in_blocks_and_whole(monkeypatch):
    """Hysteresis begins where the rows before end; the limit is of the whole recording's torque."""
    signals, often = white("scara").recording(3), Overrides(decimation=2)
    whole = identify_ls(signals, often).data.observed
    monkeypatch.setattr("identification.regression.problem._SERIES_BLOCK", 20_000)
    blocks = identify_ls(signals, often).data.observed
    assert (len(whole.most), len(blocks.most) > 2) == (1, True)
    off, size = (np.linalg.norm(x, axis=0) for x in (blocks.C - whole.C, whole.C))
    assert (off <= 1e-5 * size).all()


def test_several_recordings_name_brake_by_time_share():
    setup = KINDS["brake drags for 30 % of the time"].change(
        white("scara"), np.random.default_rng(4)
    )
    each = (replace(setup.recording(k), recording=f"r{k}.mcap") for k in (3, 4))
    fit = identify_ls(Recordings(sources=tuple(each)), Overrides())
    told = fit.trust.line("missing terms")
    assert told.finding.startswith(IN_PARTS)
    assert told.finding.endswith(" % of each recording")
