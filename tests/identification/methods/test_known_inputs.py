"""A known torque and a known feed-forward: with them the truth is inside the intervals, without
them the fit says caution.

EMPS-like records of the independent simulator: pulses are added to the controller's output, and a
spring acts on the axis.
"""

from dataclasses import dataclass, replace
from functools import cache

import msgspec
import numpy as np
import pytest
from conftest import REPLAY, described_chi, robot_named
from described_truth import off
from friction_models import moved, upright
from independent_robots import Array, Plant, plant
from independent_simulator import Imperfections, described_controller, references, simulate

from acquisition.commands import main as acquire
from acquisition.errors import BadInputError
from acquisition.robot import check_recorded_velocities, load_robot
from identification.commands import main as identify
from identification.data import Recordings, Signals, load_signals
from identification.model import InverseModel, described_parameters
from identification.regression import (
    Overrides,
    make_problem,
)
from identification.results import Evidence, fit_file, identify_ls, validate_all
from identification.results import identify as identify_signals
from identification.study import write_signals
from identification.trust.candidates import Candidates, MissingTerm
from identification.trust.kinds import SPRING

STIFFNESS, AT_REST = 900.0, 0.03  # N/m, and where the spring gives nothing, m
PULSE_V, EVERY, WIDTH = 2.0, 700, 60  # and samples


@dataclass(frozen=True, kw_only=True)
class Sprung(Plant):
    """A plant with a spring on its axis."""

    def inertia_and_bias(self, q: Array, dq: Array) -> tuple[Array, Array]:
        M, bias = super().inertia_and_bias(q, dq)
        return M, bias + STIFFNESS * (q - AT_REST)


