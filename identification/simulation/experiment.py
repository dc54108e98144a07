"""A recorded experiment prepared for simulation: reference, controller, instants.

The instruments are sampled at 100 times the bandwidth or at the recording's rate, whichever is
lower; their instants include those of the decimated rows of W. The robot is simulated in steps of
at least 100 times the bandwidth, at any rate of recording and controller. All is computed block by
block, like the rows: no whole motion of a long recording is in memory.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from acquisition.files import release_pages
from acquisition.robot import Joint

from .. import regression
from ..arrays import Array
from ..errors import BadInputError
from ..model import DirectModel, direct_model, inertias, pose_step
from ..regression import (
    BLOCK_SAMPLES,
    FilteredMotion,
    Motion,
    Problem,
    RowBlock,
    differentiate,
    sampled_at,
)
from .control_law import Reference, recorded_loop

RATE_PER_BANDWIDTH = 100.0  # instrument samples per period of the bandwidth, at least
# the same in early passes, whose estimate only starts the next ones
EARLY_RATE_PER_BANDWIDTH = 25.0
MAX_DEVIATION = 0.5  # of a joint's travel, of a simulation or a reference from the recording
MIN_TRAVEL = 0.01  # of the largest travel of a joint of the same type: a joint with less is held
MIN_INSTANTS = 30  # of the controller
MAX_STEPS = 2e7  # to simulate: more is a mistake in the description
MIN_SATURATED_PERCENT = 5.0  # of saturated samples that explains a deviation from the reference
# An effort leaves its peaks soon, but not a limit: shares of the samples in ranges of these widths,
# thousandths of the peak
MIN_HELD, MIN_HELD_RATIO, HELD_WIDTHS = 0.01, 3.0, np.array([20, 40, 80])


class Experiment:
    """What all simulations of a recording at one step rate share.

    Instruments have `N` samples: every `stride`-th of the recording, `spacing_s` apart, from its
    sample `first` on. The controller has `instants`, `period_s` apart, from the same sample on,
    each with `substeps` simulated steps.

    Attributes:
        loop: the control loop of the description or of the recording, or None: a PD of the stated
            bandwidth is used instead.
        delay_s: after which the reference acts.
        reference_kind: `surrogate` for the measured position low-passed without phase shift.
        blocks: of the rows; `decimation` leads from the instruments to the rows.
        cutoff_hz: of the rule, of the measured and the predicted motion.
        start: measured position and speed, filtered, (n,) each, at the first instant.
        bound: (n,) maximum deviation of a simulation from the reference; `held` (n,), which
            joints the reference holds; `fastest` (c,) its maximum speeds along the `directions`
            (c, n) of Coulomb friction.
        scatter: (n,) sum of squares of the measured position, filtered, about its mean.
        poses: (P, n) positions at which M is checked.
        J_prior: (n,) inertias that the loop's gains were set for; `J_known`: they
            are from least squares.
    """

    def __init__(
        self,
        problem: Problem,
        beta_ls: Array,
        *,
        gain_update: bool = True,
        rate_per_bandwidth: float = RATE_PER_BANDWIDTH,
        spans: int = 0,
    ) -> None:
        """The recorded gains are assumed to suit the inertias of `beta_ls`; with `gain_update`,
        equation (E), they follow each estimate's.

        A period of the bandwidth has at least `rate_per_bandwidth` simulated steps and
        instrument samples. A long recording has `spans` of QR factors in place of rows, and no
        whole motion of it is stored.

        Raises `BadInputError` for an incomplete controller or a reference of another recording.
        """
        signals, robot = problem.signals, problem.signals.robot
        self.problem, self.gain_update, self.spans = problem, gain_update, spans
        self.directions, self.bandwidth_hz = problem.model.coulomb_directions, robot.bandwidth_hz
        self.reference_kind: Literal["recorded", "surrogate"] = (
            "surrogate" if signals.q_ref is None else "recorded"
        )
        self.cutoff_hz = regression.rule_cutoff_hz(signals)
        self.loop, law = recorded_loop(robot), problem.law
        if self.loop is None and law is not None and law.reason is None:
            self.loop = recorded_loop(replace(robot, controller=law.controller(robot.controller)))
        self.delay_s = law.common_delay_s if law is not None else 0.0
        self.controller: Literal["described", "found", "surrogate"] = "surrogate"
        if self.loop is not None:
            self.controller = "found" if recorded_loop(robot) is None else "described"
        if self.loop is not None and signals.q_ref is None:
            self.loop = replace(self.loop, gravity=not self.loop.gravity_at_q)
        _refuse_foreign_reference(problem)
        self._set_instants(rate_per_bandwidth * self.bandwidth_hz)
        self.blocks = tuple(regression.row_blocks(problem))
        self.decimation = replace(
            problem.settings.decimator, factor=problem.settings.decimation // self.stride
        )
        self._scan_recording()
        self.J_prior = inertias(self.model(beta_ls).inertia(self.poses))
        self.J_known = bool((self.J_prior > 0).all())
        if not self.J_known:  # described gains imply inertias; a surrogate PD suits any
            self.J_prior = (
                self.loop.inertias(self.bandwidth_hz) if self.loop else np.ones(len(self.held))
            )

    def _set_instants(self, step_hz: float) -> None:
        """Choose the largest stride that `step_hz` allows; refuse a sample rate that does
        not fit the recording.
        """
        settings, signals = self.problem.settings, self.problem.signals
        fs, recording = signals.sample_rate_hz, signals.recording
        divisors = [m for m in range(1, settings.decimation + 1) if settings.decimation % m == 0]
        self.stride = max((m for m in divisors if fs / m >= step_hz), default=1)
        used = settings.stop - settings.start
        self.N, self.spacing_s = -(-used // self.stride), self.stride / fs
        self.first = (used - 1) % self.stride + settings.start
        span_s = (self.N - 1) * self.spacing_s
        self.period_s = self.loop.period_s if self.loop else self.spacing_s
        self.substeps = max(1, math.ceil(self.period_s * step_hz - 1e-9))
        if self.loop is None:  # a continuous law: it acts at every step
            self.period_s, self.substeps = self.period_s / self.substeps, 1
        steps, self.instants = (
            span_s / self.period_s * self.substeps,
            math.floor(span_s / self.period_s + 1e-6) + 1,
        )
        rate_hz, what, expected = 1 / self.period_s, "", ""
        if steps > MAX_STEPS:
            what = f"{steps:.2g} steps to simulate with bandwidth_hz = {self.bandwidth_hz:g}"
            expected = f"at most {MAX_STEPS:.2g} steps"
        elif self.instants < MIN_INSTANTS:
            what = f"{self.instants} instants in the {used / fs:.3g} s of {recording}"
            expected = f"at least {MIN_INSTANTS} instants"
        if what:
            raise BadInputError(
                what,
                place=f"robot {self.problem.signals.robot.name}",
                key="controller.sample_rate_hz",
                value=rate_hz,
                shown=f"{rate_hz:g}",
                expected=expected,
            )

    def _scan_recording(self) -> None:
        """Find start, poses, speeds, travel and scatter over the whole
        recording, block by block.
        """
        joints, every = self.problem.signals.robot.joints, pose_step(self.N)
        start = self.motion(slice(0, 1), self.problem.motion)
        poses, ends, self.fastest = list[Array](), list[Array](), np.zeros(len(self.directions))
        total, squares = np.zeros((2, len(joints)))
        for block in self.blocks:
            own = block.own_samples(self.N, self.decimation.factor)
            q = self.measured(own)
            poses.append(q[-own.start % every :: every])
            total, squares = (
                total + (q - start.q[0]).sum(axis=0),
                squares + ((q - start.q[0]) ** 2).sum(axis=0),
            )
            reference = self.reference(*self.around(own))
            ends += [reference.q.min(axis=0), reference.q.max(axis=0)]
            self.fastest = np.maximum(
                self.fastest, np.abs(reference.dq @ self.directions.T).max(axis=0, initial=0.0)
            )
        travel = np.ptp(ends, axis=0)
        scale, self.held = _scales(travel, joints)
        self.start, self.poses = (start.q[0], start.dq[0]), np.concatenate(poses)
        self.bound = MAX_DEVIATION * np.maximum(scale, 0.1 * travel.max())
        self.scatter = np.maximum(squares - total**2 / self.N, 0.0)

    def model(self, beta: Array) -> DirectModel:
        """The robot with base parameters (b,)."""
        return direct_model(self.problem.model, self.problem.base.standard_parameters(beta))

    def reference(self, first: int, last: int) -> Reference:
        """The controller's reference from its instant `first` to before `last`."""
        return _reference(self, self.places(first, last))

    def samples(self, block: RowBlock) -> slice:
        """The instrument samples that a block needs."""
        return block.samples(self.N, self.decimation.factor)

    def measured(self, at: slice) -> Array:
        """Filtered measured position (N, n) at instrument samples."""
        return self.motion(at, self.problem.motion).q[:: self.stride]

    def motion(self, at: slice, of: FilteredMotion) -> Motion:
        """A motion at all recorded samples from the first to the last of these instrument samples,
        low-passed by the rule.
        """
        first, last = (self.first + self.stride * place for place in (at.start, at.stop - 1))
        return of.between(first, last + 1, self.cutoff_hz)

    def t_s(self, at: slice) -> Array:
        """Times of instrument samples, s."""
        samples = self.first + self.stride * np.arange(at.start, at.stop)
        return np.asarray(samples / self.problem.signals.sample_rate_hz)

    def places(self, first: int, last: int) -> Array:
        """The controller's instants, in recorded samples."""
        fs = self.problem.signals.sample_rate_hz
        return np.asarray(self.first + self.period_s * fs * np.arange(first, last))

    def around(self, at: slice) -> tuple[int, int]:
        """The controller's instants, first and past the last, that enclose instrument samples."""
        ratio = self.spacing_s / self.period_s
        first, last = (
            math.floor(at.start * ratio + 1e-6),
            math.ceil((at.stop - 1) * ratio - 1e-6) + 1,
        )
        return min(first, self.instants - 1), self.instants if at.stop == self.N else min(
            last, self.instants
        )

    def sampled(self, x: Array, first: int, at: slice, substeps: int) -> Array:
        """x (rows, c), `substeps` rows an instant from row `first` on, at instrument samples."""
        places = np.arange(at.start, at.stop) * (self.spacing_s * substeps / self.period_s) - first
        picks = np.rint(places).astype(np.intp)  # the last row is repeated
        if np.abs(places - picks).max() < 1e-6:
            return x[np.minimum(picks, len(x) - 1)]
        return np.stack([np.interp(places, np.arange(len(x)), column) for column in x.T], axis=1)


