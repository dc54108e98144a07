"""What the model may lack: columns added to W one by one, each with the share of the residual that it takes.

With z = c - Q (QᵀW)⁻ᵀ Wᵀc, a column c made orthogonal to W by the instruments' span Q, its coefficient is g = zᵀrho / zᵀc.
Its deviation is that of the scores z rho' / zᵀc by equal-weighted cosines, rho' being the residual with the column, over the
share of it that estimate and column leave of white noise: a slow column takes out much of what the cosines look at. Along
instruments c is the column of the simulated motion, so that noise of the position does not bias g.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from acquisition.robot import Joint

from ..arrays import Array
from ..estimation import deviations_of_sums
from ..model import JointTerm, direct_model
from ..regression import Decimation, Motion, known_torque_rows
from .evidence import Evidence, RecordingData
from .lag import simulated_rates
from .lines import TrustLine

MIN_T = 5.0  # deviations that chance does not explain
TAKEN_PERCENT = 2.0  # of the residual's square
SPRING_TAKEN_PERCENT = 10.0  # the same for a spring: slow errors of any origin follow a slow position a little
SLOW = 0.2  # of a joint's peak speed: Stribeck friction has fallen to Coulomb friction about there
STRIBECK, ASYMMETRIC, OFFSET, SPRING = "Stribeck friction", "asymmetric friction", "offset", "spring"
ROOT, LOAD, TILT, LAG, DRIFT = "root friction", "load friction", "tilt of gravity", "lag", "drift"
SELECT = "run `robot-identify friction`"
ALIKE_PERCENT = 2.0  # of the residual's square: kinds that take as much cannot be told apart
MIN_INDEPENDENT_NORM = 0.02  # share of a column's norm that W must not contain for its coefficient to say anything


@dataclass(frozen=True, eq=False)
class _Column:
    """A torque (T, n) that the model lacks, per unit of its coefficient, the joint or axis it belongs to, and what to do."""

    kind: str
    where: str
    torque: Array
    unit: str
    advice: str


@dataclass(frozen=True, kw_only=True, eq=False)
class MissingTerm:
    """What the model may lack.

    Attributes:
        column: what it is.
        value, t: its coefficient, and that in deviations.
        taken_percent: share of the residual's square that it takes; `together_percent` that of all columns of its kind.
        moves: half-widths by which it moves the essential parameter that it moves most.
    """

    column: _Column
    value: float
    t: float
    taken_percent: float
    together_percent: float
    moves: float

    @property
    def found(self) -> bool:
        """Whether chance does not explain it, and it matters."""
        if self.column.kind == LAG:  # it hardly shows in the residual
            return abs(self.t) > MIN_T and self.moves > 1
        least = SPRING_TAKEN_PERCENT if self.column.kind == SPRING else TAKEN_PERCENT
        return abs(self.t) > MIN_T and self.taken_percent > least


def added_columns_test(evidence: Evidence) -> TrustLine:
    """Whether the model lacks something: a friction, an offset, drift, a spring, tilt of gravity, a gain."""
    name = "added columns"
    evidence = evidence.with_rows
    terms = missing_terms(evidence)
    if not terms:
        return TrustLine(name, "not made", "not made: the model contains all that is tried")
    found = [term for term in terms if term.found]
    first = max(found or terms, key=_rank)
    column = first.column
    strongest = f"{column.kind} {column.where} {first.value:.3g} {column.unit}".rstrip()
    strongest += f" (t {first.t:.1f}) takes {first.taken_percent:.1f} % of the residual"
    if not found:
        return TrustLine(
            name, "ok", f"none of {len(terms)} matters; the first, {strongest}{_untried(evidence)}", first.t
        )
    more = f"; {len(found) - 1} more beyond t = {MIN_T:g}" if len(found) > 1 else ""
    finding = f"{column.kind} {column.where}{'' if column.kind in (TILT, LAG, DRIFT) else ' missing'}"
    return TrustLine(name, "caution", f"{strongest}{more}: {column.advice}", first.t, finding=finding)


def _untried(evidence: Evidence) -> str:
    """Why relative gains were not tried, where they were not."""
    robot = evidence.problem.signals.robot
    if robot.n == 1:
        return "; one joint has no relative gain"
    return "" if robot.gain_known else "; relative gains not tried: the drive gains are not known"


def _rank(term: MissingTerm) -> tuple[float, float]:
    """What comes first. Several joints may lack the same: kinds count as a whole, or one that acts on all joints would lead.

    Asymmetric Coulomb friction is an offset as well: where both take as much, the description of the former has both. A tilt
    of gravity follows the position, as springs do.
    """
    ahead = ALIKE_PERCENT if term.column.kind in (ASYMMETRIC, TILT) else 0.0
    behind = 0.5 if term.column.kind == SPRING else 1.0
    return behind * term.together_percent + ahead, term.taken_percent


def missing_terms(evidence: Evidence) -> tuple[MissingTerm, ...]:
    """All columns that can be told apart from W, not of reduced rows.

    Stribeck friction below zero is none: near standstill filters and elasticity round off the sign of the speed.
    """
    columns = list(_columns(evidence))
    if not columns:
        return ()
    rows, Q, bread = evidence.rows, evidence.estimate.Q, evidence.estimate.bread
    n = evidence.observed.tau.shape[1]
    C = np.stack([column.torque.T.reshape(-1) for column in columns], axis=1) * rows.weight[:, None]  # (r, k)
    z = C - Q @ (bread.T @ (rows.W.T @ C))  # zᵀW = 0
    seen = np.linalg.norm(z, axis=0) > MIN_INDEPENDENT_NORM * np.linalg.norm(C, axis=0)
    seen &= np.linalg.norm(C, axis=0) > 0
    C, z, columns = C[:, seen], z[:, seen], [column for column, s in zip(columns, seen, strict=True) if s]
    size = np.einsum("rk,rk->k", z, C)
    g = z.T @ rows.rho / size
    rho = rows.rho[:, None] - g * (C - rows.W @ (bread @ (Q.T @ C)))  # with the column, and beta solved anew
    by_joint = (n, -1, len(columns))
    sigma = deviations_of_sums(z.reshape(by_joint), rho.reshape(by_joint), Q, evidence.observed.parts) / np.abs(size)
    whole = max(float(rows.rho @ rows.rho), 1e-300)
    counts = np.array([name in evidence.essential for name in evidence.estimate.names])
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = np.nan_to_num(np.abs(bread @ (Q.T @ C) * g) / evidence.intervals.half[:, None]) * counts[:, None]
    taken = 100 * (1 - np.einsum("rk,rk->k", rho, rho) / whole)
    together = {}
    for kind in {column.kind for column in columns}:
        own = np.array([column.kind == kind for column in columns])
        apart = C[:, own] - rows.W @ (bread @ (Q.T @ C[:, own]))
        left = rows.rho - apart @ np.linalg.lstsq(z[:, own].T @ C[:, own], z[:, own].T @ rows.rho, rcond=1e-6)[0]
        together[kind] = 100 * (1 - float(left @ left) / whole)
    return tuple(
        MissingTerm(
            column=column,
            value=float(value),
            t=float(value / s) if s > 0 else 0.0,
            taken_percent=float(percent),
            together_percent=together[column.kind],
            moves=float(moves),
        )
        for column, value, s, percent, moves in zip(columns, g, sigma, taken, moved.max(axis=0), strict=True)
        if column.kind != STRIBECK or value > 0
    )


def _motion(part: RecordingData, method: str) -> tuple[Motion, Decimation]:
    """The motion that columns are made of, and its decimation to the rows: simulated along instruments, else measured."""
    settings = part.problem.settings
    if method == "iv" and part.simulated is not None and part.decimation is not None:
        return part.simulated, part.decimation
    return part.problem.motion.between(settings.start, settings.stop, settings.cutoff_hz), settings.decimator


def _columns(evidence: Evidence) -> Iterator[_Column]:
    problem = evidence.problem
    robot, idm, base = problem.signals.robot, problem.model, problem.base
    chi = np.zeros(idm.p)
    chi[base.columns] = evidence.estimate.among(evidence.recordings[0].parameters)
    n, T = robot.n, len(evidence.observed.tau)
    time = np.concatenate([np.linspace(0.0, 1.0, rows) for rows in evidence.observed.parts])
    speed, slow, position = (np.concatenate(x) for x in zip(*_speeds(evidence), strict=True))
    value = {s.name: chi[c] for c, s in enumerate(idm.sources) if isinstance(s, JointTerm)}
    for j, joint in enumerate(robot.joints):
        only, effort, where = np.eye(n)[j], robot.effort_units[j], f"of joint {joint.name}"
        resists = "viscous" in joint.terms or "coulomb" in joint.terms
        if resists and not joint.one_sided and "asymmetric" not in joint.terms:
            resisting = value.get(f"Fc{j + 1}", 0.0) + value.get(f"Fv{j + 1}", 0.0) * speed[:, j]
            yield _Column(
                ASYMMETRIC,
                where,
                0.01 * np.outer(resisting, only),
                "% of it",
                _to_describe(joint, "asymmetric", 'friction = "asymmetric", which has an offset too'),
            )
        if "offset" not in joint.terms:
            advice = _to_describe(joint, "offset", "offset = true")
            yield _Column(OFFSET, where, np.tile(only, (T, 1)), effort, advice)
        yield _Column(
            DRIFT,
            where,
            np.outer(time, only),
            f"{effort} over the recording",
            "warm the robot up, or record a shorter motion",
        )
        yield _Column(
            SPRING,
            where,
            np.outer(position[:, j], only),
            f"{effort}/{joint.position_unit}",
            "record its torque, of a spring, a hose or a weight, as known_torque",
        )
        if "stribeck" not in joint.terms:
            yield _Column(
                STRIBECK,
                where,
                np.outer(slow[:, j], only),
                effort,
                "leave out slow rows by a larger --low-speed-percent",
            )
    yield from _tilts(evidence, chi, position)
    yield from _frictions(evidence, chi)
    if (
        n > 1
        and evidence.method == "iv"
        and all(x.simulated and x.reference == "recorded" for x in evidence.recordings)
    ):
        yield from _lags(evidence)
    if n > 1 and robot.gain_known:
        yield from _gains(evidence)


def _speeds(evidence: Evidence) -> Iterator[tuple[Array, Array, Array]]:
    """Of each recording |dq|, what Stribeck friction has more at low speed, and positions: decimated, (rows, n)."""
    motions = [_motion(part, evidence.method) for part in evidence.recordings]
    fastest = np.max([np.abs(motion.dq).max(axis=0) for motion, _ in motions], axis=0)
    for motion, decimation in motions:
        slow = np.sign(motion.dq) * np.exp(-((motion.dq / (SLOW * np.maximum(fastest, 1e-300))) ** 2))
        speed, slowly = (decimation.filtered(x.T).T for x in (np.abs(motion.dq), slow))
        yield speed, slowly, decimation.kept(motion.q)


def _to_describe(joint: Joint, term: str, otherwise: str) -> str:
    """What to do for a friction term, of a joint whose terms are a list or go by keys."""
    return f'add "{term}" to its friction' if isinstance(joint.friction, tuple) else f"describe it as {otherwise}"


def _tilts(evidence: Evidence, chi: Array, q: Array) -> Iterator[_Column]:
    """Torque per rad that gravity is turned by about the base's x and y; of what the estimate tells of the links alone."""
    robot, idm = evidence.problem.signals.robot, evidence.problem.model
    links = np.where(idm.of_links, chi, 0.0)
    gravity = np.array(robot.gravity)
    for axis, about in zip(np.eye(3), "xyz", strict=True):
        turned = np.cross(axis, gravity)
        if not turned.any():
            continue
        torque = direct_model(idm, links).gravity(q, along=turned)
        yield _Column(TILT, f"about {about}", torque, "rad", "level the base, or set gravity_m_s2")


