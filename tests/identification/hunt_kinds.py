"""The 41 kinds of fault of the hunt: what of a sound cell, recording or description is wrong, and
which test should say so.

A set-up is a robot in its cell, how it is recorded, and the description that a fit is given. A
kind changes a sound one.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache

import msgspec
import numpy as np
from conftest import REPLAY
from independent_robots import Plant, plant, with_payload
from independent_simulator import (
    Controller,
    Imperfections,
    Runs,
    at_rate,
    described_controller,
    description,
    designed_pd,
    references,
    simulate,
    with_control,
    with_controller,
    with_lost_rows,
    without_control_law,
    without_settings,
)
from independent_urdf import arm_of, robot_of
from urdfs import SEVEN, serial

from acquisition.robot import Robot
from identification.data import Signals

Array = np.ndarray
Rng = np.random.Generator
# a small noise of the position, m or rad
UNIT = {"emps": 1e-6, "scara": 1e-5, "tx40": 1e-5, "seven": 1e-5}
SMOOTH = 0.005  # v0 of friction in parts of the speed limit


@dataclass(frozen=True, kw_only=True)
class SetUp:
    """What is simulated, and what the fit is told: `robot`, and `timing` as the
    recording's `effort_timing`.

    later: the plant from the middle on. held: a joint whose reference does not move. saturated:
    share of the peak effort at which the drives saturate, None if they do not. changes: made of the
    recording, one after the other.
    """

    name: str
    body: Plant
    controller: Controller
    cell: Imperfections
    robot: Robot
    timing: str | None
    later: Plant | None = None
    held: int | None = None
    saturated: float | None = None
    duration_s: float = 10.0
    highest_hz: float = 1.0
    substeps: int = 4
    changes: tuple[Callable[[Signals], Signals], ...] = ()

    def changed(self, change: Callable[[Signals], Signals]) -> "SetUp":
        """With one more change of the recording."""
        return replace(self, changes=(*self.changes, change))

    def in_cell(self, **changes: object) -> "SetUp":
        """With other imperfections."""
        return replace(self, cell=replace(self.cell, **changes))

    def with_friction(self, **changes: float) -> "SetUp":
        """With another friction than is described."""
        return replace(
            self, body=replace(self.body, friction=replace(self.body.friction, **changes))
        )

    def recording(self, seed: int) -> Signals:
        """Simulated, recorded, and changed."""
        runs = simulated(
            self.body,
            self.controller,
            self.cell,
            self.later,
            self.held,
            self.saturated,
            self.duration_s,
            self.highest_hz,
            self.substeps,
            seed,
        )
        signals = runs.signals(self.robot, 0, self.timing)
        for change in self.changes:
            signals = change(signals)
        return signals


@lru_cache(maxsize=16)
def simulated(
    body: Plant,
    controller: Controller,
    cell: Imperfections,
    later: Plant | None,
    held: int | None,
    saturated: float | None,
    duration_s: float,
    highest_hz: float,
    substeps: int,
    seed: int,
) -> Runs:
    """One run of a set-up, made once: kinds that change the recording share it."""
    path = references(
        body,
        range(seed, seed + 1),
        duration_s=duration_s,
        rate_hz=controller.rate_hz,
        highest_hz=highest_hz,
    )
    if held is not None:
        moves = np.arange(body.n) != held
        start = np.where(moves, 0.0, path.q[:, :1])
        path = replace(path, q=path.q * moves + start, dq=path.dq * moves, ddq=path.ddq * moves)
    if saturated is not None:
        torque = body.inverse(path.q[0], path.dq[0], path.ddq[0])
        effort = np.linalg.solve(body.R.T, torque.T).T / controller.drive_gain
        controller = replace(controller, saturation=saturated * np.abs(effort).max(axis=0))
    return simulate(body, controller, path, cell, seed=seed, substeps=substeps, later=later)


def sound(name: str, rng: Rng) -> SetUp:
    """A clean cell: small noise of the position, one or two percent of noise of the torque,
    a third of it coloured.

    Half the recordings do not state what instants their efforts belong to.
    """
    body, law, robot = cell_of(name)
    noise = "coloured_noise_percent" if rng.random() < 1 / 3 else "torque_noise_percent"
    return SetUp(
        name=name,
        body=body,
        controller=law,
        cell=Imperfections(
            encoder_noise=UNIT[name] * rng.uniform(0.5, 3.0), **{noise: rng.uniform(1.0, 2.0)}
        ),
        robot=robot,
        timing="unknown" if rng.random() < 1 / 2 else "command",
    )


def white(name: str) -> SetUp:
    """A clean cell whose noise of the torque is white, and that holds its efforts."""
    cell = Imperfections(encoder_noise=1e-6 if name == "emps" else 1e-5, torque_noise_percent=2.0)
    return replace(
        sound(name, np.random.default_rng(1)),
        cell=cell, timing="command", duration_s=7.0, substeps=1,
    )  # fmt: skip


@cache
def cell_of(name: str) -> tuple[Plant, Controller, Robot]:
    """A robot, its controller, and its description: a shipped one, or seven joints of a URDF."""
    if name == "seven":
        text = serial(SEVEN)
        body, law = arm_of(text)
        return body, law, with_controller(robot_of(text, [link[0] for link in SEVEN]), law)
    toml = REPLAY / name / "robot.toml"
    body = plant(toml, smooth=SMOOTH)
    described = "structure" in body.description["controller"]
    law = described_controller(body) if described else designed_pd(body, 10.0, 500.0)
    return body, law, without_settings(description(toml, None if described else law))


def off(rng: Rng, low: float, high: float) -> float:
    """A factor that is off one by so many percent, upwards or downwards."""
    return float(1 + rng.choice([-1, 1]) * rng.uniform(low, high) / 100)


def of_a_joint(s: SetUp, rng: Rng, factor: float) -> Array:
    """Factors (n,): that one for one joint, one for the others."""
    return np.where(np.arange(s.body.n) == rng.integers(s.body.n), factor, 1.0)


def times_effort(factor: Array) -> Callable[[Signals], Signals]:
    return lambda signals: replace(signals, effort=factor * signals.effort)


def drive_gain(s: SetUp, rng: Rng) -> SetUp:
    """Described wrong: the record is right in the drive's own unit."""
    factor = of_a_joint(s, rng, off(rng, 5, 50))
    gains = s.robot.gain * factor
    units = [m.drive_gain_unit or "N m/V" for m in s.robot.motors]
    motors = tuple(
        msgspec.structs.replace(
            motor, effort_unit=None, drive_gain=float(gain), drive_gain_unit=unit
        )
        for motor, gain, unit in zip(s.robot.motors, gains, units, strict=True)
    )
    return replace(s, robot=replace(s.robot, motors=motors)).changed(times_effort(factor))


