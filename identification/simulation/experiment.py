"""The experiment that a recording is of, laid out for simulation: reference, controller, instants.

The instruments have samples as fine as 100 times the bandwidth, or the recording's rate where that is less, at instants that
the decimated rows of W have too. The robot is simulated in steps as fine as 100 times the bandwidth, whatever the rate of
recording and controller. Everything is made block by block, as the rows are: of a long recording no whole motion is held.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from acquisition.files import release_pages
from acquisition.robot import Joint

from ..arrays import Array
from ..errors import IdentificationError
from ..model import DirectModel, direct_model, inertias, pose_step
from ..regression import (
    BLOCK_SAMPLES,
    SPLINE_REACH,
    Motion,
    Problem,
    RowBlock,
    differentiate,
    largest_of_type,
    row_blocks,
    rule_cutoff_hz,
    sampled_at,
)
from .control_law import Reference, recorded_loop

RATE_PER_BANDWIDTH = 100.0  # instrument samples per period of the bandwidth, at least
EARLY_RATE_PER_BANDWIDTH = 25.0  # the same in passes whose estimate is only where the next ones start
MAX_DEVIATION = 0.5  # of a joint's travel: a simulation, or a reference, this far off does not belong to the recording
MIN_TRAVEL = (
    0.01  # of the reference, in that of the joint of the same type which travels most: a joint with less is held
)
LEAST_INSTANTS = 30  # of the controller, for a simulation to say anything
MOST_STEPS = 2e7  # to simulate: what is slower than real time by far is a mistake in the description
MIN_SATURATED_PERCENT = 5.0  # share of saturated samples that explains why a robot leaves its reference


class Experiment:
    """What every simulation of a recording shares, laid out for one rate of steps.

    Instruments have `N` samples: every `stride`-th of the recording, `spacing_s` apart, from its sample `first` on. The
    controller has `instants`, `period_s` apart, from the same sample on, each with `substeps` simulated steps.

    Attributes:
        loop: the description's control loop, or None where a PD of the stated bandwidth stands in.
        reference_kind: `surrogate` for the measured position low-passed without phase shift.
        blocks: of the rows, to which `decimation` leads from the instruments.
        start: measured position and speed, filtered, (n,) each, at the first instant.
        bound: (n,) how far a simulation may leave the reference; `held` (n,), which joints the reference holds;
            `fastest` (c,) its speeds along the `directions` (c, n) of Coulomb friction.
        scatter: (n,) sum of squares of the measured position, filtered, about its mean.
        poses: (P, n) positions at which M is checked.
        J_prior: (n,) inertias that the loop's gains were set for; `J_known` says that least squares gave them.
    """

    def __init__(
        self,
        problem: Problem,
        beta_ls: Array,
        slip_noise: Array,
        *,
        gain_update: bool = True,
        rate_per_bandwidth: float = RATE_PER_BANDWIDTH,
        long: bool = False,
    ) -> None:
        """`beta_ls` gives the inertias that recorded gains are taken to be set for; with `gain_update` they follow those of
        each estimate.

        `slip_noise` (c,) is that of the speeds of the directions of Coulomb friction. There are `rate_per_bandwidth`
        simulated steps and instrument samples, at least, per period of the bandwidth. Of a `long` recording no whole motion
        is kept.

        Raises `IdentificationError` for a controller described in part, or a reference that is not that of the recording.
        """
        signals, robot = problem.signals, problem.signals.robot
        self.problem, self.slip_noise, self.gain_update, self.long = problem, slip_noise, gain_update, long
        self.directions, self.bandwidth_hz = problem.model.coulomb_directions, robot.bandwidth_hz
        self.reference_kind: Literal["recorded", "surrogate"] = "surrogate" if signals.q_ref is None else "recorded"
        self._cutoff_hz = rule_cutoff_hz(self.bandwidth_hz, signals.sample_rate_hz)
        self.loop = recorded_loop(robot)
        if self.loop is not None and signals.q_ref is None:
            self.loop = replace(self.loop, gravity=True)
        _refuse_foreign_reference(problem)
        self._set_instants(rate_per_bandwidth * self.bandwidth_hz)
        self.blocks = tuple(row_blocks(problem))
        self.decimation = replace(problem.settings.decimator, factor=problem.settings.decimation // self.stride)
        self._look_along()
        self.J_prior = inertias(self.model(beta_ls).inertia(self.poses))
        self.J_known = bool((self.J_prior > 0).all())
        if not self.J_known:  # a PD of the bandwidth takes any; of described gains one knows what inertia they suit
            self.J_prior = self.loop.inertias(self.bandwidth_hz) if self.loop else np.ones(len(self.held))

    def _set_instants(self, step_hz: float) -> None:
        """Instruments as coarse as `step_hz` allows at instants of the rows; refuses controllers of other recordings."""
        settings, fs, recording = (
            self.problem.settings,
            self.problem.signals.sample_rate_hz,
            self.problem.signals.recording,
        )
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
        steps, self.instants = span_s / self.period_s * self.substeps, math.floor(span_s / self.period_s + 1e-6) + 1
        rate_hz, what, expected = 1 / self.period_s, "", ""
        if steps > MOST_STEPS:
            what = f"{steps:.2g} steps to simulate with bandwidth_hz = {self.bandwidth_hz:g}"
            expected = f"at most {MOST_STEPS:.2g} steps"
        elif self.instants < LEAST_INSTANTS:
            what = f"{self.instants} instants in the {used / fs:.3g} s of {recording}"
            expected = f"at least {LEAST_INSTANTS} instants"
        if what:
            place, key = f"robot {self.problem.signals.robot.name}", "controller.sample_rate_hz"
            raise IdentificationError(
                what, place=place, key=key, value=rate_hz, shown=f"{rate_hz:g}", expected=expected
            )

    def _look_along(self) -> None:
        """What the whole recording says of start, poses, speeds, travel and scatter, block by block."""
        joints, every = self.problem.signals.robot.joints, pose_step(self.N)
        start = self._motion(slice(0, 1))
        poses, ends, self.fastest = list[Array](), list[Array](), np.zeros(len(self.directions))
        total, squares = np.zeros((2, len(joints)))
        for block in self.blocks:
            own = block.own_samples(self.N, self.decimation.factor)
            q = self.measured(own)
            poses.append(q[-own.start % every :: every])
            total, squares = total + (q - start.q[0]).sum(axis=0), squares + ((q - start.q[0]) ** 2).sum(axis=0)
            reference = self.reference(*self.around(own))
            ends += [reference.q.min(axis=0), reference.q.max(axis=0)]
            self.fastest = np.maximum(self.fastest, np.abs(reference.dq @ self.directions.T).max(axis=0, initial=0.0))
        travel = np.ptp(ends, axis=0)
        scale, self.held = _scales(travel, joints)
        self.start, self.poses = (start.q[0], start.dq[0]), np.concatenate(poses)
        self.bound = MAX_DEVIATION * np.maximum(scale, 0.1 * travel.max())
        self.scatter = np.maximum(squares - total**2 / self.N, 0.0)

    def model(self, beta: Array) -> DirectModel:
        """The robot with base parameters (b,)."""
        return direct_model(self.problem.model, self.problem.base.standard_parameters(beta))

    def reference(self, first: int, last: int) -> Reference:
        """What the controller follows from its instant `first` to before `last`."""
        return _reference(self, self.places(first, last))

    def samples(self, block: RowBlock) -> slice:
        """The instruments' samples that a block needs."""
        return block.samples(self.N, self.decimation.factor)

    def measured(self, at: slice) -> Array:
        """(N, n) measured position, filtered, at samples of the instruments."""
        return self._motion(at).q[:: self.stride]

    def _motion(self, at: slice) -> Motion:
        """The filtered motion of all samples of the recording from the first to the last of some of the instruments."""
        return self.filtered(self.first + self.stride * at.start, self.first + self.stride * (at.stop - 1) + 1)

    def filtered(self, start: int, stop: int) -> Motion:
        """The measured motion of samples of the recording, behind the rule's low-pass."""
        return self.problem.motion.between(start, stop, self._cutoff_hz)

    def t_s(self, at: slice) -> Array:
        """Seconds of the recording of samples of the instruments."""
        samples = self.first + self.stride * np.arange(at.start, at.stop)
        return np.asarray(samples / self.problem.signals.sample_rate_hz)

    def places(self, first: int, last: int) -> Array:
        """Controller's instants, counted in samples of the recording."""
        fs = self.problem.signals.sample_rate_hz
        return np.asarray(self.first + self.period_s * fs * np.arange(first, last))

    def around(self, at: slice) -> tuple[int, int]:
        """The controller's instants, first and past the last, that samples of the instruments lie between."""
        ratio = self.spacing_s / self.period_s
        first, last = math.floor(at.start * ratio + 1e-6), math.ceil((at.stop - 1) * ratio - 1e-6) + 1
        return min(first, self.instants - 1), self.instants if at.stop == self.N else min(last, self.instants)

    def sampled(self, x: Array, first: int, at: slice, substeps: int) -> Array:
        """x (rows, c), `substeps` rows to an instant from row `first` on, at samples of the instruments."""
        places = np.arange(at.start, at.stop) * (self.spacing_s * substeps / self.period_s) - first
        picks = np.rint(places).astype(np.intp)  # beyond the last row that one stands
        if np.abs(places - picks).max() < 1e-6:
            return x[np.minimum(picks, len(x) - 1)]
        return np.stack([np.interp(places, np.arange(len(x)), column) for column in x.T], axis=1)


