"""A recording whose robot is simulated: the same reference, control law and external torques.

It has the same blocks of motion as the measured recording, so that the instruments Z are computed
by the function that computes W. Samples are at 100 times the bandwidth or at the recording's rate,
whichever is lower; their instants include those of the decimated rows of W. The robot is simulated
in steps of at least 100 times the bandwidth, at any rate of recording and controller. From 200
times on, a step has several instants of the controller. The motion of a long recording is on disk.

Some mistakes are refused first: a reference of another recording, and drives at their limits.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from acquisition.errors import BadInputError, Location
from acquisition.files import allocate, release_pages
from acquisition.robot import Joint

from ..arrays import Array, Bools
from ..control import SATURATED, FoundLaw, Reference, default_law, law_of_recording
from ..model import DirectModel, direct_model_of_base, inertias, why_not_positive
from ..regression import (
    BLOCK_SAMPLES,
    SPLINE_REACH,
    FilteredMotion,
    Motion,
    MotionBlock,
    Problem,
    differentiate,
    largest_of_type,
    row_blocks,
    rule_cutoff_hz,
    sampled_at,
)
from .closed_loop import ClosedLoop

FINE = 100.0  # samples and steps per period of the bandwidth, at least
COARSE = 25.0  # the same if only the motion is needed that the reference predicts
CHUNK = 50_000  # instants of the controller that are simulated at a time
MAX_DEVIATION = 0.5  # of a joint's travel: largest distance of simulation or reference
MIN_TRAVEL = 0.01  # of the largest travel of a joint of the same type; with less it is held
MIN_INSTANTS = 30  # of the controller
MAX_STEPS = 2e7  # of a simulation; more indicate a mistake in the description
MIN_SATURATED_PERCENT = 5.0  # of saturated samples, which explain a distance from the reference
# An effort leaves its peaks soon, but stays at a limit: shares of the samples in ranges of these
# widths, thousandths of the peak.
MIN_HELD, MIN_HELD_RATIO, HELD_WIDTHS = 0.01, 3.0, np.array([20, 40, 80])


class SimulatedRecording:
    """A recording, prepared once, in which a robot with any base parameters is simulated.

    Attributes:
        problem: recording with its samples.
        blocks: blocks of the rows.
        decimation: decimation from the simulated samples to the rows.
        N: number of simulated samples.
        stride: step of these in samples of the recording.
        first: first sample of the recording that is simulated.
        cutoff_hz: cut-off of the rule, for the measured and the predicted motion, Hz.
        loop: control law: given, estimated from the recording, or a default PD controller.
        instants: number of steps of the control law.
        substeps: simulated steps in each.
        saturated: percentage of the samples at each motor's limit, by motor and limit.
        start: motion at the first instant.
        fastest: (c,) largest speeds of the reference along the directions of Coulomb friction.
        held: (n,) mask of the joints that the reference holds.
        bound: (n,) largest distance of a simulation from the reference, rad or m.
        prior: (n,) inertias that the gains of the control law were set for.
        prior_known: True if these are those of the requested parameters. Else given gains imply
            them, and a default PD controller suits any.
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
        """Prepare the recording.

        Parameters
        ----------
        problem : the recording.
        law : control law estimated from the recording.
        prior : (b,) base parameters whose inertias the recorded gains are assumed to suit.
        rate_per_bandwidth : smallest number of samples and simulated steps per period of the
            bandwidth.
        gain_update : True if the gains follow the inertias of each estimate, equation (E).

        Raises
        ------
        BadInputError : a controller is incomplete, its rate does not fit the recording, or the
            reference belongs to another recording.
        """
        self.problem = problem = problem.with_samples()
        refuse_foreign_reference(problem)
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
        self._gain_update, self.saturated = gain_update, saturated_percents(problem)
        M = self.model_of(prior).inertia(problem.poses)
        self.prior, not_positive = inertias(M), why_not_positive(M)
        self._late_s = 0.0 if law is None else law.common_delay_s
        loop = law_of_recording(robot, signals, law)
        self.prior_known = bool((self.prior > 0).all())
        if not self.prior_known:
            self.prior = loop.inertias(hz) if loop is not None else np.ones(robot.n)
        # A default controller is continuous: it acts at every step.
        if loop is None:
            rate_hz = fs / self.stride
            loop = default_law(hz, self.prior, rate_hz * math.ceil(step_hz / rate_hz - 1e-9))
        self.substeps = max(1, math.ceil(loop.period_s * step_hz - 1e-9))
        duration_s = (self.N - 1) * self.stride / fs
        refuse_instants(problem, loop.period_s, duration_s, self.substeps)
        self.loop = loop if loop.kind == "surrogate" or not_positive else loop.slower(M, FINE * hz)
        self.instants = math.floor(duration_s / self.loop.period_s + 1e-6) + 1
        self._middle = self.loop.middle
        # The inputs of a short recording are computed once.
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

    def model_of(self, beta: Array) -> DirectModel:
        """Return the equation of motion of the robot with base parameters beta (b,)."""
        return direct_model_of_base(self.problem.model, self.problem.base, beta)

    def simulated(self, beta: Array) -> tuple[Array, Array, str | None]:
        """Simulate the robot with base parameters beta (b,) in closed loop.

        Returns
        -------
        Its path (4, K, n): q, dq, ddq, tau at all steps; the factors (n,) on the controller's
        gains, equation (E); and the reason why it cannot be simulated, or leaves its reference, or
        None.
        """
        (gains, reason), m = self.gains(model := self.model_of(beta)), self.substeps
        if reason is not None:
            return np.zeros((4, 0, len(gains))), gains, reason
        robot = ClosedLoop(
            model,
            self.loop,
            (self.start.q[0], self.start.dq[0]),
            fastest=self.fastest,
            gains=gains,
            substeps=m,
        )
        path = np.zeros(0) if self._whole else allocate((4, self.instants * m, len(gains)))
        for first, x in self._inputs():
            part, reason = robot.follow(x, self.bound)
            if reason is not None or self._whole:  # the one part of a short recording is its path
                return part, gains, reason
            path[:, first * m : first * m + part.shape[1]] = part
            release_pages(path)
        return path, gains, None

    def motion(self, along: Array | FilteredMotion) -> Iterator[MotionBlock]:
        """Yield the motion of a simulated path (4, K, n), or another one, in blocks.

        The path is linear between steps; the other motion has the recorded torque.
        """
        problem, fs = self.problem, self.problem.signals.sample_rate_hz
        for near, inside in self.blocks:
            if isinstance(along, FilteredMotion):
                x = self.low_passed(along, near)
            else:
                k = np.r_[self.decimation.samples(near, self.N)]
                steps = k * (self.stride / fs * (self.substeps / self.loop.period_s))
                # The acceleration is that of the middle of a step, a torque that of the middle of
                # the controller's instants.
                each = zip((0.0, 0.0, 0.5, self._middle), along, strict=True)
                q, dq, ddq, tau = (_on_lines(steps - early, series) for early, series in each)
                x = Motion(t_s=(self.first + self.stride * k) / fs, q=q, dq=dq, ddq=ddq, tau=tau)
                if self.instants > CHUNK:
                    release_pages(along)
            yield MotionBlock(
                **vars(x), problem=problem, near=near, inside=inside, decimation=self.decimation
            )

    def gains(self, model: DirectModel) -> tuple[Array, str | None]:
        """Return the factors (n,) on the controller's gains, by the inertias of a robot.

            K_j <- K_j J_j(beta_k) / J_j(a priori),     J_j = max over the trajectory of M_jj    (E)

        Also return why the robot cannot be simulated, or None.
        """
        M = model.inertia(self.problem.poses)
        # Computed torque keeps its saturation if the inertias it was set for are unknown.
        follows = self._gain_update and (self.prior_known or not self.loop.computed_torque)
        factors = inertias(M) / self.prior if follows else np.ones(len(self.prior))
        return factors, why_not_positive(M)

    def low_passed(self, of: FilteredMotion, near: slice) -> Motion:
        """Return a motion at the samples of these rows, low-passed by the rule."""
        samples = range(self.first, self.problem.settings.used.stop, self.stride)
        at = samples[self.decimation.samples(near, self.N)]
        return of.between(at[0], at[-1] + 1, self.cutoff_hz).part(slice(None, None, self.stride))

    def reference(self, first: int, last: int) -> Reference:
        """Return the loop's inputs at the instants `first` to `last` - 1.

        They follow the recorded reference, or the measured motion without one.
        """
        signals, settings = self.problem.signals, self.problem.settings
        fs, m, feedforward = signals.sample_rate_hz, self.loop.periods, None
        # Places of the controller's instants, in recorded samples; then the middle of each step.
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
            # The delay is applied within these samples, so the reference is at rest before them.
            at = at - self._late_s * fs
            if self.instants > CHUNK:
                release_pages(signals.q_ref)
        # Feed-forward is held between samples, because a cubic spline would overshoot.
        if feedforward is not None:
            held = np.minimum(each + 1e-6, settings.used.stop - 1).astype(np.intp)
            feedforward = feedforward[held].reshape(len(at), m, -1).mean(axis=1)
            # The output of a default controller is a torque at the joints.
            if self.loop.kind == "surrogate":
                feedforward = self.problem.robot.joint_effort(feedforward)
        q, dq, ddq = np.split(sampled_at(at, np.hstack(paths)), 3, axis=1)
        return Reference(q, dq, ddq, known_torque=known, feedforward=feedforward)

    def _inputs(self) -> Iterator[tuple[int, Reference]]:
        """Yield the first instant of each part, and the loop's inputs."""
        for first in range(0, self.instants, CHUNK):
            yield first, self._whole or self.reference(first, min(self.instants, first + CHUNK))