def _reference(e: Experiment, at: Array) -> Reference:
    """The loop's inputs at places `at` (K,) in samples: the recorded reference,
    or the measured motion.
    """
    signals, settings = e.problem.signals, e.problem.settings
    low = max(settings.start, math.floor(at[0]) - regression.SPLINE_REACH)
    high = min(settings.stop, math.ceil(at[-1]) + 1 + regression.SPLINE_REACH)
    at, near = at - low, slice(low, high)
    known = None if signals.known_torque is None else sampled_at(at, signals.known_torque[near])
    if signals.q_ref is None:
        # The measured motion already contains the effect of the feed-forward.
        measured = e.problem.motion.between(low, high, e.cutoff_hz)
        return Reference(
            *(sampled_at(at, x) for x in (measured.q, measured.dq, measured.ddq)),
            known_torque=known,
        )
    q_ref = np.array(signals.q_ref[near])
    release_pages(signals.q_ref)
    dq_ref = differentiate(q_ref, signals.sample_rate_hz)
    given = at - e.delay_s * signals.sample_rate_hz  # before the span the reference stands
    paths = (
        sampled_at(given, x) for x in (q_ref, dq_ref, differentiate(dq_ref, signals.sample_rate_hz))
    )
    feedforward = None
    if signals.feedforward is not None:  # held between samples: a cubic would overshoot at steps
        feedforward = signals.feedforward[near][
            np.floor(np.clip(at, 0, len(q_ref) - 1) + 1e-6).astype(np.intp)
        ]
        if e.loop is None:  # a surrogate's output is torque at the joints
            feedforward = signals.robot.joint_effort(feedforward)
    return Reference(*paths, known_torque=known, feedforward=feedforward)