def sign(s: SetUp, rng: Rng) -> SetUp:
    factor = of_a_joint(s, rng, -1.0) if rng.random() < 1 / 2 else -np.ones(s.body.n)
    return s.changed(times_effort(factor))


def two_signs(s: SetUp, rng: Rng) -> SetUp:
    """Of two motors, each of its effort or of its position."""
    motors = rng.choice(s.body.n, 2, replace=False)
    of_effort, of_position = np.ones((2, s.body.n))
    for motor in motors:
        (of_effort if rng.random() < 1 / 2 else of_position)[motor] = -1.0
    turn = np.linalg.solve(s.robot.R, of_position[:, None] * s.robot.R).T

    def turned(signals: Signals) -> Signals:
        return replace(signals, q=signals.q @ turn, q_ref=signals.q_ref @ turn)

    return s.changed(of_motors(lambda efforts: of_effort * efforts)).changed(turned)


def of_motors(change: Callable[[Array], Array]) -> Callable[[Signals], Signals]:
    """A change of the motors' efforts (N, n), in their recorded units."""

    def changed(signals: Signals) -> Signals:
        robot = signals.robot
        return replace(
            signals, effort=robot.joint_effort(change(robot.motor_effort(signals.effort)))
        )

    return changed


def exchanged(s: SetUp, rng: Rng) -> SetUp:
    """The efforts of two motors."""
    i, j = rng.choice(s.body.n, 2, replace=False)
    order = np.arange(s.body.n)
    order[[i, j]] = j, i
    return s.changed(of_motors(lambda efforts: efforts[:, order]))


