"""What dry runs without noise are off by, cause by cause: interpolation, the sampled effort, the
law that is described.
"""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from conftest import REPLAY, robot_named
from loops import simulate
from made_up_buses import bus_of, bus_text, robot_of
from scipy.interpolate import CubicSpline

import acquisition.commands.checking as checking_module
from acquisition.protocol import State
from acquisition.recording import read_recording
from acquisition.robot import DriveFile, demand_ripple, load_robot, ripple_notes
from acquisition.simulated import (
    DrivenPlant,
    JointwisePlant,
    LoopGains,
    SimulatedDrives,
    cascaded_loops,
    describe_loops,
)
from identification.control import Reference, described_law
from identification.data import load_signals
from identification.model import InverseModel, direct_model
from identification.regression import Overrides, make_settings
from identification.results import fit_document, fit_file, identify_ls
from identification.simulation import described_robot, drive_loops
from identification.study import record_simulated_session, simulated_cell, study_truth

BANDWIDTH_HZ, PERIOD_S, INERTIA = 10.0, 0.004, 2.0
W = 2 * np.pi * BANDWIDTH_HZ
FINE = (
    bus_text(1, period_s=PERIOD_S)
    .replace("65536", "16777216")
    .replace("bandwidth_hz = 5", f"bandwidth_hz = {BANDWIDTH_HZ}")
)