def _scales(travel: Array, joints: Sequence[Joint]) -> tuple[Array, NDArray[np.bool_]]:
    """Scales (n,) of position errors, from the `travel` (n,) of the reference; and
    which joints are held.
    """
    # A held joint is pushed by its neighbours: its own travel is no scale.
    largest = regression.largest_of_type(travel, joints)
    held = travel < MIN_TRAVEL * largest
    return np.where(held, largest, travel), held


def _refuse_foreign_reference(problem: Problem) -> None:
    """Refuse a reference far from the measured position: of another
    recording, or in other units.
    """
    signals, used = problem.signals, slice(problem.settings.start, problem.settings.stop)
    if signals.q_ref is None:
        return
    joints, first, N = signals.robot.joints, signals.q_ref[used.start], used.stop - used.start
    total, squares, squared_error = np.zeros((3, len(joints)))
    for a in range(used.start, used.stop, BLOCK_SAMPLES):
        block = slice(a, min(used.stop, a + BLOCK_SAMPLES))
        x = signals.q_ref[block] - first
        total, squares = total + x.sum(axis=0), squares + (x**2).sum(axis=0)
        squared_error += ((signals.q_ref[block] - signals.q[block]) ** 2).sum(axis=0)
        release_pages(signals.q)
        release_pages(signals.q_ref)
    spreads, errors = (
        np.sqrt(np.maximum(squares / N - (total / N) ** 2, 0.0)),
        np.sqrt(squared_error / N),
    )
    for joint, scale, error in zip(joints, _scales(spreads, joints)[0], errors, strict=True):
        if error <= MAX_DEVIATION * scale:
            continue
        if max(saturated_percents(problem).values(), default=0.0) > MIN_SATURATED_PERCENT:
            return  # a drive at its limit does not follow
        what = (
            f"{error:.3g} {joint.position_unit} rms from the measured position, with a travel "
            f"of {scale:.3g}"
        )
        place, expected = (
            f"{signals.recording}: reference of joint {joint.name}",
            "the reference of this recording",
        )
        if unstated := unstated_limits(problem):
            what, expected = "; ".join([what, *unstated]), "saturation of the motor in robot.toml"
        raise BadInputError(what, place=place, expected=expected)