def _reference(e: Experiment, at: Array) -> Reference:
    """What the loop is given at places `at` (K,), counted in samples: the recorded reference, or the measured motion."""
    signals, settings = e.problem.signals, e.problem.settings
    low = max(settings.start, math.floor(at[0]) - SPLINE_REACH)
    high = min(settings.stop, math.ceil(at[-1]) + 1 + SPLINE_REACH)
    at, near = at - low, slice(low, high)
    known = None if signals.known_torque is None else sampled_at(at, signals.known_torque[near])
    if signals.q_ref is None:
        # What was fed forward is in the measured motion already.
        measured = e.filtered(low, high)
        return Reference(*(sampled_at(at, x) for x in (measured.q, measured.dq, measured.ddq)), known_torque=known)
    q_ref = np.array(signals.q_ref[near])
    release_pages(signals.q_ref)
    dq_ref = differentiate(q_ref, signals.sample_rate_hz)
    paths = (sampled_at(at, x) for x in (q_ref, dq_ref, differentiate(dq_ref, signals.sample_rate_hz)))
    ahead = None
    if signals.feedforward is not None:  # held from sample to sample: a cubic would swing beside a step
        ahead = signals.feedforward[near][np.floor(np.clip(at, 0, len(q_ref) - 1) + 1e-6).astype(np.intp)]
        if e.loop is None:  # a surrogate's output is torque at the joints
            ahead = signals.robot.joint_effort(ahead)
    return Reference(*paths, known_torque=known, feedforward=ahead)


