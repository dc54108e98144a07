"""Standard parameters as simulators take them, and what a format cannot represent of them.

Friction that a format cannot represent is replaced by the nearest that it can: Fv u + Fc sign(u) of each joint, and of each
motor that turns with several joints where the format has such, none negative.
"""

from dataclasses import dataclass, replace

import numpy as np

from acquisition.robot import Joint

from ..arrays import Array
from ..errors import IdentificationError
from ..model import (
    RESISTING,
    InverseModel,
    JointTerm,
    base_parameters,
    direct_model,
    is_a_body,
    link_columns,
    requirements,
)
from ..regression import load_friction

MIN_EIGENVALUE = 1e-12  # eigenvalue of a scaled pseudo-inertia: below it a link is no body
STATES, SEED = 1000, 11  # random states
POSITION, SPEED, ACCELERATION = np.pi, 1.0, 5.0  # ± rad or m (per s, s²), where a joint states no limit
MAX_ROUNDING = 1e-9  # of a joint's torque: rounding
Losses = dict[
    str, tuple[Array, Array]
]  # by what is lost: rms of the torque that is missing (n,), and in percent of all


@dataclass(frozen=True, kw_only=True, eq=False)
class ExportedModel:
    """A robot of n joints with values for all of its standard parameters, SI.

    Attributes:
        chi: the standard parameters (p,).
        links: (n, 10) XX XY XZ YY YZ ZZ MX MY MZ M of each link, about the origin of its frame.
        names: of k axes: the joints, then the motors that turn with several joints.
        rows: (k, n); an axis turns at the speed rows dq.
        armature, damping, frictionloss: (k,) of each axis alone.
        others: columns of friction terms that are neither viscous nor dry, or not the same both ways.
    """

    model: InverseModel
    chi: Array
    links: Array
    names: tuple[str, ...]
    rows: Array
    armature: Array
    damping: Array
    frictionloss: Array
    others: tuple[int, ...]


def split_parameters(model: InverseModel, chi: Array, place: str) -> ExportedModel:
    """Take the standard parameters chi (p,) of a model apart.

    A joint's own Ia, Fv count the share of a motor that turns with it (Ia5 of the TX40 counts Ia6): it is taken off here. What
    is left of friction may be below zero where the joints that share motors feed no energy together.

    Raises `IdentificationError`: where a link is no body, a rotor inertia is negative, or friction feeds energy:
    simulators take that without a word. `place` names the parameters' file.
    """
    n, names = model.robot.n, [joint.name for joint in model.robot.joints]
    terms = {c: source for c, source in enumerate(model.sources) if isinstance(source, JointTerm)}
    plain = {c: source for c, source in terms.items() if source.kind in RESISTING and not source.side}
    shared = {source.joint: source.row for source in plain.values() if np.count_nonzero(source.row) > 1}
    axis = {motor: n + k for k, motor in enumerate(shared)}
    own = {kind: np.zeros(n + len(shared)) for kind in RESISTING}
    for c, source in plain.items():
        if np.count_nonzero(source.row) > 1:
            own[source.kind][axis[source.joint]] += chi[c]
            own[source.kind][:n] -= chi[c] * source.given_away
        else:
            own[source.kind][:n] += chi[c] * source.row
    links = chi[link_columns(model)]
    for j, link in enumerate(links):
        if not is_a_body(link, MIN_EIGENVALUE):
            problem, key = "no body of positive density has these inertias", f"link {j + 1}, of joint {names[j]}"
            raise IdentificationError(problem, place=place, key=key, expected="the fit again with --consistent")
    for matrix, first, text in requirements(model, shaped=False):
        lowest = float(np.linalg.eigvalsh(matrix @ chi)[0])
        if lowest < -MIN_EIGENVALUE:
            raise IdentificationError(
                "a simulator would take it without a word, and gain energy",
                place=place,
                key=text,
                value=lowest,
                shown=f"{lowest:.4g} {first.unit}",
                expected="0 or more: the fit again with --consistent",
            )
    return ExportedModel(
        model=model,
        chi=chi,
        links=links,
        names=(*names, *(model.robot.motors[motor].name for motor in shared)),
        rows=np.array([*np.eye(n), *shared.values()]),
        armature=own["rotor"],
        damping=own["viscous"],
        frictionloss=own["coulomb"],
        others=tuple(c for c, source in terms.items() if c not in plain and source.kind != "offset"),
    )