def _on_lines(at: Array, x: Array) -> Array:
    """Return series x (N, n) at places `at` (K,), on straight lines between samples.

    Beyond the ends the end samples are used.
    """
    low = np.clip(at, 0, len(x) - 1).astype(np.intp)
    share = np.clip(at - low, 0, 1)[:, None]
    return np.asarray(x[low] + share * (x[np.minimum(low + 1, len(x) - 1)] - x[low]))


def position_scales(travel: Array, joints: Sequence[Joint]) -> tuple[Array, Bools]:
    """Return scales (n,) of position errors, and a mask of the joints that are held.

    They follow from the `travel` (n,) of the reference.
    """
    # A held joint is pushed by its neighbours, so its own travel is not a scale of errors.
    largest = largest_of_type(travel, joints)
    held = travel < MIN_TRAVEL * largest
    return np.where(held, largest, travel), held


def refuse_foreign_reference(problem: Problem) -> None:
    """Refuse a reference far from the measured position.

    It may be of another recording, or in other units.
    """
    signals, joints = problem.signals, problem.signals.robot.joints
    if signals.q_ref is None:
        return
    first, blocks = (
        signals.q_ref[problem.settings.used.start],
        _blocks(problem, signals.q, signals.q_ref),
    )
    sums = [
        [x.sum(axis=0) for x in (q_ref - first, (q_ref - first) ** 2, (q_ref - q) ** 2)]
        for q, q_ref in blocks
    ]
    mean, square, of_error = np.sum(sums, axis=0) / len(problem.settings.used)
    error = np.sqrt(of_error)
    scale, _ = position_scales(np.sqrt(np.maximum(square - mean**2, 0.0)), joints)
    far = ~(error <= MAX_DEVIATION * scale)
    # A drive at its limit does not follow its reference, which is not a mistake.
    if far.any() and max(saturated_percents(problem).values(), default=0) <= MIN_SATURATED_PERCENT:
        j, unstated = int(far.argmax()), unstated_limits(problem)
        raise BadInputError(
            f"differs from the measured position by {error[j]:.3g} {joints[j].position_unit} rms, "
            f"with a travel of {scale[j]:.3g}{''.join(f'; {limit}' for limit in unstated)}",
            place=f"{signals.recording}: reference of joint {joints[j].name}",
            advice="Specify the saturation of the motor in robot.toml"
            if unstated
            else "Use the reference of this recording",
        )


