"""Terms that the model may lack: as those that it has, they are asked for their
columns along a motion.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from acquisition.robot import Joint

from ..arrays import Array
from ..model import DirectModel, JointTerm, direct_model, inertia_unit, torque_of_links
from ..regression import (
    Decimation,
    Motion,
    Problem,
    differentiate,
    fast_for_lag,
    predicted_torque,
    smooth,
    weights_at,
)

MIN_T = 5.0  # deviations, above chance
MIN_TAKEN_PERCENT = 2.0  # of the residual's square
# of a spring where nothing weighs: any slow error correlates with a slow position
MIN_SPRING_TAKEN_PERCENT = 10.0
# of a joint's peak speed: Stribeck friction has fallen to Coulomb friction about there
STRIBECK_SPEED_RATIO = 0.2
STRIBECK, ASYMMETRIC, OFFSET, SPRING = (
    "Stribeck friction",
    "asymmetric friction",
    "offset",
    "spring",
)
ROOT, LOAD, TILT, LAG, DRIFT = "root friction", "load friction", "tilt of gravity", "lag", "drift"
ROTOR, ZERO, CLOCKS = "rotor", "zero", "clock drift"
# at which the torque of the links is computed: smooth, and low-passed to half a sample a row
SAMPLES_A_ROW = 4
DRIVES_A_ROW = 20  # the same for the torque of the model, whose rate counts in the intervals
SELECT_TERMS = "run `robot-identify friction`"


@dataclass(frozen=True, kw_only=True)
class MissingTerm:
    """A term that the model may lack.

    Attributes:
        kind, where: the term, and its joint or axis.
        unit, advice: unit of the coefficient; what to do.
        value, t: its coefficient, also in deviations.
        taken_percent: share of the residual's square that it explains; `together_percent`:
            all columns of its kind.
        moves: largest shift of an essential parameter, in half-widths.
        least_percent: of `taken_percent`, to be large.
        noticed: size of the coefficient that is noticed in nearly every recording; infinite in
            the span of the model.
    """

    kind: str
    where: str
    unit: str
    advice: str
    value: float = 0.0
    t: float = 0.0
    taken_percent: float = 0.0
    together_percent: float = 0.0
    moves: float = 0.0
    least_percent: float = MIN_TAKEN_PERCENT
    noticed: float = np.inf

    @property
    def found(self) -> bool:
        """Whether it is significant and large."""
        large = self.taken_percent > self.least_percent
        if self.kind in (LAG, CLOCKS):  # hardly visible in the residual
            large = self.moves > 1 or (large and self.kind == CLOCKS)
        return abs(self.t) > MIN_T and large

    @property
    def finding(self) -> str:
        """What is wrong, in a few words."""
        return (
            f"{self.kind} "
            f"{self.where}{'' if self.kind in (TILT, LAG, DRIFT, ZERO, CLOCKS) else ' missing'}"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """Terms that are not in the model of a recording, asked for their columns along any motion.

    Attributes:
        problem: of the recording; `beta`: (b,) its base parameters, about which the columns are.
        peak, sliding: (n,) and (c,) largest speeds of the joints, and along the
            directions of Coulomb friction.
        simulated: whether the motion has the torque of a simulated robot that
            follows a recorded reference.
        gains: whether drive gains are identified.
    """

    problem: Problem
    beta: Array
    peak: Array
    sliding: Array
    simulated: bool
    gains: bool

    @cached_property
    def terms(self) -> tuple[MissingTerm, ...]:
        """The terms."""
        return tuple(term for term, _, _ in self._still)

    @cached_property
    def places(self) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """By term its column (k,) and the joints (k, n) whose rows in it are its own: terms of
        other joints share a column.
        """
        acts = np.array([joints != 0 for _, joints, _ in self._still])
        columns, taken = list[int](), list[NDArray[np.bool_]]()
        for joints in acts:
            free = next(
                (i for i, other in enumerate(taken) if not (other & joints).any()), len(taken)
            )
            taken[free:] = [
                joints | (taken[free] if free < len(taken) else False),
                *taken[free + 1 :],
            ]
            columns.append(free)
        return np.array(columns, dtype=np.intp), acts

    @cached_property
    def _still(self) -> list[tuple[MissingTerm, Array, Array]]:
        none = np.zeros((3, self.problem.signals.robot.n))
        still = Motion(
            t_s=np.arange(3) / self.problem.signals.sample_rate_hz,
            q=none,
            dq=none,
            ddq=none,
            tau=none,
        )
        return list(self._torques(self.problem, still, none, 1))

    @cached_property
    def weighs(self) -> NDArray[np.intp]:
        """(g,) places of the base parameters of links that weigh."""
        idm, columns = self.problem.model, self.problem.base.columns
        q = np.sin(np.outer(np.arange(1, 6), np.arange(1, idm.robot.n + 1)))  # some poses
        still = idm.regressor(q, 0 * q, 0 * q)[:, :, columns] * idm.of_links[columns]
        return np.flatnonzero(np.abs(still).max(axis=(0, 1)) > 1e-12 * np.abs(still).max())

    @property
    def at_rest(self) -> slice:
        """The columns (g,) of their torques at rest."""
        first = int(self.places[0].max()) + 1
        return slice(first, first + len(self.weighs))

    def columns(self, problem: Problem, motion: Motion, decimation: Decimation) -> Array:
        """(n, k + g + 1, rows) torque per unit of the terms, weighted, decimated; of the links at
        rest, which changes slowly; and last the rate of the drives' torque, per s.
        """
        w, places, stride = (
            weights_at(problem, motion.t_s),
            self.places[0],
            decimation.factor // SAMPLES_A_ROW,
        )
        drives = self._drives(problem, motion, decimation.factor // DRIVES_A_ROW)
        # Near reversals, friction that rises smoothly looks like a lag.
        fast = fast_for_lag(problem, motion, decimation, self.sliding)
        found = np.zeros((len(w), self.at_rest.stop + 1, decimation.rows(len(motion.t_s))))
        q = decimation.kept(motion.q)
        still = problem.model.regressor(q, 0 * q, 0 * q)[:, :, problem.base.columns[self.weighs]]
        found[:, self.at_rest] = decimation.filtered(w)[:, None] * still.transpose(1, 2, 0)
        for place, (term, acts, torque) in zip(
            places, self._torques(problem, motion, drives, stride), strict=True
        ):
            for j in np.flatnonzero(acts):
                x = torque if torque.ndim == 1 else torque[:, j]
                column = decimation.filtered(acts[j] * w[j] * x)
                found[j, place] = column * fast[j] if term.kind in (LAG, CLOCKS) else column
        found[:, -1] = decimation.filtered(w * self._rate(motion, drives).T)
        return found

    def _drives(self, problem: Problem, x: Motion, stride: int) -> Array:
        """The drives' torque (N, n) along a motion: the model's less the known one."""
        drives = predicted_torque(
            x, problem.model, problem.base, self.beta, stride if problem.settings.filtered else 1
        )
        known = problem.signals.known_torque
        if known is None or not len(known):
            return drives
        return drives - known[np.rint(x.t_s * problem.signals.sample_rate_hz).astype(np.intp)]

    def _rate(self, x: Motion, drives: Array) -> Array:
        """d/dt (N, n) of the torque along a motion, per second."""
        return differentiate(x.tau if self.simulated else drives, 1 / (x.t_s[1] - x.t_s[0]))

    def _torques(
        self, problem: Problem, x: Motion, drives: Array, stride: int
    ) -> Iterator[tuple[MissingTerm, Array, Array]]:
        """Each term, the factors (n,) by which it acts at the joints, and its
        torque (N,) or (N, n).
        """
        robot, idm, base = problem.signals.robot, problem.model, problem.base
        chi, joints, n, efforts = (
            np.zeros(idm.p),
            robot.joints,
            len(robot.joints),
            robot.effort_units,
        )
        chi[base.columns] = self.beta
        links = direct_model(idm, np.where(idm.of_links, chi, 0.0))
        value = {s.name: chi[c] for c, s in enumerate(idm.sources) if isinstance(s, JointTerm)}
        of_links = smooth(partial(_of_links, links), x, stride)
        tau, by_position = of_links[..., 0], of_links[..., 1:]
        load = np.abs(tau)
        weighs = n > 1 and max(np.abs(tau).max(), np.abs(by_position).max()) > 1e-9  # N m
        fs, settings, each = problem.signals.sample_rate_hz, problem.settings, np.eye(n)
        for j, joint in enumerate(joints):
            terms, effort, v, where = joint.terms, efforts[j], x.dq[:, j], f"of joint {joint.name}"
            if (
                {"viscous", "coulomb"} & set(terms)
                and not joint.one_sided
                and "asymmetric" not in terms
            ):
                Fc, Fv = (0.01 * value.get(f"{name}{j + 1}", 0.0) for name in ("Fc", "Fv"))
                yield (
                    MissingTerm(
                        kind=ASYMMETRIC,
                        where=where,
                        unit="% of it",
                        advice=_to_describe(
                            joint, "asymmetric", 'friction = "asymmetric", which includes an offset'
                        ),
                    ),
                    each[j],
                    Fc + Fv * np.abs(v),
                )
            if "offset" not in terms:
                yield (
                    MissingTerm(
                        kind=OFFSET,
                        where=where,
                        unit=effort,
                        advice=_to_describe(joint, "offset", "offset = true"),
                    ),
                    each[j],
                    np.ones_like(v),
                )
            yield (
                MissingTerm(
                    kind=DRIFT,
                    where=where,
                    unit=f"{effort} over the recording",
                    advice="warm the robot up, or record a shorter motion",
                ),
                each[j],
                (x.t_s * fs - settings.start) / (settings.stop - 1 - settings.start),
            )
            yield (
                MissingTerm(
                    kind=SPRING,
                    where=where,
                    unit=f"{effort}/{joint.position_unit}",
                    advice="record its torque (of a spring, a hose or a weight) as known_torque",
                    least_percent=MIN_TAKEN_PERCENT if weighs else MIN_SPRING_TAKEN_PERCENT,
                ),
                each[j],
                x.q[:, j],
            )
            if "stribeck" not in terms:
                v_s = STRIBECK_SPEED_RATIO * max(self.peak[j], 1e-300)
                yield (
                    MissingTerm(
                        kind=STRIBECK,
                        where=where,
                        unit=effort,
                        advice="leave out slow samples by a larger low_speed_percent of "
                        "[identification]",
                    ),
                    each[j],
                    np.sign(v) * np.exp(-((v / v_s) ** 2)),
                )
            unit, per = ("deg", np.pi / 180) if joint.type == "revolute" else ("mm", 1e-3)
            yield (
                MissingTerm(
                    kind=ZERO,
                    where=where,
                    unit=unit,
                    advice="check the zero of its position (home offset 607Ch, zero_deg or zero_m)",
                ),
                np.ones(n),
                per * by_position[:, :, j],
            )
            if not joint.rotor_inertia:
                yield (
                    MissingTerm(
                        kind=ROTOR,
                        where=where,
                        unit=inertia_unit(robot, j),
                        advice="rotor_inertia = true",
                    ),
                    each[j],
                    x.ddq[:, j],
                )
            if "load" not in joint.terms:
                yield (
                    MissingTerm(kind=LOAD, where=where, unit="", advice=SELECT_TERMS),
                    each[j],
                    load[:, j] * np.sign(v),
                )
        # Torque per rad of rotation of gravity about an axis of the base, by the estimated links.
        for axis, about in zip(np.eye(3), "xyz", strict=True):
            if (turned := np.cross(axis, np.array(robot.gravity))).any():
                yield (
                    MissingTerm(
                        kind=TILT,
                        where=f"about {about}",
                        unit="rad",
                        advice="level the base, or set gravity_m_s2",
                    ),
                    np.ones(n),
                    smooth(lambda q, *_, g=turned: links.gravity(q, g), x, stride),
                )
        for along in idm.coulomb_directions:
            j = int(np.flatnonzero(along)[-1])
            if "root" not in joints[j].terms:
                where = (
                    f"of{' the motor of' if np.count_nonzero(along) > 1 else ''} joint "
                    f"{joints[j].name}"
                )
                unit, v = f"{efforts[j]} ({joints[j].position_unit}/s)^-½", x.dq @ along
                yield (
                    MissingTerm(kind=ROOT, where=where, unit=unit, advice=SELECT_TERMS),
                    along,
                    np.sign(v) * np.sqrt(np.abs(v)),
                )
        middle_s = (settings.start + settings.stop - 1) / (2 * fs)
        yield (
            MissingTerm(
                kind=CLOCKS,
                where="between positions and efforts",
                unit="%",
                advice="stamp positions and efforts by one clock",
            ),
            np.ones(n),
            -0.01 * (x.t_s - middle_s)[:, None] * self._rate(x, drives),
        )
        if n > 1 and self.simulated:
            for j in range(n):
                yield (
                    MissingTerm(
                        kind=LAG,
                        where=f"of joint {joints[j].name}",
                        unit="ms",
                        advice="check how its effort is filtered and stamped",
                    ),
                    -1e-3 * each[j],
                    self._rate(x, drives),
                )
        if n > 1 and robot.gain_known and not self.gains:
            # The predicted torque of a drive: the coefficient is its gain relative
            # to the others, less 1.
            for j in range(n):
                yield (
                    MissingTerm(
                        kind="relative gain",
                        where=f"of joint {joints[j].name}",
                        unit="%",
                        advice="check its drive_gain and ratio against those of the other joints",
                    ),
                    0.01 * each[j],
                    drives,
                )


def _of_links(links: DirectModel, q: Array, dq: Array, ddq: Array) -> Array:
    """The links' torque along a motion, and its derivatives by the positions: (N, n, 1 + n)."""
    tau, slopes = torque_of_links(links, (q, dq, ddq))
    return np.concatenate([tau[..., None], slopes[0]], axis=2)


def _to_describe(joint: Joint, term: str, otherwise: str) -> str:
    """How to describe a friction term, in a list of terms or by keys."""
    return (
        f'add "{term}" to its friction'
        if isinstance(joint.friction, tuple)
        else f"describe it as {otherwise}"
    )