def random_states(robot_joints: tuple[Joint, ...]) -> tuple[Array, Array, Array]:
    """Positions, speeds and accelerations (N, n), spread evenly within the limits of the joints, or within ±pi, ±1, ±5."""
    rng = np.random.default_rng(SEED)

    def within(quantity: str, default: float) -> Array:
        stated = [joint.si(quantity) or default for joint in robot_joints]
        low, high = np.array([limit if isinstance(limit, tuple) else (-limit, limit) for limit in stated]).T
        return np.asarray(low + (high - low) * rng.random((STATES, len(robot_joints))))

    return within("position", POSITION), within("speed", SPEED), within("acceleration", ACCELERATION)


def whole_regressor(m: ExportedModel, q: Array, dq: Array, ddq: Array) -> Array:
    """The regressor (N, n, p), its columns of load friction for the links' torque of these parameters."""
    W, base = m.model.regressor(q, dq, ddq), base_parameters(m.model)
    load = load_friction(m.model, base)
    if load:
        links = direct_model(m.model, base.standard_parameters(np.where(base.links, base.K @ m.chi, 0.0)))
        friction = np.abs(links.torque(q, dq, ddq)) * np.sign(dq)
        for j, place in zip(load.joints, load.places, strict=True):
            W[:, j, base.columns[place]] = friction[:, j]
    return W


def representable(m: ExportedModel, *, rotors: bool, couplings: bool) -> tuple[ExportedModel, Losses]:
    """The mechanism as far as a format with or without rotors (armatures) and couplings of motors represents it, and losses.

    Damping and friction loss are refitted, at random states, at joints where some friction has no place; armatures and
    couplings are left out where the format has none; offsets always.
    """
    from scipy.optimize import nnls

    n, losses = m.model.robot.n, Losses()
    q, dq, ddq = random_states(m.model.robot.joints)
    W = whole_regressor(m, q, dq, ddq)
    whole = _rms(W @ m.chi)

    def torque_of(*kinds: str) -> Array:
        columns = [c for c, s in enumerate(m.model.sources) if isinstance(s, JointTerm) and s.kind in kinds]
        return np.asarray(W[:, :, columns] @ m.chi[columns])

    def add_loss(what: str, missing: Array) -> None:
        rms = _rms(missing)
        rms[rms <= MAX_ROUNDING * whole.max()] = 0.0
        if rms.any():
            losses[what] = rms, 100 * np.divide(rms, whole, out=np.zeros(n), where=whole > 0)

    if not rotors:
        add_loss("rotor inertia", torque_of("rotor"))
    add_loss("constant offset", torque_of("offset"))
    k = len(m.names) if couplings else n
    rows, values = m.rows[:k], np.array([m.damping[:k], m.frictionloss[:k]])  # (2, k)
    u = dq @ rows.T
    torques = np.stack([u, np.sign(u)])[..., None] * rows  # (2, N, k, n)
    below = np.asarray((values < 0).any(axis=0))
    kinds = {source.kind for source in m.model.sources if isinstance(source, JointTerm)}
    missing = torque_of(*(kinds - {"rotor", "offset"})) - np.einsum("xk,xNkn->Nn", values, torques)
    off = (_rms(missing) > MAX_ROUNDING * whole.max()) | rows[below].any(axis=0)
    off |= rows[rows[:, off].any(axis=1)].any(axis=0)  # joints that share a motor are refitted with it
    again = rows[:, off].any(axis=1)
    if again.any():
        missing += np.einsum("xk,xNkn->Nn", values[:, again], torques[:, :, again])
        A = torques[:, :, again].transpose(1, 3, 0, 2).reshape(missing.size, -1)
        values[:, again] = nnls(A, missing.ravel())[0].reshape(2, -1)
        missing -= np.einsum("xk,xNkn->Nn", values[:, again], torques[:, :, again])
    names = [m.model.names[c] for c in m.others]
    names += [f"{name}, which turns with several joints" for name in m.names[k:]]
    if k > n:
        names += [f"below zero of {name} alone" for name, of in zip(m.names, below.tolist(), strict=True) if of]
    add_loss(f"friction ({', '.join(names)}), the nearest damping and friction in its place", missing)
    armature = m.armature[:k] if rotors else np.zeros(k)
    damping, frictionloss = values
    made = replace(m, names=m.names[:k], rows=rows, armature=armature, damping=damping, frictionloss=frictionloss)
    return made, losses


def about_com(link: Array) -> tuple[float, Array, Array]:
    """Mass, centre of mass (3,) and XX XY XZ YY YZ ZZ (6,) about it, of a link's ten parameters (10,) about the origin."""
    mass = float(link[9])
    com = link[6:9] / mass
    steiner = mass * (com @ com * np.eye(3) - np.outer(com, com))
    return mass, com, np.asarray(link[:6] - steiner[np.triu_indices(3)])


def _rms(torque: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(torque**2, axis=0)))
