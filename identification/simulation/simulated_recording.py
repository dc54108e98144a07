"""A recording whose robot is simulated: the same reference, control law and known torques.

It gives the same blocks of motion as the measured recording, so that the instruments Z are computed
by the function that computes W. Samples are at 100 times the bandwidth or at the recording's rate,
whichever is lower; their instants include those of the decimated rows of W. The robot is simulated
in steps of at least 100 times the bandwidth, at any rate of recording and controller; from 200
times on, a step has several instants of the controller. The motion of a long recording is on disk.

Where the robot cannot be simulated, its motion is the one that the recorded reference predicts,
which needs no control law. The error q - r of a controlled robot is gravity, inertia and friction
through its unknown loop. It is regressed on what these are made of, of the reference alone: 1; sin
and cos of the joints' angles and of sums of consecutive ones; dr, ddr; friction, tanh(dr / 5 % of
its peak); dr^3; each also late, which stands for the loop's lags. q^ = r + that has no noise of the
position, so instruments along it are exogenous by construction. What sticks is not predicted: there
they are less efficient.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from acquisition.files import allocate, release_pages

from ..arrays import Array, Ints
from ..control import FoundLaw, Reference, default_law, law_of_recording
from ..data import Signals
from ..estimation import r_factor
from ..model import DirectModel, direct_model, inertias, why_not_positive
from ..regression import (
    SPLINE_REACH,
    FilteredMotion,
    Motion,
    MotionBlock,
    Problem,
    differentiate,
    lowpass_reach,
    row_blocks,
    rule_cutoff_hz,
    sampled_at,
)
from .closed_loop import ClosedLoop
from .recording_checks import (
    MAX_DEVIATION,
    position_scales,
    refuse_foreign_reference,
    refuse_instants,
    saturated_percents,
)

FINE = 100.0  # samples and steps per period of the bandwidth, at least
COARSE = 25.0  # the same where only the motion that the reference predicts is asked for
CHUNK = 50_000  # instants of the controller that are simulated at a time
# of the motion that the reference predicts
DELAYS_S = (0.0, 0.02, 0.05, 0.1)
SMOOTH = 0.05  # of the peak speed
MIN_SINGULAR = 1e-6  # of columns of norm 1
MOST_SAMPLES = 50_000  # of the regression, evenly spaced
DESIGN_SAMPLES = 10_000  # whose columns are in memory
EDGE = 2  # samples to each side of an acceleration


class SimulatedRecording:
    """A recording, prepared once, in which a robot of any base parameters is simulated.

    Its motion has `N` samples: every `stride`-th of the recording, from its sample `first` on. The
    control loop has `instants`, a period apart, from the same sample on, each with `substeps`
    simulated steps.

    Attributes:
        problem: of the recording, with its samples.
        blocks: of the rows; `decimation` leads from the samples to the rows.
        cutoff_hz: of the rule, of the measured and the predicted motion.
        loop: the control loop, described or found in the recording, or a PD of the stated
            bandwidth.
        saturated: percentage of the samples at each motor's limit, by motor and limit.
        start: the motion at the first instant.
        fastest: (c,) largest speeds of the reference along the directions of Coulomb friction.
        held: which joints (n,) the reference holds.
        bound: (n,) largest deviation of a simulation from the reference.
        prior: (n,) inertias that the loop's gains were set for; `prior_known`: they are those asked
            for. Else described gains imply them, and a PD of the stated bandwidth suits any.
    """

    def __init__(
        self,
        problem: Problem,
        law: FoundLaw | None,
        prior: Array,
        rate_per_bandwidth: float = FINE,
        *,
        gain_update: bool = True,
    ) -> None:
        """`law`: what the recording shows of its control law.

        The recorded gains are assumed to suit the inertias of the base parameters `prior` (b,);
        with `gain_update`, equation (E), they follow each estimate's.

        A period of the bandwidth has at least `rate_per_bandwidth` samples and simulated steps.
        Raises `BadInputError` for an incomplete controller, one whose rate does not fit the
        recording, or a reference of another recording.
        """
        self.problem = problem = problem.with_samples()
        self._gain_update, self.saturated = gain_update, saturated_percents(problem)
        self._late_s = 0.0 if law is None else law.common_delay_s
        refuse_foreign_reference(problem, self.saturated)
        signals, settings, robot = problem.signals, problem.settings, problem.robot
        fs, n_d, hz = signals.sample_rate_hz, settings.decimator.factor, robot.bandwidth_hz
        step_hz, self.cutoff_hz = rate_per_bandwidth * hz, rule_cutoff_hz(signals)
        self.blocks = tuple(row_blocks(problem))
        self.stride = max(
            m for m in range(1, n_d + 1) if n_d % m == 0 and m <= max(1, fs / step_hz)
        )
        self.decimation = replace(settings.decimator, factor=n_d // self.stride)
        self.N = -(-len(settings.used) // self.stride)
        self.first = settings.used.stop - 1 - (self.N - 1) * self.stride
        self.start = problem.motion.between(self.first, self.first + 1, self.cutoff_hz)
        loop = law_of_recording(problem, law)
        M = self.model(prior).inertia(self.problem.poses)
        self.prior = inertias(M)
        self.prior_known = bool((self.prior > 0).all())
        if not self.prior_known:
            self.prior = loop.inertias(hz) if loop is not None else np.ones(robot.n)
        if loop is None:  # a continuous law: it acts at every step
            rate_hz = fs / self.stride
            loop = default_law(hz, self.prior, rate_hz * math.ceil(step_hz / rate_hz - 1e-9))
        self.substeps = max(1, math.ceil(loop.period_s * step_hz - 1e-9))
        duration_s = (self.N - 1) * self.stride / fs
        refuse_instants(problem, loop.period_s, duration_s, self.substeps)
        self.loop = (
            loop if loop.kind == "surrogate" or why_not_positive(M) else loop.slower(M, FINE * hz)
        )
        self.instants = math.floor(duration_s / self.loop.period_s + 1e-6) + 1
        # of a short recording made once
        self._whole = self.reference(0, self.instants) if self.instants <= CHUNK else None
        low, high, fastest = zip(
            *(
                (
                    x.q.min(axis=0),
                    x.q.max(axis=0),
                    np.abs(x.dq @ problem.model.coulomb_directions.T).max(axis=0),
                )
                for _, x in self._inputs()
            ),
            strict=True,
        )
        travel, self.fastest = np.max(high, axis=0) - np.min(low, axis=0), np.max(fastest, axis=0)
        scales, self.held = position_scales(travel, robot.joints)
        self.bound = MAX_DEVIATION * np.maximum(scales, 0.1 * travel.max())

    def simulated(self, beta: Array) -> tuple[Array, Array, str | None]:
        """Simulate the robot of base parameters beta (b,) in closed loop.

        Returns
        -------
        Its path (4, K, n), which is q, dq, ddq, tau at all steps; the factors (n,) on the
        controller's gains, equation (E); and why it cannot be simulated, or where it leaves its
        reference, or None.
        """
        gains, reason = self.gains(model := self.model(beta))
        if reason is not None:
            return np.zeros((4, 0, len(gains))), gains, reason
        loop, start, m = self.loop.scaled(gains), (self.start.q[0], self.start.dq[0]), self.substeps
        robot = ClosedLoop(model, loop, start, fastest=self.fastest, substeps=m)
        path = np.zeros(0) if self._whole else allocate((4, self.instants * m, len(gains)))
        for first, x in self._inputs():
            part, reason = robot.follow(x, self.bound)
            if reason is not None or self._whole:  # the one part of a short recording is its path
                return part, gains, reason
            path[:, first * m : first * m + part.shape[1]] = part
            release_pages(path)
        return path, gains, None

    def motion(self, along: Array | FilteredMotion) -> Iterator[MotionBlock]:
        """Return the motion of a simulated path (4, K, n), or another one with the recorded
        torque, block by block; the path is linear between steps.
        """
        problem, fs = self.problem, self.problem.signals.sample_rate_hz
        for near, inside in self.blocks:
            if isinstance(along, FilteredMotion):
                x = self.low_passed(along, near)
            else:
                k = np.r_[self.decimation.samples(near, self.N)]
                steps = k * (self.stride / fs * (self.substeps / self.loop.period_s))
                # The acceleration is that of the middle of a step; a torque stands for the middle
                # of the controller's instants.
                each = zip((0.0, 0.0, 0.5, self.loop.middle), along, strict=True)
                q, dq, ddq, tau = (_on_lines(steps - early, series) for early, series in each)
                x = Motion(t_s=(self.first + self.stride * k) / fs, q=q, dq=dq, ddq=ddq, tau=tau)
                if self.instants > CHUNK:
                    release_pages(along)
            yield MotionBlock(
                **vars(x), problem=problem, near=near, inside=inside, decimation=self.decimation
            )

    def gains(self, model: DirectModel) -> tuple[Array, str | None]:
        """Return factors (n,) on the controller's gains for the inertias of a robot, and why it
        cannot be simulated, or None.

            K_j <- K_j J_j(beta_k) / J_j(a priori),     J_j = max over the trajectory of M_jj    (E)
        """
        M = model.inertia(self.problem.poses)
        # Computed torque keeps its saturation if the inertias it was set for are unknown.
        follows = self._gain_update and (self.prior_known or not self.loop.computed_torque)
        factors = inertias(M) / self.prior if follows else np.ones(len(self.prior))
        return factors, why_not_positive(M)

    def model(self, beta: Array) -> DirectModel:
        """Return the robot with base parameters (b,)."""
        return direct_model(self.problem.model, self.problem.base.standard_parameters(beta))

    def low_passed(self, of: FilteredMotion, near: slice) -> Motion:
        """Return a motion, low-passed by the rule, at the samples of these rows."""
        samples = range(self.first, self.problem.settings.stop, self.stride)
        at = samples[self.decimation.samples(near, self.N)]
        return of.between(at[0], at[-1] + 1, self.cutoff_hz).part(slice(None, None, self.stride))

    def reference(self, first: int, last: int) -> Reference:
        """Return the loop's inputs from its instant `first` to before `last`: the recorded
        reference, or the measured motion.
        """
        signals, settings = self.problem.signals, self.problem.settings
        fs, m, feedforward = signals.sample_rate_hz, self.loop.periods, None
        # places of the controller's instants in recorded samples; of those in a step the middle
        each = self.first + self.loop.period_s / m * fs * np.arange(first * m, last * m)
        at = each.reshape(-1, m).mean(axis=1)
        low = max(settings.used.start, math.floor(at[0]) - SPLINE_REACH)
        high = min(settings.used.stop, math.ceil(at[-1]) + 1 + SPLINE_REACH)
        at, near = at - low, slice(low, high)
        known = None if signals.known_torque is None else sampled_at(at, signals.known_torque[near])
        if signals.q_ref is None:
            # The measured motion already contains the effect of the feed-forward.
            x = self.problem.motion.between(low, high, self.cutoff_hz)
            paths = x.q, x.dq, x.ddq
        else:
            q = np.array(signals.q_ref[near])
            dq, feedforward = differentiate(q, fs), signals.feedforward
            paths = q, dq, differentiate(dq, fs)
            # before the span the reference stands
            at = at - self._late_s * fs
            if self.instants > CHUNK:
                release_pages(signals.q_ref)
        if feedforward is not None:  # held between samples: a cubic would overshoot
            held = np.minimum(each + 1e-6, settings.used.stop - 1).astype(np.intp)
            feedforward = feedforward[held].reshape(len(at), m, -1).mean(axis=1)
            if self.loop.kind == "surrogate":  # a surrogate's output is torque at the joints
                feedforward = self.problem.robot.joint_effort(feedforward)
        q, dq, ddq = np.split(sampled_at(at, np.hstack(paths)), 3, axis=1)
        return Reference(q, dq, ddq, known_torque=known, feedforward=feedforward)

    def _inputs(self) -> Iterator[tuple[int, Reference]]:
        """The loop's inputs, and the first instant of each part."""
        for first in range(0, self.instants, CHUNK):
            yield first, self._whole or self.reference(first, min(self.instants, first + CHUNK))


