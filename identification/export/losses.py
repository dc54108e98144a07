"""What a format cannot say of a robot, and what that costs: the torque that is missing at random states within its limits.

Friction that a format cannot say is replaced by the nearest that it can: Fv u + Fc sign(u) of each joint, and of each motor
that turns with several joints where the format has such, none negative.
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
    """The mechanism as a format with or without rotors (armatures) and couplings of motors can say it, and what is lost.

    Damping and friction loss are refitted, at the states, at joints where some friction has no place; armatures and couplings
    are left out where the format has none; offsets always.
    """
    from scipy.optimize import nnls

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
    kept, n = m.couplings if couplings else (), m.model.robot.n
    # Joints, then motors that turn with several: damping and friction loss (2, k), the torque of each (2, N, k, n).
    rows = np.array([*np.eye(n), *(c.row for c in kept)])
    values = np.array([[*m.damping, *(c.damping for c in kept)], [*m.frictionloss, *(c.frictionloss for c in kept)]])
    u = states.dq @ rows.T
    torques = np.stack([u, np.sign(u)])[..., None] * rows
    below = np.asarray((values < 0).any(axis=0))
    missing = friction - np.einsum("xk,xNkn->Nn", values, torques)
    off = (_rms(missing) > NEGLIGIBLE * _rms(states.tau).max()) | rows[below].any(axis=0)
    off |= rows[rows[:, off].any(axis=1)].any(axis=0)  # joints that share a motor are refitted with it
    again = rows[:, off].any(axis=1)
    if again.any():
        missing += np.einsum("xk,xNkn->Nn", values[:, again], torques[:, :, again])
        A = torques[:, :, again].transpose(1, 3, 0, 2).reshape(missing.size, -1)
        values[:, again] = nnls(A, missing.ravel())[0].reshape(2, -1)
        missing -= np.einsum("xk,xNkn->Nn", values[:, again], torques[:, :, again])
    names = [m.model.names[c] for c in m.others]
    names += [f"{c.name}, which turns with several joints" for c in m.couplings if not kept]
    parts = [*(joint.name for joint in m.model.robot.joints), *(c.name for c in kept)]
    names += [f"below zero of {name} alone" for name, of in zip(parts, below.tolist(), strict=True) if of and kept]
    lose(f"friction ({', '.join(names)}), the nearest damping and friction in its place", missing)
    damping, frictionloss = values
    return replace(
        m,
        armature=m.armature if rotors else np.zeros_like(m.armature),
        damping=damping[:n],
        frictionloss=frictionloss[:n],
        couplings=tuple(
            replace(c, damping=d, frictionloss=f)
            for c, d, f in zip(kept, damping[n:].tolist(), frictionloss[n:].tolist(), strict=True)
        ),
    ), tuple(losses)


def _range(joint: Joint, quantity: str, default: float) -> tuple[float, float]:
    limit = joint.si(quantity)
    if isinstance(limit, tuple):
        return limit
    return (-default, default) if limit is None else (-limit, limit)


def _rms(torque: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(torque**2, axis=0)))