def sign_of_wrist(s: SetUp, rng: Rng) -> SetUp:
    """Of one of the two motors that are coupled."""
    factor = np.where(np.arange(s.body.n) == rng.integers(s.body.n - 2, s.body.n), -1.0, 1.0)
    return s.changed(of_motors(lambda efforts: factor * efforts))


def late(s: SetUp, rng: Rng) -> SetUp:
    """By half samples; a command, or a mean where nothing is stated."""
    mean = s.timing != "command" and rng.random() < 1 / 2
    return s.in_cell(lag=rng.integers(2, 11) / 2, recorded="mean" if mean else "command")


def ratio_of_one(s: SetUp, rng: Rng) -> SetUp:
    """Of the elbow, or of one of the first three joints: the forearm that joint 4 of the TX40 turns
    takes so little torque that its ratio is hardly in it.
    """
    factor = np.ones(s.body.n)
    factor[1 if s.name == "scara" else rng.integers(3)] = off(rng, 5, 10)
    return ratio(s, rng, factor)


def ratio(s: SetUp, rng: Rng, factor: Array | None = None) -> SetUp:
    """Positions, reference and efforts were turned into those of joints by the wrong ratio."""
    factor = of_a_joint(s, rng, off(rng, 2, 30)) if factor is None else factor
    R = s.robot.R * factor[:, None]
    motors = tuple(
        msgspec.structs.replace(m, ratio=float(R[j, j])) for j, m in enumerate(s.robot.motors)
    )

    def change(signals: Signals) -> Signals:
        q_ref = signals.q_ref / factor
        return replace(signals, q=signals.q / factor, q_ref=q_ref, effort=signals.effort * factor)

    return replace(s, robot=replace(s.robot, R=R, motors=motors)).changed(change)


def cogging(s: SetUp, rng: Rng) -> SetUp:
    """10 to 50 % of the Coulomb friction; pitches of 2 to 10 mm, or 12 to 36 a turn."""
    pitch = rng.uniform(2e-3, 1e-2) if s.name == "emps" else 2 * np.pi / rng.integers(12, 37)
    amplitude = rng.uniform(0.1, 0.5) * s.body.friction.coulomb
    return replace(s, body=replace(s.body, cogging=amplitude, pitch=np.full(s.body.n, pitch)))


def controller_gains(s: SetUp, rng: Rng) -> SetUp:
    """Described wrong, one kind of gain or both, by at least a quarter."""
    factor = rng.uniform(1.25, 2.0) ** rng.choice([-1, 1])
    names = (("position_gain",), ("velocity_gain",), ("position_gain", "velocity_gain"))[
        rng.integers(3)
    ]
    changes = {name: tuple(factor * x for x in getattr(s.robot.controller, name)) for name in names}
    return replace(s, robot=with_control(s.robot, **changes))


def undescribed_integral(s: SetUp, rng: Rng) -> SetUp:
    cascade = s.controller.structure == "cascade_p_p"
    integral = (
        rng.uniform(5.0, 20.0) * np.ones(s.body.n)
        if cascade
        else rng.uniform(2, 5) * s.controller.position_gain
    )
    structure = "cascade_p_pi" if cascade else "pid"
    return replace(s, controller=replace(s.controller, structure=structure, integral_gain=integral))


