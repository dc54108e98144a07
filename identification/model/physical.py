"""Conditions of physical consistency: rigid bodies, positive rotor inertias, dissipation.

Rotor inertia of each motor, and of each joint alone, is positive: Ia5 - Ia6 if motor 6 also turns
joint 5.

Viscous friction has a positive matrix over the joints that share motors.

Coulomb friction has the power sum_k Fc_k |d_k dq|, which is linear between the planes d_k dq = 0.
So it is positive at all speeds if it is at the corners where the planes meet: Fc5 + Fcm6, Fc6 +
Fcm6 and Fc5 + Fc6 of a wrist whose motor 6 also turns joint 5, and Fc of a joint with its own
motor.

These conditions are exact. With further friction terms, the power at recorded speeds must be
positive instead.
"""

import numpy as np

from ..arrays import Array, Ints
from ..estimation import (
    Consistent,
    PhysicalParameters,
    consistent_parameters,
    pseudo_inertia,
)
from .inverse import LINK, InverseModel, link_columns
from .joint_terms import SHAPES, JointTerm, corner_speeds, spanning
from .parameters import BaseParameters, expected_links

ROTOR_SHARE, FRICTION = 0.1, 0.01  # start values: share of the link's ZZ; N m or N m s
DISSIPATING = ("viscous", "coulomb", *SHAPES)  # constant offsets do not dissipate energy
RESISTING = ("rotor", "viscous", "coulomb")  # terms that simulators have
MIN_SPEED = 0.04  # of a joint's peak speed; the power of friction is not checked below


def friction_power(idm: InverseModel, columns: Ints, dq: Array, load: Array) -> Array:
    """Return the power (k, b) dissipated per unit of b parameters, divided by sum |dq|.

    It is zero for constant offsets.

    Parameters
    ----------
    idm : the robot.
    columns : (b,) columns of the parameters.
    dq : (k, n) speeds, no row all zero.
    load : (k, n) absolute torques of the links, N m or N.
    """
    still, G = np.zeros_like(dq), np.zeros((len(dq), len(columns)))
    for i, column in enumerate(columns):
        term = idm.sources[column]
        if isinstance(term, JointTerm) and term.kind in DISSIPATING:
            for j in term.rows:
                G[:, i] += dq[:, j] * term.entry(j, dq, still, load[:, j])
    return np.asarray(G / np.abs(dq).sum(axis=1)[:, None])


def friction_alone(idm: InverseModel, columns: Ints, j: int, v: Array, load: Array) -> Array:
    """Return friction (k, b) of joint j per unit of b parameters, if only joint j moves.

    Offsets are not included.

    Parameters
    ----------
    idm : the robot.
    columns : (b,) columns of the parameters.
    j : the joint.
    v : (k,) its speeds, not zero.
    load : (k,) absolute torques of the links at it, N m or N.
    """
    alone = np.eye(idm.robot.n)[j]
    return np.asarray(
        np.sign(v)[:, None]
        * friction_power(idm, columns, np.outer(v, alone), np.outer(load, alone))
    )


def shaped_states(idm: InverseModel, dq: Array, load: Array) -> tuple[Array, Array]:
    """Return speeds and loads (m, n) at which the power of further friction terms is checked.

    Joints that share motors move together as recorded, and each joint alone.

    Parameters
    ----------
    idm : the robot.
    dq : (k, n) speeds at some rows, rad/s or m/s.
    load : (k, n) absolute torques of the links at them, N m or N.
    """
    moving = np.abs(dq) > MIN_SPEED * np.abs(dq).max(axis=0, initial=0.0)
    found = [(dq[:0], load[:0])]
    for joints in (group for group, shaped in _groups(idm).items() if shaped):
        for subset in dict.fromkeys([joints, *((j,) for j in joints)]):
            at, these = moving[:, subset].any(axis=1), np.isin(np.arange(idm.robot.n), subset)
            found.append((dq[at] * these, load[at]))
    speeds, loads = (np.concatenate(x) for x in zip(*found, strict=True))
    return speeds, loads


def requirements(idm: InverseModel, *, shaped: bool) -> list[tuple[Array, JointTerm, str]]:
    """Return conditions for rotor inertias, viscous and Coulomb friction.

    Each condition is a matrix (s, s, p), mostly of a single entry, whose product with chi must be
    positive definite; its first parameter, which has the kind and the unit of all; and a text such
    as `Fc5 + Fcm6`.

    For joints with further friction terms there are two cases. If `shaped`, viscous and Coulomb
    friction must be positive without these terms, also of each joint or motor alone. Else there is
    no condition here, and the power is checked.
    """
    groups, (terms, A) = _groups(idm), own_shares(idm)
    alone = {
        j
        for joints, further in groups.items()
        if (shaped if further else len(joints) == 1)
        for j in joints
    }
    found = [
        _single(idm, row)
        for term, row in zip(terms.values(), A, strict=True)
        if term.kind == "rotor" or alone.issuperset(term.rows.tolist())
    ]
    for joints in (g for g, further in groups.items() if len(g) > 1 and not further):
        viscous, coulomb = (_terms(idm, (kind,), joints) for kind in ("viscous", "coulomb"))
        if viscous:
            across = spanning(np.array([term.row for term in viscous.values()]))
            matrix = np.zeros((len(across), len(across), idm.p))
            for c, term in viscous.items():
                matrix[..., c] = across @ term.matrix @ across.T
            names = " and ".join(idm.robot.joints[j].name for j in joints)
            found.append((matrix, next(iter(viscous.values())), f"viscous friction of {names}"))
        if coulomb:
            corners = corner_speeds(np.array([term.direction for term in coulomb.values()]))
            found += [_single(idm, row) for row in corners @ np.eye(idm.p)[list(coulomb)]]
    return found


