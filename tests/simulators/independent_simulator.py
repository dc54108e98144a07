"""Recordings of robots whose truth is known, by a simulator that shares no code with the package.

Many runs go side by side, one row of every array each. In each control period the controller sees
what the encoder gives (noise and counts are fed back), and its command is recorded at its tick and
held for a period, which may begin later than the tick. Between ticks the plant is integrated by
Runge-Kutta of order 4 in `substeps` steps; the inertia matrix and the torques of speed and gravity,
which change far more slowly than friction, are those of the middle of the period.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import msgspec
import numpy as np
from independent_robots import Array, Plant
from scipy.signal import lfilter

from acquisition.robot import Robot, load_robot
from identification.data import Signals

AR = 0.98  # of coloured noise, from sample to sample


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Sums of sines between rest and rest: position, speed, acceleration (S, N, n), the last
    two zero at both ends.
    """

    q: Array
    dq: Array
    ddq: Array


def references(
    plant: Plant,
    seeds: Iterable[int],
    *,
    duration_s: float,
    rate_hz: float,
    highest_hz: float = 1.0,
) -> Reference:
    """One reference for each seed: five sines a joint, faded in and out, up to 80 % of
    the limits of robot.toml.
    """
    t = np.arange(round(duration_s * rate_hz) + 1)[:, None] / rate_hz
    fade_s = 0.15 * duration_s
    x = np.clip(np.minimum(t, duration_s - t) / fade_s, 0.0, 1.0)
    side = np.where(t < duration_s / 2, 1.0, -1.0)
    w = x**3 * (10 - 15 * x + 6 * x**2)
    dw = side * 30 * x**2 * (1 - x) ** 2 / fade_s
    ddw = 60 * x * (1 - x) * (1 - 2 * x) / fade_s**2
    joints, found = plant.description["joint"], []
    for seed in seeds:
        rng = np.random.default_rng([1, seed])
        paths = []
        for joint in joints:
            omega = 2 * np.pi * rng.uniform(0.1, highest_hz, 5)
            size, phase = rng.uniform(0.3, 1.0, 5) / omega, rng.uniform(0, 2 * np.pi, 5)
            s = np.sin(omega * t + phase) @ size
            ds = np.cos(omega * t + phase) @ (size * omega)
            dds = -np.sin(omega * t + phase) @ (size * omega**2)
            s, ds, dds = s[:, None], ds[:, None], dds[:, None]
            path = np.stack([w * s, dw * s + w * ds, ddw * s + 2 * dw * ds + w * dds])[..., 0]
            in_rad = "position_deg" in joint
            low, high = joint["position_deg" if in_rad else "position_m"]
            limits = [(high - low) / 2, joint["speed_deg_s" if in_rad else "speed_m_s"]]
            limits += [joint["acceleration_deg_s2"]] if "acceleration_deg_s2" in joint else []
            per = np.pi / 180 if in_rad else 1.0
            path *= 0.8 * min(
                per * limit / np.abs(part).max() for part, limit in zip(path, limits, strict=False)
            )
            path[0] += per * (low + high) / 2
            paths.append(path)
        found.append(np.stack(paths, axis=-1))
    q, dq, ddq = np.stack(found, axis=1)
    return Reference(q=q, dq=dq, ddq=ddq)


@dataclass(frozen=True, kw_only=True, eq=False)  # a key by itself, not by its arrays
class Controller:
    """A control law as README.md describes it; gains (n,) by motor, `drive_gain` torque
    per unit of its output.
    """

    structure: str
    rate_hz: float
    position_gain: Array
    velocity_gain: Array
    integral_gain: Array
    drive_gain: Array
    saturation: Array
    two_sample_mean: bool = False

    def stiffness(self) -> Array:
        """Torque per position error (n,) at the motors, in the units of the drive's output."""
        return self.position_gain * (
            self.velocity_gain if self.structure.startswith("cascade") else 1.0
        )


def described_controller(plant: Plant) -> Controller:
    """The controller of robot.toml."""
    c, motors = plant.description["controller"], plant.description["motor"]
    return Controller(
        structure=c["structure"],
        rate_hz=c["sample_rate_hz"],
        position_gain=np.array(c["position_gain"]),
        velocity_gain=np.array(c["velocity_gain"]),
        integral_gain=np.array(c.get("integral_gain", [0.0] * plant.n)),
        drive_gain=np.array([m.get("drive_gain", 1.0) for m in motors]),
        saturation=np.array([m.get("saturation", np.inf) for m in motors]),
        two_sample_mean=c.get("velocity_estimate") == "two_sample_mean",
    )