@cache
def records() -> tuple[Signals, ...]:
    """Two runs with everything that is known of them."""
    body = Sprung(**vars(plant(REPLAY / "emps" / "robot.toml")))
    path = references(body, range(2), duration_s=6.0, rate_hz=1000.0)
    pulses = np.zeros_like(path.q)
    for k, start in enumerate(range(500, pulses.shape[1] - 500, EVERY)):
        pulses[:, start : start + WIDTH] = PULSE_V * (-1) ** (k // 2)
    cell = Imperfections(encoder_noise=1e-6, torque_noise_percent=2.0)
    runs = simulate(body, described_controller(body), path, cell, feedforward=pulses, substeps=2)
    robot = robot_named("emps")
    # The rules of the package, not what reproduces the digits of the axis's authors.
    robot = replace(robot, identification=type(robot.identification)())
    spring = -STIFFNESS * (runs.q_true - AT_REST)
    return tuple(
        replace(runs.signals(robot, s), known_torque=spring[s].copy(), feedforward=pulses[s].copy())
        for s in range(2)
    )


@cache
def fitted(signals: Signals, method: str) -> Evidence:
    return identify_signals(signals, Overrides(), method=method)


@cache
def without(column: str) -> Signals:
    return replace(records()[0], **{column: None})


def test_truth_in_intervals_with_both():
    fit = fitted(records()[0], "iv")
    assert (off(fit) < 1).all()
    assert "caution" not in [line.level for line in fit.trust.lines]
    assert fit.errors[-1].moving_relative_error_percent < 2.0
    assert fit.trust.line("control law").figures[0][1] == pytest.approx(1.0, abs=0.002)
    assert fit.trust.line("delay").figures[0][1] == pytest.approx(-0.5, abs=0.1)
    assert fit.status == "converged"
    # 0.03 without the pulses, and the robot is lost without the spring
    assert fit.passes[-1].tracking_percent < 0.01
    assert fit.direct[0].torque_error_percent < 3.0


def test_missing_spring_gives_caution():
    fit = fitted(without("known_torque"), "iv")
    assert not (off(fit) < 1).all()
    assert fit.trust.verdict == "caution"
    found = fit.trust.line("missing terms")
    assert found.level == "caution"
    kind, _, stiffness = found.text.partition(" N/m")[0].rpartition(" ")
    assert kind == "spring of joint axis"
    assert float(stiffness.strip("(")) == pytest.approx(STIFFNESS, rel=0.03)
    assert "Record its torque" in found.advice


def test_missing_pulses_give_caution():
    fit = fitted(without("feedforward"), "iv")
    assert fit.trust.verdict == "caution"
    found = fit.trust.line("control law")
    assert found.level == "caution"
    assert found.value < 0.97
    assert (
        fit.passes[-1].tracking_percent
        > 10 * fitted(records()[0], "iv").passes[-1].tracking_percent
    )


def test_validation_counts_external_torque():
    stored, signals = fit_file(fitted(records()[0], "wls")), (records()[1], without("known_torque"))
    errors = [validate_all([(one, Overrides())], stored, "the fit")[1][-1] for one in signals]
    assert errors[0].moving_relative_error_percent < 2.0
    assert errors[1].moving_relative_error_percent > 30.0


def test_columns_pass_through_map_and_fit(tmp_path, capsys):
    """A table with all columns, through both command lines, gives the fit of the arrays."""
    signals, path = (
        records()[0],
        {name: str(tmp_path / name) for name in ("a.csv", "map.toml", "b.csv", "log.mcap")},
    )
    speed, toml = np.gradient(signals.q, 1e-3, axis=0), tmp_path / "robot.toml"
    columns = [
        signals.q,
        signals.q_ref,
        signals.effort / 35.15065188,
        speed,
        signals.known_torque,
        signals.feedforward,
    ]
    units = {
        "position": "m",
        "reference": "m",
        "effort": "V",
        "velocity": "m/s",
        "known_torque": "N",
        "feedforward": "V",
    }
    head = ",".join(units)
    np.savetxt(
        path["a.csv"], np.hstack(columns), delimiter=",", header=head, comments="", fmt="%.15g"
    )
    tables = (f'[{key}]\ncolumns = ["{key}"]\nunit = "{unit}"\n' for key, unit in units.items())
    (tmp_path / "map.toml").write_text("sample_rate_hz = 1000\n" + "".join(tables))
    toml.write_text((REPLAY / "emps" / "robot.toml").read_text().partition("[identification]")[0])
    log = path["log.mcap"]
    assert (
        acquire(
            ["import", path["a.csv"], "--robot", str(toml), "--map", path["map.toml"], "-o", log]
        )
        == 0
    )
    assert "effort in N, with reference, with velocity, with known" in capsys.readouterr().out
    read = load_signals(log)
    for name in ("q", "q_ref", "effort", "known_torque", "feedforward"):
        assert getattr(read, name) == pytest.approx(getattr(signals, name), rel=1e-12, abs=1e-12)
    assert read.velocity == pytest.approx(speed, rel=1e-12)
    assert identify(["fit", log, "--all"]) == 0
    out = capsys.readouterr().out
    rms = np.sqrt(np.mean(signals.known_torque**2)), np.sqrt(np.mean(signals.feedforward**2))
    assert (
        "known torque, added to that of the drives and to the simulated robot: rms axis "
        f"{rms[0]:.3g} N\n" in out
    )
    assert (
        f"feed-forward, added to the output of the simulated controller: rms axis {rms[1]:.3g} V\n"
        in out
    )
    same = identify_ls(replace(signals, effort_timing="unknown"), Overrides())
    assert identify_ls(read, Overrides()).beta == pytest.approx(same.beta, rel=1e-9)
    assert acquire(["info", log, "--csv", path["b.csv"]]) == 0
    head, row, *_ = (tmp_path / "b.csv").read_text().splitlines()
    own = (
        "axis_position_m,axis_effort_N,axis_reference_m,axis_velocity_m_s,axis_known_torque_N,"
        "axis_feedforward_V"
    )
    assert head == f"time_s,{own}"
    assert float(row.split(",")[5]) == pytest.approx(signals.known_torque[0, 0], rel=1e-12)


def test_fit_with_other_description(tmp_path):
    """Twice the ratio halves speeds; torques on the joint stay; without a gain torques
    cannot be added to volts.
    """
    signals = replace(records()[0], velocity=records()[0].q)
    write_signals(tmp_path / "a.mcap", signals, source="")
    text = (REPLAY / "emps" / "robot.toml").read_text()
    (tmp_path / "twice.toml").write_text(
        text.replace('name = "motor"', 'name = "motor"\nratio = 2')
    )
    assert np.array_equal(load_signals(tmp_path / "a.mcap").feedforward, signals.feedforward)
    read = load_signals(tmp_path / "a.mcap", load_robot(tmp_path / "twice.toml"))
    assert read.velocity == pytest.approx(signals.velocity / 2, rel=1e-12)
    assert np.array_equal(read.known_torque, signals.known_torque)
    assert np.array_equal(read.feedforward, signals.feedforward)
    volts = text.replace("drive_gain = 35.15065188\n", "").replace(
        'drive_gain_unit = "N/V"', 'effort_unit = "V"'
    )
    (tmp_path / "volts.toml").write_text(volts)
    with pytest.raises(
        BadInputError,
        match="known_torque: cannot be added to efforts in V",
    ):
        load_signals(tmp_path / "a.mcap", load_robot(tmp_path / "volts.toml"))


@pytest.mark.parametrize(
    ("key", "column", "unit", "message"),
    [
        (
            "known_torque",
            "k",
            '"N m"',
            ".unit: N m at the joint does not match robot.toml: expected N",
        ),
        ("known_torque", "k", '"N"\nside = "motor"', ".side = 'motor': expected 'joint'"),
        ("feedforward", "k", '"A"', ".unit: A at the motor does not match robot.toml: expected V"),
        ("feedforward", "k", '"V"\nside = "joint"', ".side = 'joint': expected 'motor'"),
        ("velocity", "k", '"m"', ".unit = 'm': expected one of rad/s, deg/s, rpm, m/s, mm/s"),
        ("velocity", "w", '"m/s"', " of joint axis is -1 times the derivative of its position"),
    ],
)
def test_impossible_columns_refused(tmp_path, capsys, key, column, unit, message):
    t = np.arange(300) / 1000
    table = np.stack([0.02 * np.sin(9 * t), np.cos(t), np.cos(t), -0.18 * np.cos(9 * t)], axis=1)
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="q,u,k,w", comments="")
    own = '[position]\ncolumns = ["q"]\nunit = "m"\n[effort]\ncolumns = ["u"]\nunit = "V"\n'
    added = f'[{key}]\ncolumns = ["{column}"]\nunit = {unit}\n'
    (tmp_path / "map.toml").write_text(f"sample_rate_hz = 1000\n{own}{added}")
    arguments = [
        "--robot",
        str(REPLAY / "emps" / "robot.toml"),
        "--map",
        str(tmp_path / "map.toml"),
    ]
    assert (
        acquire(["import", str(tmp_path / "a.csv"), *arguments, "-o", str(tmp_path / "out.mcap")])
        == 1
    )
    assert f"{key}{message}" in capsys.readouterr().err
    assert not (tmp_path / "out.mcap").exists()