def _on_lines(at: Array, x: Array) -> Array:
    """Series x (N, n) at places (K,), on straight lines between their samples; beyond the ends, the
    end samples.
    """
    low = np.clip(at, 0, len(x) - 1).astype(np.intp)
    share = np.clip(at - low, 0, 1)[:, None]
    return np.asarray(x[low] + share * (x[np.minimum(low + 1, len(x) - 1)] - x[low]))


def predicted_motion(problem: Problem) -> FilteredMotion:
    """Return the motion that the reference predicts, made once for its span; the measured one where
    no reference is recorded.
    """
    if (r := problem.signals.q_ref) is None:
        return problem.motion
    span = problem.settings.start, problem.settings.stop
    return problem.motion.once(("predicted", *span), lambda: _predicted(problem.signals, r, *span))


def _predicted(signals: Signals, r: Array, start: int, stop: int) -> FilteredMotion:
    """The motion q^ (N, n) at all samples of a recording, by the errors of those that a low-pass
    lets into its span.
    """
    (N, n), q, fs, found = r.shape, signals.q, signals.sample_rate_hz, allocate(r.shape)
    reach = lowpass_reach(rule_cutoff_hz(signals), fs)
    within = range(max(0, start - reach), min(N, stop + reach))
    late, every = [round(delay_s * fs) for delay_s in DELAYS_S], -(-len(within) // MOST_SAMPLES)
    used = np.array(within[::every])
    peak = np.abs(differentiate(r[used], fs / every)).max(axis=0)

    def columns(at: Ints) -> Array:  # (K, p) at samples (K,), in order
        low = max(0, at[0] - late[-1] - EDGE)
        now = _terms(r[low : at[-1] + 1 + EDGE], peak, fs)
        return np.concatenate(
            [np.ones((len(at), 1)), *(now[np.maximum(at - d, 0) - low] for d in late)], axis=1
        )

    few = max(1, DESIGN_SAMPLES // every)  # of that many samples the terms are made
    blocks = (used[k : k + few] for k in range(0, len(used), few))
    R = r_factor(np.concatenate([r_factor(np.c_[columns(at), q[at] - r[at]]) for at in blocks]))
    size = np.maximum(np.linalg.norm(R[:, :-n], axis=0), np.finfo(float).tiny)
    effects = np.linalg.lstsq(R[:, :-n] / size, R[:, -n:], rcond=MIN_SINGULAR)[0] / size[:, None]
    for at in (np.arange(a, min(N, a + DESIGN_SAMPLES)) for a in range(0, N, DESIGN_SAMPLES)):
        found[at] = r[at] + columns(at) @ effects
        for x in (q, r, found):
            release_pages(x)
    return FilteredMotion(signals, found)


def _terms(r: Array, peak: Array, sample_rate_hz: float) -> Array:
    """What the error is made of, (K, p), of a reference (K, n) with peak speeds (n,)."""
    dr, n = differentiate(r, sample_rate_hz), r.shape[1]
    sums = np.stack([r[:, i:j].sum(axis=1) for i in range(n) for j in range(i + 1, n + 1)], axis=1)
    friction = np.tanh(dr / np.maximum(SMOOTH * peak, np.finfo(float).tiny))
    ddr = differentiate(dr, sample_rate_hz)
    return np.concatenate([np.sin(sums), np.cos(sums), dr, ddr, friction, dr**3], axis=1)
