"""Terms that the model may lack: columns added to W one by one, each with the share of the residual that it explains.

With z = c - Q (QᵀW)⁻ᵀ Wᵀc, a column c made orthogonal to W by the instruments' span Q, its coefficient is g = zᵀrho / zᵀc.
Its deviation is that of the scores z rho' / zᵀc by equal-weighted cosines, where rho' is the residual with the column, divided
by the share that estimate and column leave of white noise: a slow column removes much of the low frequencies. With instruments,
c is the column of the simulated motion, so that position noise does not bias g. Columns have the weights of W.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from acquisition.robot import Joint

from ..arrays import Array
from ..estimation import deviations_of_sums
from ..model import JointTerm, direct_model
from ..regression import Decimation, Motion, predicted_drives, weighted, weights_at
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
MIN_INDEPENDENT_NORM = 0.01  # share of a column's norm outside the span of W, for a usable coefficient


@dataclass(frozen=True, kw_only=True, eq=False)
class MissingTerm:
    """A term that the model may lack.

    Attributes:
        kind, where: the term, and its joint or axis.
        torque: (T, n) per unit of its coefficient, weighted and decimated.
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
    motions = [motion_of(part, evidence.method) for part in evidence.recordings]
    moved = [motion for motion, _ in motions]
    w = [weights_at(part.problem, x.t_s) for part, x in zip(evidence.recordings, moved, strict=True)]
    v_s = STRIBECK_SPEED_RATIO * np.maximum(np.max([np.abs(x.dq).max(axis=0) for x in moved], axis=0), 1e-300)
    load = [np.abs(links.torque(x.q, x.dq, x.ddq)) for x in moved]
    value = {s.name: chi[c] for c, s in enumerate(idm.sources) if isinstance(s, JointTerm)}

    def decimated(series: Sequence[Array], acts: Array) -> Array:
        """(T, n) of a torque (N,) along each motion, at joints with the factors `acts` (n,)."""
        found, each = np.zeros((len(evidence.observed.tau), n)), list(zip(motions, w, series, strict=True))
        for j in np.flatnonzero(acts):
            found[:, j] = np.concatenate([d.filtered(acts[j] * own[j] * x) for (_, d), own, x in each])
        return found

    def of_joint(j: int, kind: str, series: Sequence[Array], unit: str, advice: str) -> MissingTerm:
        where, torque = f"of joint {joints[j].name}", decimated(series, np.eye(n)[j])
        return MissingTerm(kind=kind, where=where, torque=torque, unit=unit, advice=advice)

    for j, joint in enumerate(joints):
        terms, effort, speed = joint.terms, efforts[j], [x.dq[:, j] for x in moved]
        if {"viscous", "coulomb"} & set(terms) and not joint.one_sided and "asymmetric" not in terms:
            advice = _to_describe(joint, "asymmetric", 'friction = "asymmetric", which includes an offset')
            Fc, Fv = (0.01 * value.get(f"{name}{j + 1}", 0.0) for name in ("Fc", "Fv"))
            yield of_joint(j, ASYMMETRIC, [Fc + Fv * np.abs(v) for v in speed], "% of it", advice)
        if "offset" not in terms:
            advice = _to_describe(joint, "offset", "offset = true")
            yield of_joint(j, OFFSET, [np.ones_like(v) for v in speed], effort, advice)
        advice, time = "warm the robot up, or record a shorter motion", [np.linspace(0.0, 1.0, len(v)) for v in speed]
        yield of_joint(j, DRIFT, time, f"{effort} over the recording", advice)
        advice = "record its torque (of a spring, a hose or a weight) as known_torque"
        yield of_joint(j, SPRING, [x.q[:, j] for x in moved], f"{effort}/{joint.position_unit}", advice)
        if "stribeck" not in terms:
            advice = "leave out slow samples by a larger low_speed_percent of [identification]"
            slow = [np.sign(v) * np.exp(-((v / v_s[j]) ** 2)) for v in speed]
            yield of_joint(j, STRIBECK, slow, effort, advice)
        if "load" not in joint.terms:
            yield of_joint(
                j, LOAD, [rigid[:, j] * np.sign(v) for rigid, v in zip(load, speed, strict=True)], "", SELECT_TERMS
            )
    # Torque per rad of rotation of gravity about an axis of the base, by the estimated links.
    for axis, about in zip(np.eye(3), "xyz", strict=True):
        if (turned := np.cross(axis, np.array(robot.gravity))).any():
            each = zip(evidence.recordings, motions, strict=True)
            torques = [weighted(one.problem, x.t_s, links.gravity(x.q, along=turned), d).T for one, (x, d) in each]
            advice = "level the base, or set gravity_m_s2"
            yield MissingTerm(
                kind=TILT, where=f"about {about}", torque=np.concatenate(torques), unit="rad", advice=advice
            )
    for along in idm.coulomb_directions:
        j = int(np.flatnonzero(along)[-1])
        if "root" not in joints[j].terms:
            where = f"of{' the motor of' if np.count_nonzero(along) > 1 else ''} joint {joints[j].name}"
            unit = f"{efforts[j]} ({joints[j].position_unit}/s)^-½"
            sliding = [x.dq @ along for x in moved]
            torque = decimated([np.sign(v) * np.sqrt(np.abs(v)) for v in sliding], along)
            yield MissingTerm(kind=ROOT, where=where, torque=torque, unit=unit, advice=SELECT_TERMS)
    if (
        n > 1
        and evidence.method == "iv"
        and all(x.simulated and x.reference == "recorded" for x in evidence.recordings)
    ):
        # in fast rows: near reversals, friction that rises smoothly looks like a lag
        late = np.concatenate([(-1e-3 * rate * fast).T for rate, fast in map(simulated_rates, evidence.recordings)])
        advice = "check how its effort is filtered and stamped"
        for j in range(n):
            where = f"of joint {joints[j].name}"
            yield MissingTerm(kind=LAG, where=where, torque=late * np.eye(n)[j], unit="ms", advice=advice)
    if n > 1 and robot.gain_known and not evidence.gains:
        # The predicted torque of a drive: the coefficient is its gain relative to the others, less 1.
        each_drives = [predicted_drives(x.problem, x.parameters.values(evidence.estimate)) for x in evidence.recordings]
        drives = np.concatenate([x.sum(axis=2).T for x in each_drives])
        advice = "check its drive_gain and ratio against those of the other joints"
        for j in range(n):
            where, torque = f"of joint {joints[j].name}", 0.01 * drives * np.eye(n)[j]
            yield MissingTerm(kind="relative gain", where=where, torque=torque, unit="%", advice=advice)


def _to_describe(joint: Joint, term: str, otherwise: str) -> str:
    """How to describe a friction term, in a list of terms or by keys."""
    return f'add "{term}" to its friction' if isinstance(joint.friction, tuple) else f"describe it as {otherwise}"