def _scales(travel: Array, joints: Sequence[Joint]) -> tuple[Array, NDArray[np.bool_]]:
    """(n,) by what position errors are large, from the `travel` (n,) of the reference; and which joints are held."""
    # Neighbours push a held joint, whose own travel says nothing of that.
    largest = largest_of_type(travel, joints)
    held = travel < MIN_TRAVEL * largest
    return np.where(held, largest, travel), held


def _refuse_foreign_reference(problem: Problem) -> None:
    """A reference far from the measured position is of a saturated drive, of another recording, or in other units."""
    signals, used = problem.signals, slice(problem.settings.start, problem.settings.stop)
    if signals.q_ref is None:
        return
    joints, first, N = signals.robot.joints, signals.q_ref[used.start], used.stop - used.start
    total, squares, off = np.zeros((3, len(joints)))
    for a in range(used.start, used.stop, BLOCK_SAMPLES):
        some = slice(a, min(used.stop, a + BLOCK_SAMPLES))
        x = signals.q_ref[some] - first
        total, squares = total + x.sum(axis=0), squares + (x**2).sum(axis=0)
        off = off + ((signals.q_ref[some] - signals.q[some]) ** 2).sum(axis=0)
        release_pages(signals.q)
        release_pages(signals.q_ref)
    spreads, errors = np.sqrt(np.maximum(squares / N - (total / N) ** 2, 0.0)), np.sqrt(off / N)
    for joint, scale, error in zip(joints, _scales(spreads, joints)[0], errors, strict=True):
        if error <= MAX_DEVIATION * scale:
            continue
        what = f"{error:.3g} {joint.position_unit} rms off the measured position"
        saturated = saturated_percent(problem)
        if saturated is not None and saturated > MIN_SATURATED_PERCENT:
            what += f": a drive is saturated in {saturated:.0f} % of the samples"
            expected = "a slower motion, within the drives' limits"
        else:
            what += f", where references travel {scale:.3g}"
            expected = "the reference of this recording"
        place = f"{signals.recording}: reference of joint {joint.name}"
        raise IdentificationError(what, place=place, expected=expected)


def saturated_percent(problem: Problem) -> float | None:
    """Share of recorded samples at the drives' limit, None where no limit is stated."""
    signals, settings = problem.signals, problem.settings
    limits = np.array([np.inf if m.saturation is None else m.saturation for m in signals.robot.motors])
    if not np.isfinite(limits).any():
        return None
    saturated = 0
    for a in range(settings.start, settings.stop, BLOCK_SAMPLES):
        effort = signals.robot.motor_effort(signals.effort[a : min(settings.stop, a + BLOCK_SAMPLES)])
        saturated += int((np.abs(effort) >= 0.995 * limits).any(axis=1).sum())
        release_pages(signals.effort)
    return 100.0 * saturated / (settings.stop - settings.start)
