"""The experiment that a recording is of, laid out for simulation: reference, controller, instants.

The instruments have samples as fine as 100 times the bandwidth, or the recording's rate where that is less, at instants that
the decimated rows of W have too. The robot is simulated in steps as fine as 100 times the bandwidth, whatever the rate of
recording and controller. Everything is made block by block, as the rows are: of a long recording no whole motion is held.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from acquisition.files import let_go
from acquisition.robot import Joint

from ..arrays import Array
from ..errors import IdentificationError
from ..model import direct_model, inertias, pose_step
from ..regression import (
    BLOCK_SAMPLES,
    SPLINE_REACH,
    Decimation,
    Motion,
    Problem,
    RowBlock,
    differentiate,
    largest_of_type,
    row_blocks,
    rule_cutoff_hz,
    sampled_at,
)
from .control_law import ControlLaw, Reference, has_controller, recorded_loop
from .layout import Layout, make_layout

RATE_PER_BANDWIDTH = 100.0  # instrument samples per period of the bandwidth, at least
EARLY_RATE_PER_BANDWIDTH = 25.0  # the same in passes whose estimate is only where the next ones start
LOST = 0.5  # of a joint's travel: a simulation, or a reference, this far off does not belong to the recording
MIN_TRAVEL = (
    0.01  # of the reference, in that of the joint of the same type which travels most: a joint with less is held
)
MIN_SATURATED_PERCENT = 5.0  # share of saturated samples that explains why a robot leaves its reference


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """What every simulation of a recording shares.

    Attributes:
        blocks: of the rows; `layout` the instants, and `decimation` of the instruments to the rows.
        start: measured position and speed, filtered, (n,) each, at the first instant.
        bound: (n,) how far a simulation may leave the reference; `held` (n,), which joints the reference holds;
            `fastest` (c,) speeds of its directions of Coulomb friction.
        scatter: (n,) sum of squares of the measured position, filtered, about its mean.
        poses: (P, n) positions at which M is checked.
        slip_noise: (c,) noise of the speeds of the directions of Coulomb friction.
        loop: the description's control loop, or None where a PD of the stated bandwidth stands in.
        J_prior: (n,) inertias that the loop's gains were set for; `J_known` says that least squares gave them.
        gain_update: whether gains follow the inertias of each estimate.
        long: whether rows are QR factors: no whole motion is kept.
    """

    problem: Problem
    blocks: tuple[RowBlock, ...]
    layout: Layout
    decimation: Decimation
    start: tuple[Array, Array]
    bound: Array
    held: NDArray[np.bool_]
    fastest: Array
    scatter: Array
    poses: Array
    slip_noise: Array
    loop: ControlLaw | None
    J_prior: Array
    J_known: bool
    gain_update: bool
    long: bool

    @property
    def reference_kind(self) -> Literal["recorded", "surrogate"]:
        """`surrogate` for the measured position low-passed without phase shift."""
        return "surrogate" if self.problem.signals.q_ref is None else "recorded"

    @property
    def bandwidth_hz(self) -> float:
        """Of the position loops."""
        return self.problem.signals.robot.bandwidth_hz

    def reference(self, first: int, last: int) -> Reference:
        """What the controller follows from its instant `first` to before `last`."""
        return _reference(self.problem, self.loop, self.layout.places(first, last))

    def samples(self, block: RowBlock) -> slice:
        """The instruments' samples that a block needs."""
        return block.samples(self.layout.N, self.decimation.factor)

    def measured(self, at: slice) -> Array:
        """(N, n) measured position, filtered, at samples of the instruments."""
        return _measured(self.problem, self.layout.of_recording(at)).q[:: self.layout.stride]