def designed_pd(plant: Plant, bandwidth_hz: float, rate_hz: float) -> Controller:
    """A PD with velocity feed-forward: each joint an oscillator of the bandwidth, damped by
    0.8, at its middle pose.
    """
    pose = np.array([[np.deg2rad(sum(j["position_deg"]) / 2) for j in plant.description["joint"]]])
    J = np.diag(plant.inertia_and_bias(pose, 0 * pose)[0][0])
    w, ratio = 2 * np.pi * bandwidth_hz, np.diag(plant.R)
    return Controller(
        structure="pd_velocity_feedforward",
        rate_hz=rate_hz,
        position_gain=J * w**2 / ratio**2,
        velocity_gain=1.6 * J * w / ratio**2,
        integral_gain=np.zeros(plant.n),
        drive_gain=np.ones(plant.n),
        saturation=np.full(plant.n, np.inf),
    )


def description(robot_toml: Path, controller: Controller | None = None) -> Robot:
    """The package's description of the robot, with this controller in it
    where robot.toml has none.
    """
    robot = load_robot(robot_toml)
    return robot if controller is None else with_controller(robot, controller)


def with_controller(robot: Robot, controller: Controller) -> Robot:
    """The description with this controller in it."""
    integral = tuple(controller.integral_gain.tolist())
    return with_control(
        robot,
        structure=controller.structure,
        sample_rate_hz=controller.rate_hz,
        position_gain=tuple(controller.position_gain.tolist()),
        velocity_gain=tuple(controller.velocity_gain.tolist()),
        integral_gain=integral if any(integral) else None,
        velocity_estimate="two_sample_mean"
        if controller.two_sample_mean
        else "backward_difference",
    )


def with_control(robot: Robot, **changes: object) -> Robot:
    """The description with other values in its `[controller]`."""
    return replace(robot, controller=msgspec.structs.replace(robot.controller, **changes))


def without_control_law(robot: Robot) -> Robot:
    """The description without its control law: of `[controller]` the bandwidth is left."""
    return replace(
        robot, controller=type(robot.controller)(bandwidth_hz=robot.controller.bandwidth_hz)
    )


def without_settings(robot: Robot) -> Robot:
    """The description without `[identification]`: the package's rules hold, not what
    reproduces digits of others.
    """
    return replace(robot, identification=type(robot.identification)())


@dataclass(frozen=True, kw_only=True)
class Imperfections:
    """What a real cell adds. Percent are of each joint's rms torque along its reference.

    encoder_noise, encoder_step: noise and counts of the motor's position over its ratio,
        rad or m at the joint.
    encoder_correlation: of the noise from sample to sample, 0 if white. torque_noise_percent,
    coloured_noise_percent: of the recorded torque, white and AR(0.98). disturbance_percent:
    AR(0.98), of the torque that acts. drift_percent: torque that grows from 0 to this over the run.
    friction_drift, gain_drift: friction, and the record of the torque, grow over the run by this
    part of themselves, about their mean. dragging: friction is this part more for 30 % of the
    run, from that share of it on (`dragging_from`). hysteresis_percent: friction of Dahl that acts,
    over 15 % of each joint's travel.
    recorded: the `command` of the tick, or the `mean` of the torque that acts over the period about
    the tick. lag: samples by which the record of it is late, between two samples on the straight
    line. actuation_delay_s: a command acts this much after its tick.
    """

    encoder_noise: float = 0.0
    encoder_step: float = 0.0
    encoder_correlation: float = 0.0
    torque_noise_percent: float = 0.0
    coloured_noise_percent: float = 0.0
    disturbance_percent: float = 0.0
    drift_percent: float = 0.0
    friction_drift: float = 0.0
    gain_drift: float = 0.0
    dragging: float = 0.0
    dragging_from: float = 0.35
    hysteresis_percent: float = 0.0
    recorded: Literal["command", "mean"] = "command"
    lag: float = 0.0
    actuation_delay_s: float = 0.0

    def lag_s(self, rate_hz: float) -> float:
        """How late the recorded torque is against the one that acts: a command is written down
        before it acts, and held.
        """
        early_s = 0.5 / rate_hz + self.actuation_delay_s if self.recorded == "command" else 0.0
        return self.lag / rate_hz - early_s