def _frictions(evidence: Evidence, chi: Array) -> Iterator[_Column]:
    """Friction by the root of speed along each direction of Coulomb friction, and by the load of each joint."""
    robot, idm = evidence.problem.signals.robot, evidence.problem.model
    links = direct_model(idm, np.where(idm.of_links, chi, 0.0))
    roots, loads = list[Array](), list[Array]()
    for part in evidence.recordings:
        motion, decimation = _motion(part, evidence.method)
        slip = motion.dq @ idm.coulomb_directions.T
        rigid = links.torque(motion.q, motion.dq, motion.ddq)
        roots.append(decimation.filtered((np.sign(slip) * np.sqrt(np.abs(slip))).T).T)
        loads.append(decimation.filtered((np.abs(rigid) * np.sign(motion.dq)).T).T)
    root, load = np.concatenate(roots), np.concatenate(loads)
    for along, column in zip(idm.coulomb_directions, root.T, strict=True):
        joint = robot.joints[int(np.flatnonzero(along)[-1])]
        where = f"of joint {joint.name}" if np.count_nonzero(along) == 1 else f"of the motor of joint {joint.name}"
        if "root" not in joint.terms:
            unit = f"{robot.effort_units[int(np.flatnonzero(along)[-1])]} ({joint.position_unit}/s)^-½"
            yield _Column(ROOT, where, np.outer(column, along), unit, SELECT)
    for j, joint in enumerate(robot.joints):
        if "load" not in joint.terms:
            torque = np.outer(load[:, j], np.eye(robot.n)[j])
            yield _Column(LOAD, f"of joint {joint.name}", torque, "", SELECT)


