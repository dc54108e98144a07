"""Recordings of a simulated robot whose parameters are known, those of `[parameters]`.

It tracks a random exciting reference with the described controller, or else with a PD
of the given bandwidth. All is computed span by span, as hours of motion do not fit in memory.

Or simulated CiA 402 drives on an in-process CAN bus move it in simulated time, as in the demo. This
is the only place where `identification` gives an object to `acquisition`: the plant that the drives
move.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from acquisition.bus import Master
from acquisition.errors import Location
from acquisition.files import BLOCK_ROWS, allocate, atomic_write, by_rows
from acquisition.recording import OPTIONAL, Header, RecordingWriter
from acquisition.robot import (
    FourierReference,
    Payload,
    Robot,
    fourier_reference,
    resolve,
    robot_from_files,
)
from acquisition.session import InlineLog, Recorder, Stop, Task, run_active
from acquisition.simulated import (
    SUBSTEPS,
    DrivenPlant,
    LockStepLink,
    SimulatedDrives,
    describe_loops,
)

from .. import model as dynamics
from ..arrays import Array
from ..control import Reference, default_law, described_law
from ..data import Signals
from ..errors import NoFitError
from ..options import CellOptions
from ..regression import differentiate
from ..simulation import ClosedLoop, RigidBodyPlant, drive_loops

PERIOD_S = 10.0  # of the reference, about; a very long period would be slow and excite little
# of a simulated recording; a day at 1 kHz has fewer, and takes an hour: more are a mistake
MIN_SAMPLES, MAX_SAMPLES = 100, 10**8
# of the plant per controller period; with more, motion and torque change by less than 0.1 %
PLANT_STEPS = 2
AR = 0.98  # autocorrelation of coloured noise at lag 1
# Separate random streams: one kind of noise does not change another.
_POSITION, _EFFORT, _COLOURED = range(3)
# A recursion over rows: `scipy.signal`, which has it, takes longer to import than all the rest.
_SLOW = np.frompyfunc(lambda before, white: AR * before + white, 2, 1)

SESSION_S, SESSION_SEED = 12.0, 1  # of the session; of reference and noise
CATALOGUE = (0.32, 0.32, 0.40, 0.33, 0.30, 0.32)  # gains by motor, N m/A
TRUE_FACTORS = (1.25, 0.88, 1.40, 0.70, 1.15, 0.80)  # of the simulated drives
RATED_NM_PER_A = 0.3  # of all motors, to make rated currents
PAYLOAD = Payload(2.0, (0.03, 0.02, 0.08))


class Noise(CellOptions):
    """Noise of a simulated recording; none by default.

    The controller sees the position with encoder steps and noise. The recorded torque is the mean
    of the control periods before and after its instant, as after the filter of a drive.
    """

    @property
    def text(self) -> str:
        """The noise in words."""
        return (
            ", ".join(f"{name} {value:g}" for name, value in vars(self).items() if value)
            or "no noise"
        )

    def seen(self, drawn: Array, q: Array, at: int | slice = slice(None)) -> Array:
        """Return the positions that the encoder reads.

        Parameters
        ----------
        drawn : noise of all samples, shape (N, n), rad or m.
        q : positions, shape (N, n), or (n,) at one instant, rad or m.
        at : rows of `drawn` for `q`.
        """
        q, step = q + drawn[at], self.encoder_step
        return np.asarray(np.rint(q / step) * step) if step else q

    def on_effort(self, held: Array, seed: int) -> Array:
        """Return the recorded torques.

        Parameters
        ----------
        held : torques of the controller, shape (N, n), N m or N, held from sample to sample.
        seed : seed of the noise.

        Returns
        -------
        Recorded torques, shape (N, n), N m or N.
        """
        rows, last = np.arange(len(held)), np.zeros((1, held.shape[1]))
        streams = [np.random.default_rng([seed, k]) for k in (_EFFORT, _COLOURED)]
        tau = by_rows(
            lambda rows: (
                0.5 * sum(held[np.maximum(rows - self.lag_samples - k, 0)] for k in (0, 1))
            ),
            rows,
        )
        level = 0.01 * np.sqrt(np.mean(np.square(tau, out=allocate(tau.shape, many=8)), axis=0))

        def noisy(tau: Array, scale: Array) -> Array:
            white, slow = (rng.standard_normal(tau.shape) for rng in streams)
            slow = _SLOW.accumulate(np.r_[last, scale * slow], dtype=object).astype(float)[1:]
            last[:] = slow[-1:]
            return np.asarray(
                tau + level * (self.effort_percent * white + self.coloured_percent * slow)
            )

        return by_rows(noisy, tau, np.where(rows > 0, np.sqrt(1 - AR**2), 1.0)[:, None])


def study_truth(robot: Robot) -> tuple[dynamics.BaseParameters, Array]:
    """Return the base parameters of the robot and their true values in a study.

    Parameters
    ----------
    robot : the robot, with `[parameters]`.

    Returns
    -------
    The base parameters, and their values, shape (b,), in SI units.

    Raises
    ------
    BadInputError : the description has no `[parameters]`, or the robot cannot be modelled.
    """
    idm = dynamics.InverseModel(robot)
    base = dynamics.base_parameters(idm)
    return base, dynamics.described_parameters(idm, base)


def true_model(robot: Robot, payload: Payload | None = None) -> dynamics.DirectModel:
    """Return the direct model with the values of the description, and a payload."""
    idm = dynamics.InverseModel(robot)
    base, chi = dynamics.base_parameters(idm), dynamics.known_parameters(idm)
    if payload is not None:
        chi = dynamics.add_payload(idm, chi, payload)
    return dynamics.direct_model(idm, base.standard_parameters(base.K @ chi))


def periodic_reference(
    robot: Robot, *, duration_s: float, seed: int, period_s: float = PERIOD_S
) -> FourierReference:
    """Return a random exciting reference of whole periods, each of about `period_s`.

    The robot is at rest after `duration_s`.
    """
    return fourier_reference(
        robot, period_s=duration_s / max(1, round(duration_s / period_s)), seed=seed
    )


def random_reference(
    robot: Robot, *, duration_s: float, sample_rate_hz: float, seed: int, period_s: float = PERIOD_S
) -> Array:
    """Return a random exciting reference, at rest at both ends.

    It is a Fourier series within the limits of the robot. The length is a whole number of periods,
    one if it is shorter.

    Parameters
    ----------
    robot : the robot; each joint needs a position range.
    duration_s : length, s.
    sample_rate_hz : sample rate, Hz.
    seed : seed; the same one gives the same reference.
    period_s : approximate period, s.

    Returns
    -------
    Reference positions, shape (N, n), rad or m.

    Raises
    ------
    BadInputError : a joint has no range, or the reference has fewer than 100 or more than 10⁸
        samples.
    """
    samples = duration_s * sample_rate_hz
    Location("").require(
        MIN_SAMPLES <= samples <= MAX_SAMPLES,
        text=f"{duration_s:g} s at {sample_rate_hz:g} Hz are {samples:g} samples",
        expected=f"{MIN_SAMPLES} to {MAX_SAMPLES}",
    )
    reference = periodic_reference(robot, duration_s=duration_s, seed=seed, period_s=period_s)
    return by_rows(
        lambda rows: reference.at(rows / sample_rate_hz)[0], np.arange(round(samples) + 1)
    )


def closed_loop(
    robot: Robot,
    q_ref: Array,
    sample_rate_hz: float,
    *,
    noise: Noise,
    seed: int,
    payload: Payload | None = None,
) -> Signals:
    """Simulate the robot of `[parameters]` in closed loop along a reference.

    Parameters
    ----------
    robot : the robot, with `[parameters]`.
    q_ref : reference positions, shape (N, n), rad or m.
    sample_rate_hz : sample rate of reference, recording and controller, Hz.
    noise : noise of the measurements; the controller sees that of the encoder.
    seed : seed of the noise.
    payload : payload of the robot; None for no payload.

    Returns
    -------
    The signals.

    Raises
    ------
    BadInputError : the description has no `[parameters]`, an incomplete controller, neither a
        controller nor a bandwidth, or a controller of another rate.
    NoFitError : the robot does not follow the reference.
    """
    model, loop = true_model(robot, payload), described_law(robot)
    if loop is None:
        loop = default_law(
            robot.bandwidth_hz,
            dynamics.inertias(model.inertia(dynamics.poses_of(q_ref))),
            sample_rate_hz,
        )
        if noise.position or noise.encoder_step:  # the PD estimates the speed
            loop = replace(loop, velocity_estimate="backward_difference")
    Location(f"robot {robot.name}").require(
        abs(loop.period_s * sample_rate_hz - 1) <= 1e-9,
        text=f"its controller runs at {1 / loop.period_s:g} Hz, but the recording is simulated at "
        f"{sample_rate_hz:g} Hz",
        advice="Use the rate of the controller",
        arguments=("sample_rate_hz",),
    )
    fastest = np.max(
        [
            np.abs(dq @ model.directions.T).max(axis=0, initial=0.0)
            for _, dq, _ in _spans(q_ref, sample_rate_hz)
        ],
        axis=0,
    )
    start, rng = differentiate(q_ref[:2], sample_rate_hz), np.random.default_rng([seed, _POSITION])
    follower = ClosedLoop(model, loop, (q_ref[0], start[0]), fastest=fastest, substeps=PLANT_STEPS)
    bound = np.full(robot.n, 10 * np.ptp(q_ref, axis=0).max())
    seen, held = (allocate(q_ref.shape, many=8) for _ in range(2))
    for rows, dq, ddq in _spans(q_ref, sample_rate_hz):
        encoder = partial(noise.seen, noise.position * rng.standard_normal(dq.shape))
        done, reason = follower.follow(Reference(q_ref[rows], dq, ddq, seen=encoder), bound)
        if reason:
            raise NoFitError(f"robot {robot.name} cannot be simulated: {reason}")
        seen[rows], held[rows] = encoder(done[0, ::PLANT_STEPS]), done[3, ::PLANT_STEPS]
    return Signals(
        t_s=np.arange(len(q_ref)) / sample_rate_hz,
        q=seen,
        q_ref=q_ref,
        effort=noise.on_effort(held, seed),
        sample_rate_hz=sample_rate_hz,
        robot=robot,
        recording="simulated",
        payload=payload,
        effort_timing="mean",
    )


def _spans(q: Array, rate_hz: float) -> Iterator[tuple[slice, Array, Array]]:
    """Yield rows, speeds and accelerations of parts of a motion q (N, n)."""
    for first in range(0, len(q), BLOCK_ROWS):
        rows, before = slice(first, min(first + BLOCK_ROWS, len(q))), min(first, 2)
        dq = differentiate(q[first - before : rows.stop + 2], rate_hz)
        own = slice(before, before + rows.stop - first)
        yield rows, dq[own], differentiate(dq, rate_hz)[own]


def write_signals(path: Path, signals: Signals, *, source: str, noise: Noise | None = None) -> None:
    """Write simulated signals as a recording, completely or not at all.

    Parameters
    ----------
    path : MCAP file to write.
    signals : the signals.
    source : text on how they were made, for the metadata.
    noise : noise of the simulation, for the metadata; None if there is none to be named.

    Raises
    ------
    BadInputError : the file cannot be written.
    """
    provenance, notes = "simulated joint torque", {"simulated": "true"}
    if noise is not None:
        provenance, notes["cell"] = (
            f"{provenance}, the mean of the control periods before and after",
            noise.text,
        )
    given = {
        "position": signals.q,
        "effort": signals.effort,
        "reference": signals.q_ref,
        **{name: getattr(signals, name) for name in OPTIONAL},
    }
    header = Header(
        robot=signals.robot,
        source=source,
        sample_rate_hz=signals.sample_rate_hz,
        effort_provenance=provenance,
        effort_timing=signals.effort_timing,
        payload=signals.payload,
        notes=notes,
    )
    with atomic_write(path) as partial, RecordingWriter(partial, header) as writer:
        writer.columns(
            np.round(signals.t_s * 1e9),
            {name: values for name, values in given.items() if values is not None},
        )


def record_simulated_session(
    robot: Robot,
    place: str,
    out: Path,
    *,
    noise_percent: float = 3.0,
    payload: Payload | None = None,
    described: Robot | None = None,
) -> None:
    """Record a session in which simulated drives track a random exciting reference.

    The drives move the robot of `[parameters]`.

    Parameters
    ----------
    robot : the robot, with `[parameters]` and `[bus]`; the drives are its drives.
    place : name of the description in errors.
    out : MCAP file to write.
    noise_percent : noise of the torque, percent of each joint's rms torque.
    payload : payload of the robot; None for no payload.
    described : description in the recording; None for that of `robot`.

    Raises
    ------
    BadInputError : the description has no `[bus]` or values, the drives or the reference are not
        described completely, or the session failed.
    """
    period_s = (
        Location(place)
        .given(robot.bus, "[bus]", None, advice="Describe the drives to be simulated")
        .sync_period_s
    )
    model, described = true_model(robot), described or robot
    t_s: Array = np.arange(round(SESSION_S / period_s) + 1, dtype=np.float64) * period_s
    reference = periodic_reference(robot, duration_s=SESSION_S, seed=SESSION_SEED)
    q_ref, dq_ref, ddq_ref = reference.at(t_s)
    rms = np.sqrt(np.mean(model.torque(q_ref, dq_ref, ddq_ref) ** 2, axis=0))
    mechanism = DrivenPlant(
        plant=RigidBodyPlant(
            true_model(robot, payload),
            q_ref[0],
            speed_scale=np.abs(dq_ref).max(axis=0),
            step_s=period_s / SUBSTEPS,
            disturbance=0.01 * noise_percent * rms,
            seed=SESSION_SEED if payload is None else SESSION_SEED + 1,
        ),
        loops=drive_loops(robot, dynamics.inertias(model.inertia(q_ref[::50]))),
    )
    bus = resolve(robot, place)
    log = InlineLog(
        Recorder(
            out,
            describe_loops(described, mechanism.loops),
            source="simulated drives with the rigid robot of [parameters]",
            place=place,
            payload=payload,
        )
    )
    simulated = LockStepLink(SimulatedDrives(robot, bus, mechanism), tap=log.tap)
    try:
        outcome = run_active(
            described, Master(simulated, bus), log, Task(reference=q_ref, place="reference"), Stop()
        )
        log.finish(simulated.now_ns())
    finally:
        log.close()
    Location(str(out)).require(
        not outcome.fault, text=f"the simulated session failed: {outcome.reason}"
    )


def description(name: str) -> Path:
    """Return the description of a robot of this project.

    Parameters
    ----------
    name : `scara` or `tx40`.

    Returns
    -------
    The path of its robot.toml.
    """
    installed = Path(__file__).parents[1] / "robots" / name / "robot.toml"
    return (
        installed
        if installed.exists()
        else Path(__file__).parents[2] / "replay_data" / name / "robot.toml"
    )


def record_gain_pair(robot: Robot, place: str, paths: tuple[Path, Path]) -> list[float]:
    """Record sessions without and with the payload, to identify drive gains.

    The gains of the simulated drives differ from those described.

    Parameters
    ----------
    robot : a robot of this project, with `[parameters]` and `[bus]`.
    place : name of the description in errors.
    paths : MCAP files to write, without and with the payload.

    Returns
    -------
    The true drive gains by motor, N m/A.

    Raises
    ------
    BadInputError : as in `record_simulated_session`, or a file cannot be written.
    """
    described = CATALOGUE[: robot.n]
    true = [gain * factor for gain, factor in zip(described, TRUE_FACTORS, strict=False)]
    drives, stated = in_amperes(robot, true), in_amperes(robot, described)
    for path, payload in zip(paths, (None, PAYLOAD), strict=True):
        with atomic_write(path) as recording:
            record_simulated_session(drives, place, recording, payload=payload, described=stated)
    return true


def in_amperes(robot: Robot, gains: Sequence[float]) -> Robot:
    """Return a robot of this project whose drives report their current.

    `gains` are the drive gains in N m/A.
    """
    each = iter(gains)
    text = re.sub(
        "effort_unit = .*",
        lambda _: f'drive_gain = {next(each):.4g}\ndrive_gain_unit = "N m/A"',
        robot.files["robot.toml"].decode(),
    )
    text = re.sub('reference = "6074"|actual = "6077"', 'actual = "6078"', text)
    text = re.sub(
        r"rated_torque_nm = ([\d.]+)",
        lambda found: f"rated_current_a = {float(found[1]) / RATED_NM_PER_A:.4g}",
        text,
    )
    return robot_from_files({**robot.files, "robot.toml": text.encode()}, f"{robot.name} in A")
