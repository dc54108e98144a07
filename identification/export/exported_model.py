"""Standard parameters in the form that simulators use, and the losses of a format.

Formats have the friction Fv u + Fc sign(u) of each joint and, if they have couplings, of each motor
that turns with several joints; no coefficient may be negative. Other terms are left out, and their
torque is reported.
"""

from dataclasses import dataclass

import numpy as np

from acquisition.errors import Location

from .. import model as dynamics
from ..arrays import Array

MIN_EIGENVALUE = 1e-12  # of the scaled pseudo-inertia of a rigid body
STATES, SEED = 1000, 11  # random states
# ± rad or m (per s, s²), for joints without limits.
DEFAULT_LIMITS = {"position": np.pi, "speed": 1.0, "acceleration": 5.0}
MAX_ROUNDING = 1e-9  # relative to the largest rms torque
# By term: rms of the missing torque (n,), and the same in percent of the whole torque.
Losses = dict[str, tuple[Array, Array]]


@dataclass(frozen=True, kw_only=True, eq=False)
class ExportedModel:
    """Values of all standard parameters of a robot of n joints, SI, and their terms by axis.

    The k axes are the joints, and then the motors that turn with several joints.

    Attributes:
        model: inverse dynamic model of the robot.
        chi: (p,) standard parameters.
        links: (n, 10) XX XY XZ YY YZ ZZ MX MY MZ M of each link, about the origin of its frame.
        names: (k,) names of the axes.
        rows: (k, n) speeds of the axes per joint speed.
        armature, damping, frictionloss: (k,) rotor inertia, viscous and Coulomb friction of each
            axis alone.
    """

    model: dynamics.InverseModel
    chi: Array
    links: Array
    names: tuple[str, ...]
    rows: Array
    armature: Array
    damping: Array
    frictionloss: Array


def split_parameters(model: dynamics.InverseModel, chi: Array, place: str) -> ExportedModel:
    """Split the standard parameters chi (p,) of a model into links and axes.

    Ia and Fv of a joint include the share of a motor that turns with it (Ia5 of the TX40 includes
    Ia6), which is subtracted here. The rest may be negative if the joints that share the motor
    dissipate energy together.

    Parameters
    ----------
    model : the robot.
    chi : (p,) standard parameters.
    place : file of the parameters, for errors.

    Raises
    ------
    BadInputError : links are not rigid bodies, rotor inertias are negative, or friction generates
        energy. Simulators do not check this.
    """
    for j, link in enumerate(chi[dynamics.link_columns(model)]):
        Location(place).require(
            dynamics.is_a_body(link, MIN_EIGENVALUE),
            f"link {j + 1}, of joint {model.robot.joints[j].name}",
            text="its inertia is not that of a rigid body with positive mass density",
            advice="Fit again: `robot-identify fit --consistent RECORDING.mcap`",
        )
    for matrix, first, text in dynamics.requirements(model, shaped=False):
        lowest = float(np.linalg.eigvalsh(matrix @ chi)[0])
        Location(place).require(
            not lowest < -MIN_EIGENVALUE,
            text,
            lowest,
            "0 or greater",
            text="it generates energy, which simulators do not check",
            shown=f"{lowest:.4g} {first.unit}",
            advice="Fit again: `robot-identify fit --consistent RECORDING.mcap`",
        )
    return _of_axes(model, chi)


def _of_axes(model: dynamics.InverseModel, chi: Array) -> ExportedModel:
    """Return the terms of joints and motors in chi (p,), by axis.

    Friction that differs by direction has the mean of both directions.
    """
    n = model.robot.n
    terms = [
        (source, chi[c]) for c, source in model.terms.items() if source.kind in dynamics.RESISTING
    ]
    shared = {source.joint: source.row for source, _ in terms if np.count_nonzero(source.row) > 1}
    axis = {motor: n + k for k, motor in enumerate(shared)}
    values = {kind: np.zeros(n + len(shared)) for kind in dynamics.RESISTING}
    for source, value in terms:
        if np.count_nonzero(source.row) > 1:
            values[source.kind][axis[source.joint]] += value
            values[source.kind][:n] -= value * source.given_away
        else:
            values[source.kind][:n] += value * source.row / (2 if source.side else 1)
    return ExportedModel(
        model=model,
        chi=chi,
        links=chi[dynamics.link_columns(model)],
        names=(
            *(joint.name for joint in model.robot.joints),
            *(model.robot.motors[motor].name for motor in shared),
        ),
        rows=np.array([*np.eye(n), *shared.values()]),
        armature=values["rotor"],
        damping=values["viscous"],
        frictionloss=values["coulomb"],
    )