def lost_rows(s: SetUp, rng: Rng) -> SetUp:
    part = rng.uniform(0.002, 0.02)
    return s.changed(lambda signals: with_lost_rows(signals, rng.random(len(signals.q)) < part))


def twelve_bits(s: SetUp, rng: Rng) -> SetUp:
    low, high = s.robot.joints[0].si("position")
    return s.in_cell(encoder_noise=0.0, encoder_step=(high - low) / 4096)


def payload_midway(s: SetUp, rng: Rng) -> SetUp:
    """The axis carries more; or the forearm carries at half its length what adds to its inertia."""
    part, body = (
        rng.uniform(0.1, 0.4),
        plant(REPLAY / s.name / "robot.toml", smooth=SMOOTH, closed_form=False),
    )
    if s.name == "emps":
        return replace(s, later=with_payload(body, part * s.robot.parameters["M1"]))
    return replace(
        s, later=with_payload(body, part * s.robot.parameters["ZZ2"] / 0.25**2, (0.25, 0.0, 0.0))
    )


def without_reference(s: SetUp) -> SetUp:
    return s.changed(lambda signals: replace(signals, q_ref=None))


def without_law(s: SetUp) -> SetUp:
    return replace(s, robot=without_control_law(s.robot))


def length(s: SetUp, rng: Rng) -> SetUp:
    *others, last = s.robot.joints
    dh = msgspec.structs.replace(last.dh, d_m=last.dh.d_m * off(rng, 1, 6))
    return replace(
        s, robot=replace(s.robot, joints=(*others, msgspec.structs.replace(last, dh=dh)))
    )


def held(s: SetUp, rng: Rng) -> SetUp:
    """By its loop, or in half the set-ups by a brake, which here is a rotor too heavy to move."""
    joint, rotor = int(rng.integers(s.body.n)), s.body.rotor.copy()
    if rng.random() < 1 / 2:
        rotor[joint, joint] += 1e6
    return replace(s, held=joint, body=replace(s.body, rotor=rotor))


def quarter_turn(s: SetUp, rng: Rng) -> SetUp:
    """Position and reference of one of the joints 2 to 4 are off by 90 degrees."""
    turn = rng.choice([-1, 1]) * (np.arange(s.body.n) == rng.integers(1, 4))
    off_by = np.deg2rad(90.0) * turn
    return s.changed(
        lambda signals: replace(signals, q=signals.q + off_by, q_ref=signals.q_ref + off_by)
    )


def links_subtracted(s: SetUp, rng: Rng) -> SetUp:
    """The efforts of a topic of external torques: without what the links take along the
    reference.
    """

    def left(signals: Signals) -> Signals:
        q, period_s = signals.q_ref, 1 / signals.sample_rate_hz
        dq = np.gradient(q, period_s, axis=0)
        M, bias = s.body.rigid(q, dq)
        taken = (M @ np.gradient(dq, period_s, axis=0)[..., None])[..., 0] + bias
        return replace(signals, effort=signals.effort - taken)

    return s.changed(left)


def denied_rotor(s: SetUp, rng: Rng) -> SetUp:
    """Of the elbow, 30 % of its inertia: `rotor_inertia = false`."""
    rotor = s.body.rotor.copy()
    rotor[1, 1] += 0.3 * s.robot.parameters["ZZ2"]
    return replace(s, body=replace(s.body, rotor=rotor))


def zero_of_joint(s: SetUp, rng: Rng) -> SetUp:
    """The elbow's position and reference are off by 2 degrees."""
    off_by = np.deg2rad(2.0) * rng.choice([-1, 1]) * (np.arange(s.body.n) == 1)
    return s.changed(
        lambda signals: replace(signals, q=signals.q + off_by, q_ref=signals.q_ref + off_by)
    )


def clocks_apart(s: SetUp, rng: Rng) -> SetUp:
    """Efforts are sampled on a clock 0.1 % off."""
    rate = 1 + 1e-3 * rng.choice([-1, 1])
    return s.changed(lambda signals: replace(signals, effort=at_clock(signals.effort, rate)))