def _lags(evidence: Evidence) -> Iterator[_Column]:
    """The torque's rate of each joint, in fast rows: beside reversals friction that rises smoothly looks like a lag."""
    rates, robot = list[Array](), evidence.problem.signals.robot
    for part in evidence.recordings:
        rate, fast = simulated_rates(part)
        rates.append((-1e-3 * rate * fast).T)
    for j, joint in enumerate(robot.joints):
        torque = np.outer(np.concatenate(rates)[:, j], np.eye(robot.n)[j])
        advice = "look at how its effort is filtered or stamped"
        yield _Column(LAG, f"of joint {joint.name}", torque, "ms", advice)


def _gains(evidence: Evidence) -> Iterator[_Column]:
    """Torque of each joint's drive that the estimate predicts: the coefficient is its gain over that of the others, less 1."""
    observed, names = evidence.observed, evidence.observed.system.names
    predicted = observed.predicted(evidence.estimate.among(names))
    predicted = predicted - np.concatenate([known_torque_rows(part.problem) for part in evidence.recordings])
    for j, joint in enumerate(evidence.problem.signals.robot.joints):
        yield _Column(
            "relative gain",
            f"of joint {joint.name}",
            0.01 * np.where(np.arange(predicted.shape[1]) == j, predicted, 0.0),
            "%",
            "check its drive_gain and ratio against those of the other joints",
        )