@dataclass(frozen=True, kw_only=True)
class Runs:
    """What was recorded of S runs: q, q_ref, effort (S, N, n); and q_true,
    dq_true, which nobody records.
    """

    q: Array
    q_ref: Array
    effort: Array
    q_true: Array
    dq_true: Array
    rate_hz: float
    recorded: Literal["command", "mean"] = "command"

    def signals(self, robot: Robot, run: int, effort_timing: str | None = None) -> Signals:
        """One run as the package's signals; `effort_timing` says what the recording is stamped
        with, by default the truth.
        """
        q, q_ref, effort = (x[run].copy() for x in (self.q, self.q_ref, self.effort))
        t_s = np.arange(len(q)) / self.rate_hz
        return Signals(
            t_s=t_s, q=q, q_ref=q_ref, effort=effort, sample_rate_hz=self.rate_hz, track=None,
            robot=robot,
            recording=f"run {run}", sha256="", effort_timing=cast(Any,
                                                                  effort_timing or self.recorded),
        )  # fmt: skip


def with_lost_rows(signals: Signals, lost: Array) -> Signals:
    """The recording without the samples that are `lost` (N,) bool, closed up as
    if there had been none.
    """
    q, q_ref, effort = (
        None if x is None else x[~lost] for x in (signals.q, signals.q_ref, signals.effort)
    )
    return replace(signals, t_s=signals.t_s[: len(q)], q=q, q_ref=q_ref, effort=effort)


def at_rate(signals: Signals, rate_hz: float) -> Signals:
    """The same samples, said to be of another rate."""
    return replace(signals, t_s=np.arange(len(signals.q)) / rate_hz, sample_rate_hz=rate_hz)


def step(
    plant: Plant, q: Array, v: Array, tau: Array, middle_v: Array, h: float, substeps: int
) -> tuple[Array, Array]:
    """State (S, n) a period h later under the torque tau (S, n), `middle_v` being about the
    speed half a period later.
    """
    M, bias = plant.inertia_and_bias(q + 0.5 * h * v, middle_v)
    inverse, d = np.linalg.inv(M), h / substeps
    free, friction = (inverse @ (tau - bias)[..., None])[..., 0], plant.friction

    def acceleration(v: Array) -> Array:
        if friction.load is not None:
            rigid = friction.left(tau - plant.offset - friction(v), v)
            return (inverse @ (rigid - bias + plant.offset)[..., None])[..., 0]
        return free - (inverse @ friction(v)[..., None])[..., 0]

    for _ in range(substeps):
        a1 = acceleration(v)
        a2 = acceleration(v + 0.5 * d * a1)
        a3 = acceleration(v + 0.5 * d * a2)
        a4 = acceleration(v + d * a3)
        middle = a2 + a3
        q = q + d * v + d**2 / 6 * (a1 + middle)
        v = v + d / 6 * (a1 + middle + middle + a4)
    return q, v


def shifted(x: Array, samples: float) -> Array:
    """x (S, N, n) that many samples later, on the straight line between two; before its
    begin it is its first row.
    """
    at = np.clip(np.arange(x.shape[1]) - samples, 0, x.shape[1] - 1)
    before = np.floor(at).astype(int)
    part = (at - before)[:, None]
    after = np.minimum(before + 1, x.shape[1] - 1)
    return np.where(part > 0, (1 - part) * x[:, before] + part * x[:, after], x[:, before])