def at_clock(x: Array, rate: float) -> Array:
    """Samples x (N, n) at instants that run `rate` times as fast, both at one in the middle."""
    k = np.arange(len(x))
    at = (k - k.mean()) * rate + k.mean()
    return np.stack([np.interp(at, k, column) for column in x.T], axis=1)


BOTH = ("emps", "scara")
WITH_PRIOR = ("tx40", "seven")  # of links: the SCARA's [parameters] are sums
ASSUMED = "assumed"  # named as what no test can tell
CORRECTED = "corrected"  # in a line of any level: the fault was found, and cured
LATE = (("delay", ""), ("delay", CORRECTED))


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A fault. named: of the tests that may say so, name and a part of the text, "" for
    any; empty where none can.

    unseen: robots on which no test can see it, as nothing recorded contradicts what was described.
    """

    change: Callable[[SetUp, Rng], SetUp]
    named: tuple[tuple[str, str], ...] = ()
    robots: tuple[str, ...] = BOTH
    unseen: tuple[str, ...] = field(default=())


CLEAN = Kind(change=lambda s, rng: s)
KINDS = {
    "gain of the record ±5-50 %": Kind(
        change=lambda s, rng: s.changed(times_effort(of_a_joint(s, rng, off(rng, 5, 50)))),
        named=(("control law", ""),),
    ),
    "described drive gain ±5-50 %": Kind(
        change=drive_gain, named=(("missing terms", "gain"),), unseen=("emps",)
    ),
    "sign": Kind(
        change=sign,
        named=(
            ("physical plausibility", "sign"),
            ("control law", "sign"),
            ("signs and order", "sign"),
        ),
    ),
    "two wrong signs": Kind(
        change=two_signs,
        named=(
            ("physical plausibility", "sign"),
            ("control law", "sign"),
            ("signs and order", "sign"),
        ),
        robots=("scara", "tx40"),
    ),
    "efforts of two motors exchanged": Kind(
        change=exchanged, named=(("signs and order", "are swapped"),), robots=("scara", "tx40")
    ),
    "sign of a coupled motor": Kind(
        change=sign_of_wrist, named=(("signs and order", "wrong sign"),), robots=("tx40",)
    ),
    "radians declared as degrees": Kind(
        change=lambda s, rng: s.changed(
            lambda x: replace(x, q=np.radians(x.q), q_ref=np.radians(x.q_ref))
        ),
        named=(("positions", "radians"),),
        robots=("scara",),
    ),
    "torque 1-5 samples late": Kind(change=late, named=LATE),
    "mean said to be held": Kind(
        change=lambda s, rng: replace(s.in_cell(recorded="mean"), timing="command"), named=LATE
    ),
    "described ratio ±2-30 %": Kind(change=ratio, unseen=BOTH),
    "saturated at 50-90 %": Kind(
        change=lambda s, rng: replace(s, saturated=rng.uniform(0.5, 0.9)),
        named=(("", "saturates"),),
    ),
    "asymmetric friction 20-50 %": Kind(
        change=lambda s, rng: s.with_friction(asymmetry=rng.uniform(0.2, 0.5)),
        named=(("missing terms", "asymmetric"),),
    ),
    "Stribeck 50 %": Kind(
        change=lambda s, rng: s.with_friction(stribeck=0.5), named=(("missing terms", "Stribeck"),)
    ),
    "cogging": Kind(change=cogging),
    "friction drifts 20-40 %": Kind(
        change=lambda s, rng: s.in_cell(friction_drift=rng.choice([-1, 1]) * rng.uniform(0.2, 0.4)),
        named=(("first against second half", ""), ("missing terms", "drift")),
    ),
    "rate 1 %": Kind(
        change=lambda s, rng: s.changed(
            lambda signals: at_rate(signals, signals.sample_rate_hz * off(rng, 1, 1))
        ),
        named=(("control law", ""),),
        unseen=BOTH,
    ),
    "controller gains × 0.5-2": Kind(change=controller_gains, named=(("control law", ""),)),
    "PI said to be P": Kind(change=undescribed_integral, named=(("control law", ""),)),
    "0.2-2 % of rows lost": Kind(change=lost_rows, named=(("rows", "missing"),)),
    "12 bit over the range": Kind(change=twelve_bits),
    "slow motion": Kind(change=lambda s, rng: replace(s, highest_hz=rng.uniform(0.12, 0.25))),
    "2 s": Kind(change=lambda s, rng: replace(s, duration_s=2.0)),
    "payload midway 10-40 %": Kind(
        change=payload_midway, named=(("first against second half", ""),)
    ),
    "no reference": Kind(change=lambda s, rng: without_reference(s)),
    "no controller": Kind(change=lambda s, rng: without_law(s)),
    "late, no reference": Kind(
        change=lambda s, rng: without_reference(late(s, rng)), named=(*LATE, (ASSUMED, "delay"))
    ),
    "late, no controller": Kind(change=lambda s, rng: without_law(late(s, rng)), named=LATE),
    "tilt 1-5°": Kind(
        change=lambda s, rng: replace(
            s,
            body=plant(
                REPLAY / s.name / "robot.toml",
                smooth=SMOOTH,
                tilt_rad=np.deg2rad(rng.uniform(1, 5)),
            ),
        ),
        named=(("missing terms", "tilt"),),
        robots=("scara",),
    ),
    "DH length 1-6 %": Kind(change=length, robots=("scara",), unseen=("scara",)),
    "one joint held": Kind(change=held, robots=("scara",)),
    "delay 1-3 ticks behind the command": Kind(
        change=lambda s, rng: s.in_cell(
            actuation_delay_s=rng.uniform(1.0, 3.0) / s.controller.rate_hz
        ),
        named=LATE,
    ),
    "rotor denied": Kind(
        change=denied_rotor, named=(("missing terms", "rotor"),), robots=("scara",)
    ),
    "zero of a joint 2°": Kind(
        change=zero_of_joint,
        named=((ASSUMED, "joint zeros"),),
        robots=("scara",),
        unseen=("scara",),
    ),
    "joint off by 90 degrees": Kind(
        change=quarter_turn, named=(("a priori links", "is wrong by"),), robots=WITH_PRIOR
    ),
    "links subtracted": Kind(
        change=links_subtracted,
        named=(("a priori links", "lack the links"),),
        robots=WITH_PRIOR,
    ),
    "torque constant drifts 3-10 %": Kind(
        change=lambda s, rng: s.in_cell(gain_drift=rng.choice([-1, 1]) * rng.uniform(0.03, 0.1)),
        named=(("missing terms", "torque constant"),),
    ),
    "hysteresis 10-20 %": Kind(
        change=lambda s, rng: s.in_cell(hysteresis_percent=rng.uniform(10, 20)),
        named=(("missing terms", "hysteresis"),),
    ),
    "brake drags for 30 % of the time": Kind(
        change=lambda s, rng: s.in_cell(
            dragging=rng.uniform(0.5, 1.5), dragging_from=rng.uniform(0.0, 0.7)
        ),
        named=(("missing terms", "of the time"), ("first against second half", "")),
    ),
    "ratio of one joint 5-10 %": Kind(
        change=ratio_of_one, named=(("missing terms", "ratio"),), robots=("scara", "tx40")
    ),
    "ratio of joint 4 5-10 %": Kind(
        change=lambda s, rng: ratio(s, rng, np.where(np.arange(6) == 3, off(rng, 5, 10), 1.0)),
        named=(("missing terms", "ratio"),),
        robots=("tx40",),
        unseen=("tx40",),
    ),
    "clocks 0.1 % apart": Kind(change=clocks_apart, named=(("missing terms", "clock"),)),
}