def saturated_percents(problem: Problem) -> dict[str, float]:
    """Return the percentage of the recorded samples at each motor's limit, by motor and limit.

    It is empty if no limit is given.
    """
    robot, N = problem.signals.robot, len(problem.settings.used)
    at = [
        (np.abs(effort) >= SATURATED * robot.saturation).sum(axis=0)
        for effort in _motor_efforts(problem)
    ]
    return {
        f"{motor.name} ({motor.saturation:.4g} {motor.recorded_unit})": 100.0 * float(k) / N
        for motor, k in zip(robot.motors, np.sum(at, axis=0), strict=True)
        if motor.saturation is not None
    }


def unstated_limits(problem: Problem) -> list[str]:
    """Describe drives that saturate below a given limit, or without one."""
    found, motors = list[str](), problem.signals.robot.motors
    peaks = np.max([np.abs(effort).max(axis=0) for effort in _motor_efforts(problem)], axis=0)
    counts = np.sum(
        [
            [
                np.histogram(x, 1000, (0, peak or 1.0))[0][::-1]
                for x, peak in zip(np.abs(effort).T, peaks, strict=True)
            ]
            for effort in _motor_efforts(problem)
        ],
        axis=0,
    )
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
        if ratio[k] > MIN_HELD_RATIO and limit < 0.99 * (motor.saturation or np.inf):
            found.append(
                f"drive of {motor.name} saturates at {limit:.3g} {motor.recorded_unit} in "
                f"{100 * held[k]:.2g} % of the rows"
            )
    return found