def coloured(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """AR(0.98) of deviation 1 along the second axis."""
    white = rng.standard_normal(shape)
    return lfilter(
        [np.sqrt(1 - AR**2)],
        [1.0, -AR],
        white,
        axis=1,
        zi=AR * rng.standard_normal((shape[0], 1, shape[2])),
    )[0]


def simulate(
    plant: Plant,
    controller: Controller,
    reference: Reference,
    cell: Imperfections,
    *,
    seed: int = 0,
    substeps: int = 4,
    feedforward: Array | None = None,
    later: Plant | None = None,
) -> Runs:
    """All runs along their references, from rest where the position loop carries the arm's weight.

    `feedforward` (S, N, n) is added to the controller's output, by motor. `later` is the plant from
    the middle of the run on.
    """
    c, T, rng = controller, 1.0 / controller.rate_hz, np.random.default_rng([2, seed])
    S, N, n = reference.q.shape
    cascade, to_joints = c.structure.startswith("cascade"), plant.R * c.drive_gain[:, None]
    integrates = c.structure in ("cascade_p_pi", "pid")
    speed_share = 1.0 if c.structure in ("pd_velocity_feedforward", "pid") else 0.0
    kp, kd = c.stiffness(), c.velocity_gain
    ki = c.integral_gain * kd if cascade else c.integral_gain
    target, target_speed = reference.q @ plant.R.T, reference.dq @ plant.R.T
    flat = (x.reshape(-1, n) for x in (reference.q, reference.dq, reference.ddq))
    level = (
        np.sqrt(np.mean(plant.inverse(*flat).reshape(S, N, n) ** 2, axis=1, keepdims=True)) / 100
    )
    push = (
        level * cell.disturbance_percent * coloured(rng, (S, N, n))
        if cell.disturbance_percent
        else np.zeros((1, N, 1))
    )
    push = push + level * cell.drift_percent * np.linspace(0, 1, N)[:, None]
    z, travel = np.zeros((S, n)), np.ptp(reference.q, axis=1)

    q, v = reference.q[:, 0].copy(), np.zeros((S, n))
    held = plant.inertia_and_bias(q, v)[1]
    if integrates:
        integral = np.linalg.solve(to_joints.T, held[..., None])[..., 0] / ki
    else:
        q, integral = (
            q - np.linalg.solve(to_joints.T @ (kp[:, None] * plant.R), held[..., None])[..., 0],
            np.zeros((S, n)),
        )
    seen, seen_before, seen_earlier, v_before = q @ plant.R.T, q @ plant.R.T, q @ plant.R.T, v
    measured, commanded, q_true, dq_true = np.empty((4, S, N, n))
    count, rho = cell.encoder_step * np.abs(np.diag(plant.R)), cell.encoder_correlation
    before = rho * np.random.default_rng([3, seed]).standard_normal((1, S, n))
    white = np.sqrt(1 - rho**2) * rng.standard_normal((N, S, n))
    error_of_motor = lfilter([1.0], [1.0, -rho], white, axis=0, zi=before)[0]
    noise = error_of_motor * cell.encoder_noise * np.abs(np.diag(plant.R))
    ahead = kd * speed_share * target_speed + (0.0 if feedforward is None else feedforward)
    # In the part of a period that has begun, the command before the newest still acts.
    periods, begun = divmod(round(cell.actuation_delay_s / T, 9), 1.0)
    body, turn, span = plant, plant.R.T, T * (2 if c.two_sample_mean else 1)
    for k in range(N):
        measured[:, k] = seen = q.dot(turn) + noise[k]
        if cell.encoder_step:
            measured[:, k] = seen = np.round(seen / count) * count
        speed = (seen - (seen_earlier if c.two_sample_mean else seen_before)) / span
        seen_before, seen_earlier = seen, seen_before
        error = target[:, k] - seen
        u = kp * error - kd * speed + ahead[:, k]
        if integrates:
            after = integral + T * (c.position_gain * error - speed if cascade else error)
            u = u + ki * after
            integral = np.where(np.abs(u) > c.saturation, integral, after)  # no wind-up
        tau = np.minimum(np.maximum(u, -c.saturation), c.saturation).dot(to_joints)
        commanded[:, k], q_true[:, k], dq_true[:, k] = tau, q, v
        if later is not None and k == N // 2:
            body = later
        if cell.friction_drift or cell.dragging:
            drags = cell.dragging_from < k / N < cell.dragging_from + 0.3
            more = cell.dragging * drags + cell.friction_drift * (k / N - 0.5)
            body = replace(body, friction=plant.friction.times(1 + more))
        if cell.hysteresis_percent:
            way = v * T / (0.15 * travel)
            z = z + way - np.abs(way) * z
            push[:, k] -= level[:, 0] * cell.hysteresis_percent * z
        acceleration, v_before, newest = (v - v_before) / T, v, k - int(periods)
        for part, from_tick in ((begun, newest - 1), (1 - begun, newest)):
            if part:
                tau, h, steps = (
                    commanded[:, max(0, from_tick)] + push[:, k],
                    part * T,
                    math.ceil(part * substeps),
                )
                q, v = step(body, q, v, tau, v + 0.5 * h * acceleration, h, steps)
    recorded = commanded
    # of a torque that is held: half a period and the delay after the command
    if cell.recorded == "mean":
        recorded = shifted(recorded, 0.5 + cell.actuation_delay_s / T)
    recorded = shifted(recorded, cell.lag)
    recorded = recorded * (1 + cell.gain_drift * np.linspace(-0.5, 0.5, N)[:, None])
    recorded = recorded + level * cell.torque_noise_percent * rng.standard_normal((S, N, n))
    if cell.coloured_noise_percent:
        recorded = recorded + level * cell.coloured_noise_percent * coloured(rng, (S, N, n))
    return Runs(
        q=measured @ np.linalg.inv(plant.R).T, q_ref=reference.q, effort=recorded,
        q_true=q_true, dq_true=dq_true, rate_hz=c.rate_hz, recorded=cell.recorded,
    )  # fmt: skip