def make_experiment(
    problem: Problem,
    beta_ls: Array,
    slip_noise: Array,
    *,
    gain_update: bool = True,
    rate_per_bandwidth: float = RATE_PER_BANDWIDTH,
    long: bool = False,
) -> Experiment:
    """Lay out the simulation of a recording; `beta_ls` gives the inertias that recorded gains are taken to be set for.

    `slip_noise` (c,) is that of the speeds of the directions of Coulomb friction. There are
    `rate_per_bandwidth` simulated steps and instrument samples, at least, per period of the bandwidth.

    Raises `IdentificationError` for a controller described in part, or a reference that is not that of the recording.
    """
    signals, robot = problem.signals, problem.signals.robot
    loop = recorded_loop(robot) if has_controller(robot.controller) else None
    if loop is not None and signals.q_ref is None:
        loop = replace(loop, gravity=True)
    _refuse_foreign_reference(problem)
    bandwidth_hz = robot.bandwidth_hz
    layout, blocks = make_layout(problem, loop, rate_per_bandwidth * bandwidth_hz), tuple(row_blocks(problem))
    decimation = replace(problem.settings.decimator, factor=problem.settings.decimation // layout.stride)
    directions, every = problem.model.coulomb_directions, pose_step(layout.N)
    poses, ends, fastest = list[Array](), list[Array](), np.zeros(len(directions))
    first, total, squares = _measured(problem, layout.of_recording(slice(0, 1))), *np.zeros((2, robot.n))
    for block in blocks:
        own = block.own_samples(layout.N, decimation.factor)
        q = _measured(problem, layout.of_recording(own)).q[:: layout.stride]
        poses.append(q[-own.start % every :: every])
        total, squares = total + (q - first.q[0]).sum(axis=0), squares + ((q - first.q[0]) ** 2).sum(axis=0)
        reference = _reference(problem, loop, layout.places(*layout.around(own)))
        ends += [reference.q.min(axis=0), reference.q.max(axis=0)]
        fastest = np.maximum(fastest, np.abs(reference.dq @ directions.T).max(axis=0, initial=0.0))
    at, travel = np.concatenate(poses), np.ptp(ends, axis=0)
    scale, held = _scales(travel, robot.joints)
    prior = direct_model(problem.model, problem.base.standard_parameters(beta_ls))
    J_prior = inertias(prior, at)
    J_known = bool((J_prior > 0).all())
    if not J_known:  # a PD of the bandwidth takes any; of described gains one knows what inertia they suit
        J_prior = loop.inertias(bandwidth_hz) if loop else np.ones(robot.n)
    return Experiment(
        problem=problem,
        blocks=blocks,
        layout=layout,
        decimation=decimation,
        start=(first.q[0], first.dq[0]),
        bound=LOST * np.maximum(scale, 0.1 * travel.max()),
        held=held,
        fastest=fastest,
        scatter=np.maximum(squares - total**2 / layout.N, 0.0),
        poses=at,
        slip_noise=slip_noise,
        loop=loop,
        J_prior=J_prior,
        J_known=J_known,
        gain_update=gain_update,
        long=long,
    )


def _measured(problem: Problem, samples: slice) -> Motion:
    """The measured motion of samples of the recording, behind the rule's low-pass."""
    cutoff_hz = rule_cutoff_hz(problem.signals.robot.bandwidth_hz, problem.signals.sample_rate_hz)
    return problem.motion.between(samples.start, samples.stop, cutoff_hz)


def _reference(problem: Problem, loop: ControlLaw | None, at: Array) -> Reference:
    """What the loop is given at places `at` (K,), counted in samples: the recorded reference, or the measured motion."""
    signals, settings = problem.signals, problem.settings
    low = max(settings.start, math.floor(at[0]) - SPLINE_REACH)
    high = min(settings.stop, math.ceil(at[-1]) + 1 + SPLINE_REACH)
    at, near = at - low, slice(low, high)
    known = None if signals.known_torque is None else sampled_at(at, signals.known_torque[near])
    if signals.q_ref is None:
        # What was fed forward is in the measured motion already.
        measured = _measured(problem, near)
        return Reference(*(sampled_at(at, x) for x in (measured.q, measured.dq, measured.ddq)), known_torque=known)
    q_ref = np.array(signals.q_ref[near])
    let_go(signals.q_ref)
    dq_ref = differentiate(q_ref, signals.sample_rate_hz)
    paths = (sampled_at(at, x) for x in (q_ref, dq_ref, differentiate(dq_ref, signals.sample_rate_hz)))
    ahead = None
    if signals.feedforward is not None:  # held from sample to sample: a cubic would swing beside a step
        ahead = signals.feedforward[near][np.floor(np.clip(at, 0, len(q_ref) - 1) + 1e-6).astype(np.intp)]
        ahead = (
            signals.robot.joint_effort(ahead) if loop is None else ahead
        )  # a surrogate's output is torque at the joints
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
        let_go(signals.q)
        let_go(signals.q_ref)
    spreads, errors = np.sqrt(np.maximum(squares / N - (total / N) ** 2, 0.0)), np.sqrt(off / N)
    for joint, scale, error in zip(joints, _scales(spreads, joints)[0], errors, strict=True):
        if error <= LOST * scale:
            continue
        place = f"{signals.recording}: reference of joint {joint.name}"
        left = f"{error:.3g} {joint.position_unit} rms off the measured position"
        saturated = saturated_percent(problem)
        if saturated is not None and saturated > MIN_SATURATED_PERCENT:
            raise IdentificationError(
                f"{left}: a drive is saturated in {saturated:.0f} % of the samples",
                place=place,
                expected="a slower motion, within the drives' limits",
            )
        raise IdentificationError(
            f"{left}, where references travel {scale:.3g}", place=place, expected="the reference of this recording"
        )


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
        let_go(signals.effort)
    return 100.0 * saturated / (settings.stop - settings.start)