def test_speeds_of_resting_joints_not_judged():
    """The elbow creeps by 0.4 mrad in text of four digits, or stands in noise; one that moves
    by 60 digits is judged.
    """
    rng, t = np.random.default_rng(0), np.arange(4000) / 400
    fast, scara = 0.4 * np.sin(2 * t), robot_named("scara")
    for elbow in (
        np.round(2e-4 * (1 - np.cos(0.6 * t)), 4),
        1e-5 * rng.standard_normal(4000),
        0 * t,
    ):
        q, v = (
            np.stack([fast, elbow], axis=1),
            np.stack([0.8 * np.cos(2 * t), 1e-4 + 0 * t], axis=1),
        )
        assert check_recorded_velocities(scara, q, v, 400.0, "log") == ()
    slow = np.round(3e-3 * np.sin(0.6 * t), 4)
    q, v = (
        np.stack([fast, slow], axis=1),
        np.stack([0.8 * np.cos(2 * t), -1.8e-3 * np.cos(0.6 * t)], axis=1),
    )
    with pytest.raises(BadInputError, match="velocity of joint elbow"):
        check_recorded_velocities(scara, q, v, 400.0, "log")


@pytest.mark.parametrize("count", [1001, 1010, 1020])
def test_velocity_compared_with_position_steps(count):
    """Of a constant acceleration, whose speed is summed up without an error, times 1.5."""
    t, scara = np.arange(count)[:, None] / 400, robot_named("scara")
    told = check_recorded_velocities(scara, 0.01 * t**2 * [1, 2], 0.03 * t * [1, 2], 400.0, "")
    for name, text in zip(("shoulder", "elbow"), told, strict=True):
        start = f"the velocity of joint {name} is 1.5 times the derivative of its position"
        assert text == f"{start}, with a difference of 50 %"