def saturated_percents(problem: Problem) -> dict[str, float]:
    """Percentage of the recorded samples at each motor's limit, by motor and limit;
    empty if none is stated.
    """
    robot, settings = problem.signals.robot, problem.settings
    limits = {
        m: motor.saturation for m, motor in enumerate(robot.motors) if motor.saturation is not None
    }
    count = dict.fromkeys(limits, 0)
    for effort in _motor_efforts(problem):
        for m, limit in limits.items():
            count[m] += int((np.abs(effort[:, m]) >= 0.995 * limit).sum())
    N = settings.stop - settings.start
    return {
        f"{robot.motors[m].name} ({limits[m]:.4g} {robot.motors[m].recorded_unit})": 100.0 * k / N
        for m, k in count.items()
    }


def unstated_limits(problem: Problem) -> list[str]:
    """Drives that saturate, below a stated limit or without one, in words."""
    found, motors, counts = list[str](), problem.signals.robot.motors, np.zeros(())
    peaks = np.max([np.abs(effort).max(axis=0) for effort in _motor_efforts(problem)], axis=0)
    for effort in _motor_efforts(problem):
        each = zip(np.abs(effort).T, peaks, strict=True)
        counts = counts + [np.histogram(x, 1000, (0, peak or 1.0))[0][::-1] for x, peak in each]
    for motor, peak, share in zip(motors, peaks, counts / counts[0].sum(), strict=True):
        held, *below = np.diff(np.r_[0.0, share.cumsum()][np.outer(range(4), HELD_WIDTHS)], axis=0)
        ratio = (
            held
            / np.maximum(np.max(below, axis=0), 1e-9)
            * (held > MIN_HELD)
            * (np.min(below, axis=0) > 0)
        )
        k = int(ratio.argmax())
        limit = peak * (
            1
            - 1e-3 * np.average(np.arange(HELD_WIDTHS[k]), weights=share[: HELD_WIDTHS[k]] + 1e-300)
        )
        if ratio[k] > MIN_HELD_RATIO and limit < 0.99 * (motor.saturation or math.inf):
            at = f"{limit:.3g} {motor.recorded_unit} in {100 * held[k]:.2g} % of the rows"
            found.append(f"drive of {motor.name} saturates at {at}")
    return found


def _motor_efforts(problem: Problem) -> Iterator[Array]:
    """The recorded efforts (K, n) of the motors in the span used, in blocks."""
    # corrected for a lag, an effort overshoots its limit
    signals, settings = problem.recorded, problem.settings
    for a in range(settings.start, settings.stop, BLOCK_SAMPLES):
        yield signals.robot.motor_effort(signals.effort[a : min(settings.stop, a + BLOCK_SAMPLES)])
        release_pages(signals.effort)
