"""A recording whose robot is simulated: the same reference, control law and known torques.

It gives the same blocks of motion as the measured recording, so that the instruments Z are computed
by the function that computes W. Samples are at 100 times the bandwidth or at the recording's rate,
whichever is lower; their instants include those of the decimated rows of W. The robot is simulated
in steps of at least 100 times the bandwidth, at any rate of recording and controller. The motion of
a long recording is on disk.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Literal

import numpy as np

from acquisition.files import allocate, release_pages

from .. import regression
from ..arrays import Array
from ..model import DirectModel, direct_model, inertias, poses_of, why_not_positive
from ..regression import (
    SPLINE_REACH,
    FilteredMotion,
    Motion,
    MotionBlock,
    Problem,
    RowBlock,
    differentiate,
    sampled_at,
)
from .closed_loop import ClosedLoop
from .control_law import ControlLaw, Reference, recorded_loop, surrogate_loop
from .predicted import predicted_motion
from .recording_checks import (
    MAX_DEVIATION,
    position_scales,
    refuse_foreign_reference,
    refuse_instants,
)

FINE = 100.0  # samples and steps per period of the bandwidth, at least
COARSE = 25.0  # the same in early passes, whose estimate only starts the next ones
CHUNK = 50_000  # instants of the controller that are simulated at a time

# a motion, block by block, as often as it is asked for
Along = Callable[[], Iterator[MotionBlock]]


def controller_of(
    problem: Problem,
) -> tuple[ControlLaw | None, Literal["described", "found", "surrogate"]]:
    """Return the control loop, and whether it is described or found in the recording; None for
    neither: a PD of the stated bandwidth is used instead.

    Raises `BadInputError` for an incomplete controller.
    """
    robot, law = problem.robot, problem.law
    loop = described = recorded_loop(robot)
    if loop is None and law is not None and law.reason is None:
        loop = recorded_loop(replace(robot, controller=law.controller(robot.controller)))
    if loop is None:
        return None, "surrogate"
    if problem.signals.q_ref is None:
        loop = replace(loop, gravity=not loop.gravity_at_q)
    return loop, "found" if described is None else "described"


class SimulatedRecording:
    """A recording, prepared once, in which a robot of any base parameters is simulated.

    Its motion has `N` samples: every `stride`-th of the recording, from its sample `first` on. The
    controller has `instants`, `period_s` apart, from the same sample on, each with `substeps`
    simulated steps.

    Attributes:
        problem: of the recording, with its samples.
        blocks: of the rows; `decimation` leads from the samples to the rows.
        cutoff_hz: of the rule, of the measured and the predicted motion.
        loop: the control loop; None for a PD of the stated bandwidth.
        poses: (P, n) positions at which the inertia matrix is checked.
        fastest: (c,) largest speeds of the reference along the directions of Coulomb friction.
        held: which joints (n,) the reference holds.
        bound: (n,) largest deviation of a simulation from the reference.
        prior: (n,) inertias that the loop's gains were set for; `prior_known`: they are those asked
            for. Else described gains imply them, and a PD of the stated bandwidth suits any.
    """

    def __init__(
        self,
        problem: Problem,
        prior: Array,
        rate_per_bandwidth: float = FINE,
        *,
        gain_update: bool = True,
    ) -> None:
        """The recorded gains are assumed to suit the inertias of the base parameters `prior` (b,);
        with `gain_update`, equation (E), they follow each estimate's.

        A period of the bandwidth has at least `rate_per_bandwidth` samples and simulated steps.
        Raises `BadInputError` for an incomplete controller, one whose rate does not fit the
        recording, or a reference of another recording.
        """
        self.problem, self._gain_update = problem.with_samples(), gain_update
        refuse_foreign_reference(self.problem)
        signals, settings, robot = self.problem.signals, problem.settings, problem.robot
        fs, n_d, step_hz = (
            signals.sample_rate_hz,
            settings.decimation,
            rate_per_bandwidth * robot.bandwidth_hz,
        )
        self.cutoff_hz = regression.rule_cutoff_hz(signals)
        self.blocks = tuple(regression.row_blocks(self.problem))
        strides = [m for m in range(1, n_d + 1) if n_d % m == 0 and fs / m >= step_hz]
        self.stride = max(strides, default=1)
        self.decimation = replace(settings.decimator, factor=n_d // self.stride)
        self.N = -(-(settings.stop - settings.start) // self.stride)
        self.first = settings.stop - 1 - (self.N - 1) * self.stride
        self.loop, _ = controller_of(self.problem)
        self.period_s = self.loop.period_s if self.loop else self.stride / fs
        self.substeps = max(1, math.ceil(self.period_s * step_hz - 1e-9))
        if self.loop is None:  # a continuous law: it acts at every step
            self.period_s, self.substeps = self.period_s / self.substeps, 1
        periods = (self.N - 1) * self.stride / fs / self.period_s
        self.instants = math.floor(periods + 1e-6) + 1
        refuse_instants(self.problem, self.period_s, self.instants, periods * self.substeps)
        ends, speeds = list[Array](), list[Array]()
        for first, last in self._chunks():
            x = self.reference(first, last)
            ends += [x.q.min(axis=0), x.q.max(axis=0)]
            speeds.append(np.abs(x.dq @ problem.model.coulomb_directions.T).max(axis=0))
        travel, self.fastest = np.ptp(ends, axis=0), np.max(speeds, axis=0)
        scales, self.held = position_scales(travel, robot.joints)
        self.bound = MAX_DEVIATION * np.maximum(scales, 0.1 * travel.max())
        self.poses = poses_of(self.problem.used_positions())
        self.prior = inertias(self.model(prior).inertia(self.poses))
        self.prior_known = bool((self.prior > 0).all())
        if not self.prior_known:
            self.prior = self.loop.inertias(robot.bandwidth_hz) if self.loop else np.ones(robot.n)

    def motion(self, beta: Array | None, about: Array) -> tuple[Along, str | None]:
        """Simulate the robot of base parameters beta (b,), and return its motion, with the torque
        of its drives.

        If beta is None, the robot cannot be simulated or leaves its reference, the motion is that
        which the reference predicts, with the torque of parameters `about` (b,). Returns also why
        beta was not simulated, or None.
        """
        path, reason = (None, None) if beta is None else self._simulated(beta)
        predicted = self.model(about)
        return lambda: (self._block(at, path, predicted) for at in self.blocks), reason

    def gains(self, beta: Array) -> tuple[Array, str | None]:
        """Return factors (n,) on the controller's gains for the inertias of beta (b,), equation
        (E), and why the robot cannot be simulated, or None.
        """
        M = self.model(beta).inertia(self.poses)
        # Computed torque keeps its saturation if the inertias it was set for are unknown.
        known = self.prior_known or self.loop is None or not self.loop.computed_torque
        factors = inertias(M) / self.prior if self._gain_update and known else np.ones(M.shape[1])
        return factors, why_not_positive(M)

    def model(self, beta: Array) -> DirectModel:
        """Return the robot with base parameters (b,)."""
        return direct_model(self.problem.model, self.problem.base.standard_parameters(beta))

    def samples(self, at: RowBlock) -> slice:
        """Return the samples that a block of rows needs."""
        return at.samples(self.N, self.decimation.factor)

    def low_passed(self, of: FilteredMotion, at: slice) -> Motion:
        """Return a motion at samples, low-passed by the rule."""
        first, last = (self.first + self.stride * k for k in (at.start, at.stop - 1))
        return of.between(first, last + 1, self.cutoff_hz).part(slice(None, None, self.stride))

    def reference(self, first: int, last: int) -> Reference:
        """Return the loop's inputs from the controller's instant `first` to before `last`: the
        recorded reference, or the measured motion.
        """
        signals, settings, law = self.problem.signals, self.problem.settings, self.problem.law
        fs = signals.sample_rate_hz
        at = self.first + self.period_s * fs * np.arange(first, last)  # in recorded samples
        low = max(settings.start, math.floor(at[0]) - SPLINE_REACH)
        high = min(settings.stop, math.ceil(at[-1]) + 1 + SPLINE_REACH)
        at, near, late_s = (
            at - low,
            slice(low, high),
            law.common_delay_s if law is not None else 0.0,
        )
        known = None if signals.known_torque is None else sampled_at(at, signals.known_torque[near])
        if signals.q_ref is None:
            # The measured motion already contains the effect of the feed-forward.
            x = self.problem.motion.between(low, high, self.cutoff_hz)
            paths = (sampled_at(at, path) for path in (x.q, x.dq, x.ddq))
            return Reference(*paths, known_torque=known)
        q = np.array(signals.q_ref[near])
        if self.instants > CHUNK:
            release_pages(signals.q_ref)
        dq, feedforward = differentiate(q, fs), None
        # before the span the reference stands
        paths = (sampled_at(at - late_s * fs, x) for x in (q, dq, differentiate(dq, fs)))
        if signals.feedforward is not None:  # held between samples: a cubic would overshoot
            held = np.floor(np.clip(at, 0, len(q) - 1) + 1e-6).astype(np.intp)
            feedforward = signals.feedforward[near][held]
            if self.loop is None:  # a surrogate's output is torque at the joints
                feedforward = self.problem.robot.joint_effort(feedforward)
        return Reference(*paths, known_torque=known, feedforward=feedforward)

    def _chunks(self) -> Iterator[tuple[int, int]]:
        return ((a, min(self.instants, a + CHUNK)) for a in range(0, self.instants, CHUNK))

    def _simulated(self, beta: Array) -> tuple[Array | None, str | None]:
        """q, dq, ddq, tau (4, K, n) of the closed loop at all steps, or None and why."""
        gains, reason = self.gains(beta)
        if reason is not None:
            return None, reason
        hz, rate_hz = self.problem.signals.robot.bandwidth_hz, 1 / self.period_s
        loop = (
            self.loop.scaled(gains)
            if self.loop
            else surrogate_loop(hz, gains * self.prior, rate_hz)
        )
        begin = self.low_passed(self.problem.motion, slice(0, 1))
        start, path = (
            (begin.q[0], begin.dq[0]),
            allocate((4, self.instants * self.substeps, len(gains))),
        )
        robot = ClosedLoop(
            self.model(beta), loop, start, fastest=self.fastest, substeps=self.substeps
        )
        for first, last in self._chunks():
            part, reason = robot.follow(self.reference(first, last), self.bound)
            if reason is not None:
                return None, reason
            path[:, first * self.substeps : last * self.substeps] = part
            if self.instants > CHUNK:
                release_pages(path)
        return path, None

    def _block(self, at: RowBlock, path: Array | None, predicted: DirectModel) -> MotionBlock:
        """A block of a simulated path, linear between steps, or of the predicted motion."""
        span, problem = self.samples(at), self.problem
        if path is None:
            x = self.low_passed(predicted_motion(problem), span)
            given = {**vars(x), "tau": predicted.torque(x.q, x.dq, x.ddq)}
            return MotionBlock(**given, at=at, decimation=self.decimation)
        k, fs, last = (
            np.arange(span.start, span.stop),
            problem.signals.sample_rate_hz,
            path.shape[1] - 1,
        )
        steps = k * (self.stride / fs * (self.substeps / self.period_s))
        low = np.minimum(np.floor(steps + 1e-6).astype(np.intp), last)  # the last one is repeated
        share, found = (steps - low)[:, None], path[:, low]
        if np.abs(share).max() > 1e-6:
            found += share * (path[:, np.minimum(low + 1, last)] - found)
        if self.instants > CHUNK:
            release_pages(path)
        (q, dq, ddq, tau), t_s = found, (self.first + self.stride * k) / fs
        return MotionBlock(t_s=t_s, q=q, dq=dq, ddq=ddq, tau=tau, at=at, decimation=self.decimation)