def test_spring_must_explain_more_than_others():
    def found(kind, taken_percent, least_percent=2.0):
        numbers = {
            "value": 1.0,
            "t": 6.0,
            "taken_percent": taken_percent,
            "together_percent": 5.0,
            "moves": 0.0,
        }
        column = {"where": "", "unit": "", "advice": ""}
        return MissingTerm(kind=kind, **column, **numbers, least_percent=least_percent).found

    assert found("offset", 5.0)
    assert not found(SPRING, 5.0, 10.0)
    assert found(SPRING, 11.0, 10.0)
    # without links that weigh, and with
    for name, least in (("emps", 10.0), ("scara", 10.0), ("tx40", 2.0)):
        problem = make_problem(load_signals(REPLAY / name / "session.mcap"), Overrides())
        peak = np.ones(problem.signals.robot.n)
        beta = described_parameters(problem.model, problem.base)
        of = {"peak": peak, "most": peak, "sliding": peak, "speed": peak[None]}
        terms = Candidates(problem=problem, beta=beta, **of, alone=True, simulated=False).terms
        assert {term.least_percent for term in terms if term.kind == SPRING} == {least}


@cache
def flat_arm() -> Signals:
    """The SCARA: gravity takes no part in its torques."""
    body = plant(REPLAY / "scara" / "robot.toml")
    path = references(body, range(1), duration_s=4.0, rate_hz=1000.0)
    cell = Imperfections(torque_noise_percent=2.0)
    runs = simulate(body, described_controller(body), path, cell, substeps=2)
    return runs.signals(robot_named("scara"), 0)


def test_gain_of_drive_not_external_torque():
    """A drive whose torque is recorded 10 % too large, beside a known torque that
    is larger than its own.
    """
    signals = flat_arm()
    known = np.stack([0 * signals.t_s, 20 * np.sin(4 * signals.t_s)], axis=1)
    wrong = replace(signals, effort=(signals.effort - known) * [1.0, 1.1], known_torque=known)
    found = identify_ls(wrong, Overrides()).trust.line("missing terms")
    assert found.text.startswith("relative gain of joint elbow ")
    assert float(found.text.split("elbow (")[1].split(" %")[0]) == pytest.approx(10.0, abs=0.5)


def test_torques_without_gravity_reported():
    """As some drivers take it out."""
    (signals,) = moved(upright([["viscous", "coulomb"]] * 2), 2, noise=0.2).sources
    dynamics = InverseModel(signals.robot)
    weight = dynamics.regressor(signals.q, 0 * signals.q, 0 * signals.q) @ described_chi(dynamics)
    plain, found = (
        identify_ls(
            replace(signals, effort=signals.effort - x), Overrides(torque_lag_s="none")
        ).trust.line("physical plausibility")
        for x in (0, weight)
    )
    assert (plain.level, found.level) == ("ok", "caution")
    assert "a model without gravity fits the torques better: " in found.text
    left, against = (
        float(part.split()[-1]) for part in found.text.split("better: ")[1].split(" %")[:2]
    )
    assert left < 0.6 * against


def test_vertical_axes_have_no_missing_gravity():
    signals = flat_arm()
    assert (
        "gravity" not in identify_ls(signals, Overrides()).trust.line("physical plausibility").text
    )
    # a description that lays it on its side
    upright = replace(signals.robot, gravity=np.array([0.0, -9.81, 0.0]))
    laid = replace(signals, robot=upright)
    own = msgspec.structs.replace(upright.identification, own=["Fv"])
    twice = [
        replace(laid, robot=replace(upright, identification=own), recording=x, sha256=x)
        for x in ("a", "b")
    ]
    both = (
        identify_ls(Recordings(sources=tuple(twice)), Overrides())
        .trust.line("physical plausibility")
        .text
    )
    # rows of both recordings, whose friction has columns of its own
    assert "without gravity fits the torques better" in both
