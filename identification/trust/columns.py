"""Terms that the model may lack: columns added to W one by one, each with the share of the residual that it explains.

With z = c - Q (QᵀW)⁻ᵀ Wᵀc, a column c made orthogonal to W by the instruments' span Q, its coefficient is g = zᵀrho / zᵀc.
Its deviation is that of the scores z rho' / zᵀc by equal-weighted cosines, where rho' is the residual with the column, divided
by the share that estimate and column leave of white noise: a slow column removes much of the low frequencies. With instruments,
c is the column of the simulated motion, so that position noise does not bias g.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from acquisition.robot import Joint

from ..arrays import Array
from ..estimation import deviations_of_sums
from ..model import DirectModel, JointTerm, direct_model
from ..regression import Decimation, Motion, known_torque_rows
from ..report import Method
from .fit_data import FitData, RecordingData
from .lag import simulated_rates
from .lines import TrustLine

MIN_T = 5.0  # deviations, above chance
MIN_TAKEN_PERCENT = 2.0  # of the residual's square
MIN_SPRING_TAKEN_PERCENT = 10.0  # the same for a spring: any slow error correlates with a slow position
STRIBECK_SPEED_RATIO = 0.2  # of a joint's peak speed: Stribeck friction has fallen to Coulomb friction about there
STRIBECK, ASYMMETRIC, OFFSET, SPRING = "Stribeck friction", "asymmetric friction", "offset", "spring"
ROOT, LOAD, TILT, LAG, DRIFT = "root friction", "load friction", "tilt of gravity", "lag", "drift"
SELECT_TERMS = "run `robot-identify friction`"
MAX_TIE_PERCENT = 2.0  # of the residual's square: kinds within this are indistinguishable
MIN_INDEPENDENT_NORM = 0.02  # share of a column's norm outside the span of W, for a usable coefficient


@dataclass(frozen=True, kw_only=True, eq=False)
class MissingTerm:
    """A term that the model may lack.

    Attributes:
        kind, where: the term, and its joint or axis.
        torque: (T, n) per unit of its coefficient.
        unit, advice: unit of the coefficient; what to do.
        value, t: its coefficient, also in deviations.
        taken_percent: share of the residual's square that it explains; `together_percent`: all columns of its kind.
        moves: largest shift of an essential parameter, in half-widths.
    """

    kind: str
    where: str
    torque: Array
    unit: str
    advice: str
    value: float = 0.0
    t: float = 0.0
    taken_percent: float = 0.0
    together_percent: float = 0.0
    moves: float = 0.0

    @property
    def found(self) -> bool:
        """Whether it is significant and large."""
        if self.kind == LAG:  # hardly visible in the residual
            return abs(self.t) > MIN_T and self.moves > 1
        least = MIN_SPRING_TAKEN_PERCENT if self.kind == SPRING else MIN_TAKEN_PERCENT
        return abs(self.t) > MIN_T and self.taken_percent > least


def added_columns_test(evidence: FitData) -> TrustLine:
    """Whether the model lacks a term: friction, an offset, drift, a spring, a tilt of gravity, a gain or a lag."""
    name = "added columns"
    evidence = evidence.with_rows
    terms = missing_terms(evidence)
    if not terms:
        return TrustLine(name, "not made", "not made: the model has every term that is tried")
    found = [term for term in terms if term.found]
    first = max(found or terms, key=_rank)
    strongest = f"{first.kind} {first.where} {first.value:.3g} {first.unit}".rstrip()
    strongest += f", t = {first.t:.1f}, {first.taken_percent:.1f} % of the residual"
    if not found:
        robot = evidence.problem.signals.robot
        untried = "" if robot.gain_known else "; relative gains not tried: the drive gains are not known"
        untried = "; one joint has no relative gain" if robot.n == 1 else untried
        text = f"no missing term found ({len(terms)} tried; strongest: {strongest}){untried}"
        return TrustLine(name, "ok", text, first.t)
    more = f"; {len(found) - 1} more with t above {MIN_T:g}" if len(found) > 1 else ""
    finding = f"{first.kind} {first.where}{'' if first.kind in (TILT, LAG, DRIFT) else ' missing'}"
    return TrustLine(name, "caution", f"{strongest}{more}: {first.advice}", first.t, finding=finding)


def _rank(term: MissingTerm) -> tuple[float, float]:
    """Sort key. Several joints may lack the same term, so all columns of a kind count together.

    Asymmetric Coulomb friction contains an offset, so it wins a tie. A tilt of gravity follows the position, as springs do.
    """
    ahead = MAX_TIE_PERCENT if term.kind in (ASYMMETRIC, TILT) else 0.0
    behind = 0.5 if term.kind == SPRING else 1.0
    return behind * term.together_percent + ahead, term.taken_percent


def missing_terms(evidence: FitData) -> tuple[MissingTerm, ...]:
    """All columns that are independent of W; needs rows that are not reduced.

    Negative Stribeck friction is left out: near standstill, filters and elasticity smooth the sign of the speed.
    """
    columns, n = list(_columns(evidence)), evidence.observed.tau.shape[1]
    rows, Q, bread = evidence.rows, evidence.estimate.Q, evidence.estimate.bread
    C = np.stack([column.torque.T.reshape(-1) for column in columns], axis=1) * rows.weight[:, None]  # (r, k)
    z = C - Q @ (bread.T @ (rows.W.T @ C))  # zᵀW = 0
    independent = np.linalg.norm(z, axis=0) > MIN_INDEPENDENT_NORM * np.linalg.norm(C, axis=0)
    independent &= np.linalg.norm(C, axis=0) > 0
    C, z, columns = (
        C[:, independent],
        z[:, independent],
        [column for column, keep in zip(columns, independent, strict=True) if keep],
    )
    size = np.einsum("rk,rk->k", z, C)
    g = z.T @ rows.rho / size
    rho = rows.rho[:, None] - g * (C - rows.W @ (bread @ (Q.T @ C)))  # with the column, and beta solved again
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
        replace(
            column,
            value=float(value),
            t=float(value / s) if s > 0 else 0.0,
            taken_percent=float(percent),
            together_percent=together[column.kind],
            moves=float(moves),
        )
        for column, value, s, percent, moves in zip(columns, g, sigma, taken, moved.max(axis=0), strict=True)
        if column.kind != STRIBECK or value > 0
    )


def motion_of(part: RecordingData, method: Method) -> tuple[Motion, Decimation]:
    """The motion of the added columns and its decimation: simulated with instruments, else measured."""
    settings = part.problem.settings
    if method == "iv" and part.simulated is not None and part.decimation is not None:
        return part.simulated, part.decimation
    return part.problem.motion.between(settings.start, settings.stop, settings.cutoff_hz), settings.decimator


def _columns(evidence: FitData) -> Iterator[MissingTerm]:
    problem, robot, idm = evidence.problem, evidence.problem.signals.robot, evidence.problem.model
    chi, joints, n, efforts = np.zeros(idm.p), robot.joints, len(robot.joints), robot.effort_units
    chi[problem.base.columns] = evidence.recordings[0].parameters.values(evidence.estimate)
    links = direct_model(idm, np.where(idm.of_links, chi, 0.0))
    time = np.concatenate([np.linspace(0.0, 1.0, rows) for rows in evidence.observed.parts])
    speed, slow, position, root, load = (np.concatenate(x) for x in zip(*_series(evidence, links), strict=True))
    value = {s.name: chi[c] for c, s in enumerate(idm.sources) if isinstance(s, JointTerm)}

    def of_joint(j: int, kind: str, torque: Array, unit: str, advice: str) -> MissingTerm:
        where, torque = f"of joint {joints[j].name}", np.outer(torque, np.eye(n)[j])
        return MissingTerm(kind=kind, where=where, torque=torque, unit=unit, advice=advice)

    for j, joint in enumerate(joints):
        terms, effort = joint.terms, efforts[j]
        if {"viscous", "coulomb"} & set(terms) and not joint.one_sided and "asymmetric" not in terms:
            advice = _to_describe(joint, "asymmetric", 'friction = "asymmetric", which includes an offset')
            resisting = value.get(f"Fc{j + 1}", 0.0) + value.get(f"Fv{j + 1}", 0.0) * speed[:, j]
            yield of_joint(j, ASYMMETRIC, 0.01 * resisting, "% of it", advice)
        if "offset" not in terms:
            yield of_joint(j, OFFSET, np.ones_like(time), effort, _to_describe(joint, "offset", "offset = true"))
        yield of_joint(j, DRIFT, time, f"{effort} over the recording", "warm the robot up, or record a shorter motion")
        advice = "record its torque (of a spring, a hose or a weight) as known_torque"
        yield of_joint(j, SPRING, position[:, j], f"{effort}/{joint.position_unit}", advice)
        if "stribeck" not in terms:
            advice = "leave out slow rows by a larger low_speed_percent of [identification]"
            yield of_joint(j, STRIBECK, slow[:, j], effort, advice)
    # Torque per rad of rotation of gravity about an axis of the base, by the estimated links.
    for axis, about in zip(np.eye(3), "xyz", strict=True):
        if (turned := np.cross(axis, np.array(robot.gravity))).any():
            torque, advice = links.gravity(position, along=turned), "level the base, or set gravity_m_s2"
            yield MissingTerm(kind=TILT, where=f"about {about}", torque=torque, unit="rad", advice=advice)
    for along, column in zip(idm.coulomb_directions, root.T, strict=True):
        j = int(np.flatnonzero(along)[-1])
        if "root" not in joints[j].terms:
            where = f"of{' the motor of' if np.count_nonzero(along) > 1 else ''} joint {joints[j].name}"
            unit = f"{efforts[j]} ({joints[j].position_unit}/s)^-½"
            yield MissingTerm(kind=ROOT, where=where, torque=np.outer(column, along), unit=unit, advice=SELECT_TERMS)
    yield from (
        of_joint(j, LOAD, load[:, j], "", SELECT_TERMS) for j, joint in enumerate(joints) if "load" not in joint.terms
    )
    if (
        n > 1
        and evidence.method == "iv"
        and all(x.simulated and x.reference == "recorded" for x in evidence.recordings)
    ):
        # in fast rows: near reversals, friction that rises smoothly looks like a lag
        late = np.concatenate([(-1e-3 * rate * fast).T for rate, fast in map(simulated_rates, evidence.recordings)])
        advice = "check how its effort is filtered and stamped"
        yield from (of_joint(j, LAG, late[:, j], "ms", advice) for j in range(n))
    if n > 1 and robot.gain_known and not evidence.gains:
        # The predicted torque of a drive: the coefficient is its gain relative to the others, less 1.
        drives = evidence.observed.predicted(evidence.estimate.values_of(evidence.observed.system.names))
        drives = drives - np.concatenate([known_torque_rows(part.problem) for part in evidence.recordings])
        advice = "check its drive_gain and ratio against those of the other joints"
        yield from (of_joint(j, "relative gain", 0.01 * drives[:, j], "%", advice) for j in range(n))


def _series(evidence: FitData, links: DirectModel) -> Iterator[tuple[Array, ...]]:
    """For each recording, decimated (rows, n): |dq|, the Stribeck term, positions, the root of speed along each direction of
    Coulomb friction, and load friction.
    """
    motions = [motion_of(part, evidence.method) for part in evidence.recordings]
    directions = evidence.problem.model.coulomb_directions
    fastest = np.max([np.abs(motion.dq).max(axis=0) for motion, _ in motions], axis=0)
    for motion, decimation in motions:
        slow = np.sign(motion.dq) * np.exp(-((motion.dq / (STRIBECK_SPEED_RATIO * np.maximum(fastest, 1e-300))) ** 2))
        sliding_speed = motion.dq @ directions.T
        root = np.sign(sliding_speed) * np.sqrt(np.abs(sliding_speed))
        load = np.abs(links.torque(motion.q, motion.dq, motion.ddq)) * np.sign(motion.dq)
        rounded = [decimation.filtered(x.T).T for x in (np.abs(motion.dq), slow, root, load)]
        yield rounded[0], rounded[1], decimation.kept(motion.q), *rounded[2:]


def _to_describe(joint: Joint, term: str, otherwise: str) -> str:
    """How to describe a friction term, in a list of terms or by keys."""
    return f'add "{term}" to its friction' if isinstance(joint.friction, tuple) else f"describe it as {otherwise}"