def sampled(text: str, loops: LoopGains, *, seconds: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """Positions and efforts at the joint that an enabled drive reports while it moves
    an inertia to and fro.
    """
    robot = robot_of(text)
    bus, one = bus_of(robot), np.ones(1)
    plant = JointwisePlant(
        INERTIA * one, 0 * one, 0 * one, 0 * one, slides=np.zeros(1, bool), position=0 * one
    )
    drives = SimulatedDrives(robot, bus, DrivenPlant(plant=plant, loops=loops))
    node, drive = drives.nodes[0], bus.drives[0]
    node.nmt, node.state, node.values[0x6061, 0] = 5, State.OPERATION_ENABLED, 8
    found = []
    for k in range(round(seconds / PERIOD_S)):
        target = 0.5 * (1 - np.cos(2 * np.pi * 0.5 * k * PERIOD_S)) * 50
        node.values[0x607A, 0] = int(drive.position_codec.raw(np.array(target)))
        drives.receive(round(k * PERIOD_S * 1e9), 0x80, b"")
        effort = drive.effort.si(np.array(node.values[drive.effort.entry.index, 0]))
        found.append((drive.position_codec.si(np.array(node.values[0x6064, 0])) / 50, effort * 50))
    return np.array(found).T


def inertia_and_lag(q: np.ndarray, effort: np.ndarray) -> tuple[float, float]:
    """Inertia as a share of the true one, less one, and lag in periods, of the effort
    against the acceleration.
    """
    motion = CubicSpline(np.arange(len(q)) * PERIOD_S, q)
    t_s = np.arange(len(q))[200:-50] * PERIOD_S
    a, jerk = motion(t_s, 2), np.gradient(motion(t_s, 2), PERIOD_S)
    (J, late), *_ = np.linalg.lstsq(INERTIA * np.c_[a, -jerk], effort[200:-50])
    return J - 1, late / PERIOD_S


def cascade(*, smooth: bool) -> LoopGains:
    """A position loop of the bandwidth, a velocity loop four times as fast with an
    integral, no speed fed forward.
    """
    velocity = 4 * W * INERTIA / 50**2 * np.ones(1)
    return LoopGains(
        position=W * velocity, velocity=velocity, integral=W * velocity,
        position_share=W * np.ones(1), feedforward=0.0,
        smooth=smooth,
    )  # fmt: skip


def test_linear_targets_give_torque_demand_ripple():
    """(w T)²/3 of the inertia; a twentieth of it with a smooth reference, with and
    without speed fed forward.
    """
    expected = demand_ripple(BANDWIDTH_HZ, PERIOD_S)
    assert expected == pytest.approx((W * PERIOD_S) ** 2 / 3)
    assert abs(inertia_and_lag(*sampled(FINE, cascade(smooth=False)))[0]) == pytest.approx(
        expected, rel=0.2
    )
    assert abs(inertia_and_lag(*sampled(FINE, cascade(smooth=True)))[0]) < expected / 20
    loops = cascaded_loops(robot_of(FINE), np.array([INERTIA]))
    assert abs(inertia_and_lag(*sampled(FINE, loops))[0]) < expected / 20


def test_bandwidth_gives_motor_cascades():
    """Kd (w e + de) (1 + w / s) at each motor, Kd being 4 w times the inertia that turns with it;
    joint 6 hangs on both.
    """
    loops = cascaded_loops(load_robot(REPLAY / "tx40" / "robot.toml"), np.arange(1.0, 7.0))
    inertia = np.array([1 / 32**2, 2 / 32**2, 3 / 45**2, 4 / 48**2, (5 + 6) / 45**2, 6 / 32**2])
    assert loops.velocity == pytest.approx(4 * W * inertia)
    assert loops.position / loops.velocity == pytest.approx(np.full(6, W + W))
    assert loops.integral / loops.velocity == pytest.approx(np.full(6, W * W))
    described = drive_loops(load_robot(REPLAY / "scara" / "robot.toml"), np.ones(2))
    assert (described.position.tolist(), described.velocity.tolist()) == (
        [3700.0, 60.0],
        [190.0, 3.1],
    )
    assert (described.integral.tolist(), described.feedforward) == ([0.0, 0.0], 1.0)


@pytest.mark.parametrize("smooth", [True, False])
def test_actual_value_is_mean_of_last_period(smooth):
    """Half a period late and of the true inertia, whatever the interpolation."""
    text = FINE.replace('reference = "6074"', 'actual = "6077"')
    off, lag = inertia_and_lag(*sampled(text, cascade(smooth=smooth)))
    assert abs(off) < 1e-3
    assert lag == pytest.approx(0.5, abs=0.02)


def test_check_and_report_note_ripple(monkeypatch):
    at_10_hz = bus_text(1).replace("bandwidth_hz = 5", "bandwidth_hz = 10")  # SYNC every 2 ms

    def notes_of(text: str) -> tuple[str, ...]:
        robot = robot_of(text)
        return ripple_notes(robot.bus, robot.controller.bandwidth_hz)

    (text,) = notes_of(at_10_hz)
    assert "inertia may be wrong by 0.5 %" in text
    changes = (
        ("period_s = 0.002", "period_s = 0.001"),
        ('reference = "6074"', 'actual = "6077"'),
        ("bandwidth_hz = 10", ""),
    )
    assert [notes_of(at_10_hz.replace(*change)) for change in changes] == [(), (), ()]
    assert notes_of(at_10_hz[: at_10_hz.index("[bus]")]) == ()
    # of a second axis
    assert DriveFile(node=1, reference="6874:0", counts_per_turn=1).reports_demand
    monkeypatch.setattr(checking_module, "check_drives", lambda link, bus: [])
    monkeypatch.setattr(checking_module, "_positions", lambda robot, master: [])
    robot = robot_of(at_10_hz)
    found = checking_module.check(robot, bus_of(robot))
    assert [(f.found, f.ok) for f in found if f.subject == "effort"] == [(text, True)]


def test_one_demand_per_sync_is_a_note():
    signals = load_signals(REPLAY / "tx40" / "session.mcap")
    drives = [
        msgspec.structs.replace(one, actual=None, reference="6074")
        for one in signals.robot.bus.drive
    ]
    robot = replace(signals.robot, bus=msgspec.structs.replace(signals.robot.bus, drive=drives))
    signals = replace(signals, robot=robot)
    fit, told = identify_ls(signals, Overrides()), "the torque demand value (6074) is read once"
    assert [note[: len(told)] for note in fit.notes] == [told]
    assert not [line for line in fit.warnings if "SYNC" in line]
    figures = fit_document(fit_file(fit)).sections[1]
    for section in (figures, figures.short):
        assert ("Note", fit.notes[0]) in section.lines
    assert identify_ls(replace(signals, provenance="tables"), Overrides()).notes == ()


def test_dry_run_recording_gives_control_law():
    robot = load_robot(REPLAY / "tx40" / "robot.toml")
    loops = cascaded_loops(robot, np.ones(6))
    described = describe_loops(robot, loops)
    law = described_law(described)
    assert robot.controller.structure is None
    assert (law.feedforward, 1 / law.period_s, law.velocity_estimate) == (
        1.0,
        pytest.approx(2000.0),
        "exact",
    )
    for mine, theirs in (
        (law.Kp, loops.position),
        (law.Kd, loops.velocity),
        (law.Ki, loops.integral),
    ):
        assert mine == pytest.approx(theirs, rel=1e-12)
    # from which a description is exported
    assert described.files["robot.toml"] == robot.files["robot.toml"]
    assert set(described.files) - set(robot.files) == {"simulated_controller.toml"}
    scara = load_robot(REPLAY / "scara" / "robot.toml")  # states a law, which its drives have
    assert describe_loops(scara, loops) is scara


@pytest.mark.parametrize(
    ("controller", "told"), [("10.0", False), ("5.0", True), ('10.0\nstructure = "pid"', True)]
)
def test_unused_controller_warns(controller, told):
    text, recording = (REPLAY / "tx40" / "robot.toml").read_text(), REPLAY / "tx40" / "session.mcap"
    assert "\nbandwidth_hz = 10.0" in text
    changed = robot_of(text.replace("\nbandwidth_hz = 10.0", f"\nbandwidth_hz = {controller}"))
    signals = load_signals(recording, changed)
    assert signals.robot.controller == load_signals(recording).robot.controller
    warning = (
        "session.mcap: the given [controller] is not used: the drives of a dry run have their own"
    )
    assert (warning in make_settings(signals, Overrides()).warnings) == told


@pytest.mark.parametrize("of_the_description", [True, False])
def test_frictionless_pendulum_keeps_energy(of_the_description):
    """Plants are stepped at the middle position: from that of the start they
    would gain 5 % in 4 s.
    """
    text = (
        bus_text(1).replace("alpha_deg = 0", "alpha_deg = 90").replace("ratio = 50.0", "ratio = 1")
    )
    text = text.replace("[controller]", "[parameters]\nZZ1 = 1.0\nMX1 = 5.0\n[controller]")
    text = text.replace(
        'type = "revolute"', 'type = "revolute"\nfriction = []\nrotor_inertia = false'
    )
    one, zero, energies = np.ones(1), np.zeros(1), []
    plant = JointwisePlant(
        one, zero, zero, 5.0 * 9.81 * one, slides=np.zeros(1, bool), position=zero
    )
    if of_the_description:
        plant, _ = described_robot(robot_of(text))
    for _ in range(8000):
        plant.step(zero, np.zeros(1, bool), 0.0005)
        (q,), (dq,) = plant.state()
        energies.append(0.5 * dq**2 + 5.0 * 9.81 * np.sin(q))
    assert np.abs(energies).max() < 1e-3 * 5.0 * 9.81


@pytest.mark.parametrize("period_s", [0.0007, 0.003])
def test_plant_period_is_sync_period(period_s):
    """A mass with viscous and dry friction under a constant force F: v = F /
    Fv (1 - exp(-Fv t / M)).
    """
    robot, bus = robot_named("emps"), robot_named("scara").bus
    plant, _ = described_robot(
        replace(robot, bus=msgspec.structs.replace(bus, sync_period_s=period_s))
    )
    M, Fv, Fc, Off = (robot.parameters[name] for name in ("M1", "Fv1", "Fc1", "Off1"))
    periods = round(0.21 / period_s)
    for _ in range(4 * periods):
        plant.step(np.array([50.0 + Fc + Off]), np.zeros(1, bool), period_s / 4)
    _, (speed,) = plant.state()
    assert speed == pytest.approx(50.0 / Fv * (1 - np.exp(-Fv * periods * period_s / M)), rel=2e-3)


def test_given_control_law_moves_robot_as_drives(tmp_path, monkeypatch):
    """The wrist is coupled: the law acts on motors.

    Without it a stand-in PD was 90 mrad off at joint 6.
    """
    monkeypatch.setattr(simulated_cell, "SESSION_S", 2.0)
    robot, out = robot_named("tx40"), tmp_path / "a.mcap"
    record_simulated_session(robot, "robot.toml", out, noise_percent=0.0)
    recording = read_recording(out)
    samples, loop = recording.samples, described_law(recording.robot)
    stamps = {e.text: e.stamp_ns for e in recording.events}
    start = int(np.searchsorted(samples["stamp_ns"], stamps["track"]))
    q_ref, q = (samples[name][start : start + 1000] for name in ("reference", "position"))
    # A target is reached one SYNC after it is applied, the drive being a quarter of it ahead.
    path = CubicSpline(np.arange(len(q)) * 0.002 + 0.0015, q_ref)
    t_s = np.maximum(np.arange(4 * len(q)) * 0.0005, 0.0015)
    base, beta = study_truth(robot)
    model = direct_model(InverseModel(robot), base.standard_parameters(beta))
    reference = Reference(path(t_s), path(t_s, 1), path(t_s, 2))
    moved = simulate(model, loop, reference, start=(q[0], np.zeros(6)), bound=np.full(6, 1.0))
    assert moved.reason is None
    assert np.abs(moved.q[::4] - q)[250:].max() < 1e-3
    assert np.ptp(q, axis=0).min() > 0.1