def _coupled(term: dynamics.JointTerm) -> bool:
    """Test for friction of a motor that turns with several joints."""
    return term.kind in ("viscous", "coulomb") and int(np.count_nonzero(term.row)) > 1


def random_regressor(m: ExportedModel) -> Array:
    """Return the regressor (N, n, p) at random states, uniform within the limits of the joints.

    Default limits are ±pi, ±1, ±5. The columns of load-dependent friction have the torque of the
    links with these parameters.
    """
    rng, joints, motion = np.random.default_rng(SEED), m.model.robot.joints, list[Array]()
    for quantity, default in DEFAULT_LIMITS.items():
        limits = [joint.si(quantity) or default for joint in joints]
        low, high = np.array([x if isinstance(x, tuple) else (-x, x) for x in limits]).T
        motion.append(low + (high - low) * rng.random((STATES, len(joints))))
    q, dq, ddq = motion
    W, base = m.model.regressor(q, dq, ddq), dynamics.base_parameters(m.model)
    links = W[:, :, base.columns] @ np.where(base.links, base.K @ m.chi, 0.0)
    for c, term in m.model.terms.items():
        if term.kind == "load":
            W[:, term.joint, c] = np.abs(links[:, term.joint]) * np.sign(dq[:, term.joint])
    return W


def representable(m: ExportedModel, *, motors: bool) -> tuple[ExportedModel, Losses]:
    """Return the model with only the terms that a format has, and the losses.

    `motors` is True if the format has armatures and couplings. Friction that differs by direction
    becomes the mean of both. The friction of a joint beside that of a motor that turns with it is
    at least 0.
    """
    n, losses, terms = m.model.robot.n, Losses(), m.model.terms
    W = random_regressor(m)
    whole = np.sqrt(np.mean((W @ m.chi) ** 2, axis=0))

    def add_loss(what: str, missing: Array) -> None:
        rms = np.sqrt(np.mean(missing**2, axis=0))
        rms[rms <= MAX_ROUNDING * whole.max()] = 0.0
        if rms.any():
            losses[what] = rms, 100 * np.divide(rms, whole, out=np.zeros(n), where=whole > 0)

    chi = m.chi.copy()
    for what, kind, lost in (
        ("rotor inertia", "rotor", not motors),
        ("constant offset", "offset", True),
    ):
        columns = [c for c, term in terms.items() if lost and term.kind == kind]
        add_loss(what, W[:, :, columns] @ chi[columns])
        chi[columns] = 0.0
    written = chi.copy()
    for c, term in terms.items():
        if term.kind not in (*dynamics.RESISTING, "offset") or (
            _coupled(term) and (not motors or chi[c] < 0)
        ):
            written[c] = 0.0
        elif term.side:
            ways = [
                k
                for k, x in terms.items()
                if (x.joint, x.kind, abs(x.side)) == (term.joint, term.kind, 1)
            ]
            written[c] = chi[ways].mean()
    axes = _of_axes(m.model, written)
    below = {
        "viscous": np.minimum(axes.damping, 0.0),
        "coulomb": np.minimum(axes.frictionloss, 0.0),
    }
    for c, term in terms.items():
        if term.kind in below and not _coupled(term):
            written[c] -= below[term.kind][term.joint]
    names = [m.model.names[c] for c in np.flatnonzero(written != chi)]
    add_loss(f"friction ({', '.join(names)})", W @ (chi - written))
    return _of_axes(m.model, written), losses


def about_com(link: Array) -> tuple[float, Array, Array]:
    """Return mass, centre of mass (3,), and XX XY XZ YY YZ ZZ (6,) about it.

    `link` (10,) are a link's parameters about the origin of its frame.
    """
    mass = float(link[9])
    com = link[6:9] / mass
    steiner = mass * (com @ com * np.eye(3) - np.outer(com, com))
    return mass, com, np.asarray(link[:6] - steiner[np.triu_indices(3)])