def physical_parameters(
    idm: InverseModel, prior: InverseModel | None = None, power: Array | None = None
) -> PhysicalParameters:
    """Return the conditions of a physically consistent model on its standard parameters.

    Links have the prior of `expected_links`; rotors and friction have the conditions of
    `requirements`.

    Parameters
    ----------
    idm : the robot.
    prior : another description of it with a priori values; None for its own.
    power : (m, p) friction power per unit of each parameter at `shaped_states`, which must be
        positive. None if no speeds are known: then viscous and Coulomb friction must be positive
        without further terms.
    """
    source = idm if prior is None else prior
    values = np.array([source.robot.parameters.get(name, 0.0) for name in idm.names])
    links, start = link_columns(idm), np.zeros(idm.p)
    start[links] = expected_links(idm, prior)[0]
    terms, A = own_shares(idm)
    first, rows = A @ values, list(terms)
    for i, term in enumerate(terms.values()):
        if first[i] <= 0:
            ZZ = start[links[int(term.rows[-1]), LINK.index("ZZ")]]
            first[i] = ROTOR_SHARE * ZZ if term.kind == "rotor" else FRICTION
    start[rows] = np.linalg.solve(A[:, rows], first) if len(rows) else first
    matrices = [matrix for matrix, *_ in requirements(idm, shaped=power is None)]
    single = np.array([M[0, 0] for M in matrices if len(M) == 1]).reshape(-1, idm.p)
    if power is not None:
        single = np.concatenate([single, power[power @ start > 0]])
    return PhysicalParameters(
        links=links,
        prior=pseudo_inertia(start[links]),
        combinations=single,
        matrices=tuple(M for M in matrices if len(M) > 1),
        start=start,
    )


def _terms(
    idm: InverseModel, kinds: tuple[str, ...], joints: tuple[int, ...] | None = None
) -> dict[int, JointTerm]:
    """Return by column the terms of these kinds that act on one of the joints, or on any."""
    return {
        c: term
        for c, term in idm.terms.items()
        if term.kind in kinds and (joints is None or not set(term.rows).isdisjoint(joints))
    }


def _groups(idm: InverseModel) -> dict[tuple[int, ...], bool]:
    """Return groups of joints that share motors, each with a flag for further friction terms."""
    joined = np.eye(idm.robot.n)
    for term in _terms(idm, DISSIPATING).values():
        joined[np.ix_(term.rows, term.rows)] = 1.0
    groups = dict.fromkeys(
        tuple(np.flatnonzero(row).tolist()) for row in np.linalg.matrix_power(joined, idm.robot.n)
    )
    # If joints share motors, one-sided terms count as further terms.
    one_sided = {term.joint for term in idm.terms.values() if term.side}
    return {
        group: bool(_terms(idm, SHAPES, group))
        or (len(group) > 1 and not one_sided.isdisjoint(group))
        for group in groups
    }


def own_shares(idm: InverseModel) -> tuple[dict[int, JointTerm], Array]:
    """Return rotors, viscous and Coulomb friction by column, and the shares (m, p) of each alone.

    A share is the combination of parameters that belongs to one joint or motor alone.
    """
    terms = _terms(idm, RESISTING)
    columns = list(terms)
    own = {
        (s.kind, int(s.rows[0])): c for c, s in terms.items() if len(s.rows) == 1 and s.side == 0
    }
    A = np.zeros((idm.p, idm.p))
    A[columns, columns] = 1.0
    for c, term in terms.items():
        for j in np.flatnonzero(term.given_away):
            A[own[term.kind, int(j)], c] -= term.given_away[j]
    return terms, A[columns]


def _single(idm: InverseModel, row: Array) -> tuple[Array, JointTerm, str]:
    """Return the condition that a combination (p,) of parameters of one kind is positive."""
    terms = [term for c, term in _terms(idm, RESISTING).items() if row[c]]
    text = " ".join(
        f"{'-' if x < 0 else '+'} {'' if abs(x) == 1 else f'{abs(x):.4g} '}{term.name}"
        for x, term in zip(row[row != 0], terms, strict=True)
    ).removeprefix("+ ")
    return row[None, None], terms[0], text


def nearest_consistent(
    model: InverseModel,
    base: BaseParameters,
    beta: Array,
    covariance: Array,
    power: Array | None = None,
) -> Consistent:
    """Find the physically consistent parameters nearest to an estimate.

    Parameters
    ----------
    model, base : the robot and its base parameters.
    beta, covariance : (b,) and (b, b), the estimate.
    power : as in `physical_parameters`.

    Raises
    ------
    NoFitError : they are not found.
    """
    return consistent_parameters(beta, covariance, base.K, physical_parameters(model, power=power))
