"""What a format cannot say of a robot, and what that costs: the torque that is missing at random states within its limits.

Friction that a format cannot say is replaced by the nearest that it can: Fv dq + Fc sign(dq) of each joint, neither negative.
"""

from dataclasses import dataclass, replace

import numpy as np

from acquisition.robot import Joint

from ..arrays import Array
from ..model import JointTerm, base_parameters, direct_model
from ..regression import load_friction
from .mechanism import Mechanism

COUNT, SEED = 1000, 11  # random states
POSITION, SPEED, ACCELERATION = np.pi, 1.0, 5.0  # ± rad or m (per s, s²), where a joint states no limit
NEGLIGIBLE = 1e-9  # of a joint's torque: rounding


@dataclass(frozen=True, kw_only=True, eq=False)
class States:
    """Random states q, dq, ddq (N, n), and the torques tau (N, n) of the whole model there."""

    q: Array
    dq: Array
    ddq: Array
    tau: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Loss:
    """What a format cannot say: rms of the torque that is missing (n,), N m or N, and in percent of the joint's torque."""

    what: str
    rms: Array
    percent: Array


def random_states(m: Mechanism) -> States:
    """Positions, speeds and accelerations spread evenly within the limits of the description, or within ±pi, ±1, ±5."""
    joints, rng = m.model.robot.joints, np.random.default_rng(SEED)

    def within(quantity: str, default: float) -> Array:
        low, high = np.array([_range(joint, quantity, default) for joint in joints]).T
        return np.asarray(low + (high - low) * rng.random((COUNT, len(joints))))

    q, dq, ddq = within("position", POSITION), within("speed", SPEED), within("acceleration", ACCELERATION)
    return States(q=q, dq=dq, ddq=ddq, tau=_regressor(m, q, dq, ddq) @ m.chi)


def _regressor(m: Mechanism, q: Array, dq: Array, ddq: Array) -> Array:
    """The regressor (N, n, p), its columns of load friction for the links' torque of these parameters."""
    W, base = m.model.regressor(q, dq, ddq), base_parameters(m.model)
    load = load_friction(m.model, base)
    if load:
        links = direct_model(m.model, base.standard_parameters(np.where(base.links, base.K @ m.chi, 0.0)))
        friction = np.abs(links.torque(q, dq, ddq)) * np.sign(dq)
        for j, place in zip(load.joints, load.places, strict=True):
            W[:, j, base.columns[place]] = friction[:, j]
    return W


def sayable(m: Mechanism, states: States, *, rotors: bool, couplings: bool) -> tuple[Mechanism, tuple[Loss, ...]]:
    """The mechanism as a format can say it, and what is lost.

    Parameters
    ----------
    m, states : the mechanism, and where to look at its torques.
    rotors : whether the format has armatures.
    couplings : whether it has motors that turn with several joints.

    Returns
    -------
    Damping and friction loss are refitted at joints where some friction has no place; armatures and couplings are left out
    where the format has none; offsets always.
    """
    losses: list[Loss] = []
    W = _regressor(m, states.q, states.dq, states.ddq)
    terms = {c: source for c, source in enumerate(m.model.sources) if isinstance(source, JointTerm)}

    def torque_of(columns: list[int]) -> Array:
        return np.asarray(W[:, :, columns] @ m.chi[columns])

    def lose(what: str, missing: Array) -> None:
        rms, whole = _rms(missing), _rms(states.tau)
        lost = rms > NEGLIGIBLE * whole.max()
        if lost.any():
            percent = 100 * np.divide(rms, whole, out=np.zeros_like(rms), where=whole > 0)
            losses.append(Loss(what=what, rms=np.where(lost, rms, 0.0), percent=np.where(lost, percent, 0.0)))

    of_rotors = [c for c, source in terms.items() if source.kind == "rotor"]
    if not rotors:
        lose("rotor inertia", torque_of(of_rotors))
    lose("constant offset", torque_of([c for c, source in terms.items() if source.kind == "offset"]))
    friction = torque_of([c for c, s in terms.items() if s.kind not in ("rotor", "offset")])
    kept = m.couplings if couplings else ()
    coupled = sum(
        (c.damping * u + c.frictionloss * np.sign(u)) * c.row for c in kept for u in [states.dq @ c.row[:, None]]
    )
    alone = friction - coupled
    damping, frictionloss = m.damping.copy(), m.frictionloss.copy()
    said = damping * states.dq + frictionloss * np.sign(states.dq)
    off = _rms(alone - said) > NEGLIGIBLE * _rms(states.tau).max()
    for j in np.flatnonzero(off):
        damping[j], frictionloss[j] = _nearest_friction(states.dq[:, j], alone[:, j])
    said = damping * states.dq + frictionloss * np.sign(states.dq)
    names = _unsaid_friction(m, couplings=couplings)
    lose(f"friction ({names}), the nearest damping and friction in its place", alone - said)
    armature = m.armature if rotors else np.zeros_like(m.armature)
    return replace(m, damping=damping, frictionloss=frictionloss, armature=armature, couplings=kept), tuple(losses)


def _unsaid_friction(m: Mechanism, *, couplings: bool) -> str:
    names = [m.model.names[c] for c in m.others]
    if not couplings:
        names += [f"{c.name}, which turns with several joints" for c in m.couplings]
    return ", ".join(names)


def _nearest_friction(dq: Array, torque: Array) -> tuple[float, float]:
    """Damping and friction loss, neither negative, whose torque is the nearest."""
    from scipy.optimize import nnls

    (damping, frictionloss), _ = nnls(np.stack([dq, np.sign(dq)], axis=1), torque)
    return float(damping), float(frictionloss)


def _range(joint: Joint, quantity: str, default: float) -> tuple[float, float]:
    limit = joint.si(quantity)
    if isinstance(limit, tuple):
        return limit
    return (-default, default) if limit is None else (-limit, limit)


def _rms(torque: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(torque**2, axis=0)))