def _motor_efforts(problem: Problem) -> Iterator[Array]:
    """Yield the recorded efforts (K, n) of the motors in the time range used, in blocks."""
    # Efforts are used as recorded, because a spline that corrects a delay would overshoot the
    # limit.
    for (effort,) in _blocks(problem, problem.signals.effort):
        yield problem.signals.robot.motor_effort(effort)


def _blocks(problem: Problem, *series: Array) -> Iterator[list[Array]]:
    """Yield the rows (K, n) of series in the time range used, in blocks."""
    start, stop = problem.settings.start, problem.settings.stop
    for a in range(start, stop, BLOCK_SAMPLES):
        yield [x[a : min(stop, a + BLOCK_SAMPLES)] for x in series]
        if stop - start > BLOCK_SAMPLES:
            for x in series:
                release_pages(x)


def refuse_instants(problem: Problem, period_s: float, duration_s: float, substeps: int) -> None:
    """Refuse a controller with too few instants, or too many steps to simulate."""
    signals, periods = problem.signals, duration_s / period_s
    hz, steps, instants = (
        signals.robot.bandwidth_hz,
        periods * substeps,
        int(periods + 1e-6) + 1,
    )
    for wrong, what, limit in (
        (
            steps > MAX_STEPS,
            f"with bandwidth_hz = {hz:g} a simulation takes {steps:.2g} steps",
            f"at most {MAX_STEPS:.2g} steps",
        ),
        (
            instants < MIN_INSTANTS,
            f"it acts {instants} times in the {duration_s:.3g} s of {signals.recording}",
            f"at least {MIN_INSTANTS} times",
        ),
    ):
        if wrong:
            Location(f"robot {signals.robot.name}").refuse(
                "controller.sample_rate_hz",
                1 / period_s,
                limit,
                text=what,
                shown=f"{1 / period_s:g}",
            )
