"""Standard parameters in the form that simulators use, and the losses of a format.

Friction that a format cannot represent is approximated by Fv u + Fc sign(u) of each joint and, if the format has couplings, of
each motor that turns with several joints; none is negative.
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

MIN_EIGENVALUE = 1e-12  # of the scaled pseudo-inertia of a physical body
STATES, SEED = 1000, 11  # random states
# ± rad or m (per s, s²), for joints without limit.
DEFAULT_LIMITS = {"position": np.pi, "speed": 1.0, "acceleration": 5.0}
MAX_ROUNDING = 1e-9  # relative to the largest rms torque
Losses = dict[str, tuple[Array, Array]]  # by term: rms of the missing torque (n,), and in percent of the whole torque


@dataclass(frozen=True, kw_only=True, eq=False)
class ExportedModel:
    """Values for all standard parameters of a robot of n joints, SI, and their friction by axis.

    Attributes:
        chi: the standard parameters (p,).
        links: (n, 10) XX XY XZ YY YZ ZZ MX MY MZ M of each link, about the origin of its frame.
        names: of k axes: the joints, then the motors that turn with several joints.
        rows: (k, n); rows dq are the speeds of the axes.
        armature, damping, frictionloss: (k,) of each axis alone.
        others: columns of friction terms that are neither viscous nor dry, or asymmetric.
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
    """Split the standard parameters chi (p,) of a model into links and axes.

    Ia and Fv of a joint include the share of a motor that turns with it (Ia5 of the TX40 includes Ia6): it is subtracted here.
    The rest may be negative if the joints that share the motor together dissipate energy.

    Raises `IdentificationError`, since simulators do not check: a link is no physical body, a rotor inertia is negative, or
    friction generates energy. `place` names the parameters' file.
    """
    n, names = model.robot.n, [joint.name for joint in model.robot.joints]
    terms = {c: source for c, source in enumerate(model.sources) if isinstance(source, JointTerm)}
    plain = {c: source for c, source in terms.items() if source.kind in RESISTING and not source.side}
    shared = {source.joint: source.row for source in plain.values() if np.count_nonzero(source.row) > 1}
    axis = {motor: n + k for k, motor in enumerate(shared)}
    values = {kind: np.zeros(n + len(shared)) for kind in RESISTING}
    for c, source in plain.items():
        if np.count_nonzero(source.row) > 1:
            values[source.kind][axis[source.joint]] += chi[c]
            values[source.kind][:n] -= chi[c] * source.given_away
        else:
            values[source.kind][:n] += chi[c] * source.row
    links = chi[link_columns(model)]
    for j, link in enumerate(links):
        if not is_a_body(link, MIN_EIGENVALUE):
            problem, key = "impossible inertia for a body of positive density", f"link {j + 1}, of joint {names[j]}"
            raise IdentificationError(problem, place=place, key=key, expected="a new fit with --consistent")
    for matrix, first, text in requirements(model, shaped=False):
        lowest = float(np.linalg.eigvalsh(matrix @ chi)[0])
        if lowest < -MIN_EIGENVALUE:
            raise IdentificationError(
                "generates energy, and simulators do not check it",
                place=place,
                key=text,
                value=lowest,
                shown=f"{lowest:.4g} {first.unit}",
                expected="0 or more: a new fit with --consistent",
            )
    return ExportedModel(
        model=model,
        chi=chi,
        links=links,
        names=(*names, *(model.robot.motors[motor].name for motor in shared)),
        rows=np.array([*np.eye(n), *shared.values()]),
        armature=values["rotor"],
        damping=values["viscous"],
        frictionloss=values["coulomb"],
        others=tuple(c for c, source in terms.items() if c not in plain and source.kind != "offset"),
    )


def random_states(robot_joints: tuple[Joint, ...]) -> tuple[Array, Array, Array]:
    """Positions, speeds and accelerations (N, n), uniform within the limits of the joints, by default ±pi, ±1, ±5."""
    rng = np.random.default_rng(SEED)

    def uniform(quantity: str, default: float) -> Array:
        limits = [joint.si(quantity) or default for joint in robot_joints]
        low, high = np.array([limit if isinstance(limit, tuple) else (-limit, limit) for limit in limits]).T
        return np.asarray(low + (high - low) * rng.random((STATES, len(robot_joints))))

    q, dq, ddq = (uniform(quantity, default) for quantity, default in DEFAULT_LIMITS.items())
    return q, dq, ddq


def whole_regressor(m: ExportedModel, q: Array, dq: Array, ddq: Array) -> Array:
    """The regressor (N, n, p); its columns of load friction use the links' torque of these parameters."""
    W, base = m.model.regressor(q, dq, ddq), base_parameters(m.model)
    load = load_friction(m.model, base)
    if load:
        links = direct_model(m.model, base.standard_parameters(np.where(base.links, base.K @ m.chi, 0.0)))
        friction = np.abs(links.torque(q, dq, ddq)) * np.sign(dq)
        for j, place in zip(load.joints, load.places, strict=True):
            W[:, j, base.columns[place]] = friction[:, j]
    return W


def representable(m: ExportedModel, *, rotors: bool, couplings: bool) -> tuple[ExportedModel, Losses]:
    """The model as far as a format with or without rotors (armatures) and motor couplings can represent it, and the losses.

    Damping and friction loss are refitted at random states for joints with other friction. Offsets are left out, and so are
    armatures and couplings if the format has none.
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
    negative = np.asarray((values < 0).any(axis=0))
    kinds = {source.kind for source in m.model.sources if isinstance(source, JointTerm)}
    missing = torque_of(*(kinds - {"rotor", "offset"})) - np.einsum("xk,xNkn->Nn", values, torques)
    refit_joints = (_rms(missing) > MAX_ROUNDING * whole.max()) | rows[negative].any(axis=0)
    # Joints that share a motor are refitted with it.
    refit_joints |= rows[rows[:, refit_joints].any(axis=1)].any(axis=0)
    refit = rows[:, refit_joints].any(axis=1)
    if refit.any():
        missing += np.einsum("xk,xNkn->Nn", values[:, refit], torques[:, :, refit])
        A = torques[:, :, refit].transpose(1, 3, 0, 2).reshape(missing.size, -1)
        values[:, refit] = nnls(A, missing.ravel())[0].reshape(2, -1)
        missing -= np.einsum("xk,xNkn->Nn", values[:, refit], torques[:, :, refit])
    names = [m.model.names[c] for c in m.others]
    names += [f"{name}, which turns several joints" for name in m.names[k:]]
    if k > n:
        names += [f"negative share of {m.names[axis]}" for axis in np.flatnonzero(negative)]
    add_loss(f"friction ({', '.join(names)}), approximated by damping and dry friction", missing)
    armature = m.armature[:k] if rotors else np.zeros(k)
    parts = {"armature": armature, "damping": values[0], "frictionloss": values[1]}
    return replace(m, names=m.names[:k], rows=rows, **parts), losses


def about_com(link: Array) -> tuple[float, Array, Array]:
    """Mass, centre of mass (3,) and XX XY XZ YY YZ ZZ (6,) about it, from a link's parameters (10,) about the origin."""
    mass = float(link[9])
    com = link[6:9] / mass
    steiner = mass * (com @ com * np.eye(3) - np.outer(com, com))
    return mass, com, np.asarray(link[:6] - steiner[np.triu_indices(3)])


def _rms(torque: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(torque**2, axis=0)))
