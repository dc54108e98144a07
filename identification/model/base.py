"""Base parameters: the fewest parameters that give the inverse dynamic model, found
numerically (Gautier1991).

The torque W chi of a robot never shows all its standard parameters chi. Some columns of W are zero
at every state: what moves no joint, such as the mass of the first link. Others are combinations of
columns: a rotor inertia acts as the link's ZZ does. Which ones they are depends on the robot alone,
so W at random states shows it to rounding. Its columns, of norm one, are factored, W = Q R:

    |R_cc| > 0    column c is independent of the columns before it: a base parameter
    |R_cc| = 0    W_c = W_independent C_c: its parameter is regrouped into others

With W_dependent = W_independent C the torque is W_independent (chi_independent + C chi_dependent),
hence beta = K chi with K = [1 C] in the order of the columns.

Which columns are kept depends on the order. From the base outwards, links first, it gives the names
that the literature uses: ZZ1R, XX2R, ...; R marks a regrouped parameter. Further friction terms,
which a fit may leave out, are kept apart and regrouped with nothing.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..arrays import Array, Bools, Ints
from ..report import is_load
from .inverse import LINK, InverseModel, link_columns
from .joint_terms import SHAPES

STATES = 200  # random ones; 200 n rows are several times the number of columns
TOLERANCE = 1e-9  # of a column's norm: the residual of a dependent column is rounding
MIN_COEFFICIENT = 1e-8  # of C: less is rounding
SEED = 2014


@dataclass(frozen=True, kw_only=True, eq=False)
class BaseParameters:
    """The base parameters beta = K chi of the standard parameters chi.

    Attributes:
        names: (b,) names, with R at the end if other parameters are regrouped into it.
        expressions: (b,) each as a sum of standard parameters.
        units: (b,) SI units (A or V in place of N m where the drive gain is not known).
        columns: (b,) their columns in the regressor: W_base = W_standard[:, columns].
        K: (b, p) regrouping matrix.
        masses: (n,) columns of the links' masses M1 ... Mn.
        links: (b,) whether it is a link's parameter, which may include a rotor inertia, as in ZZ1R.
    """

    names: tuple[str, ...]
    expressions: tuple[str, ...]
    units: tuple[str, ...]
    columns: Ints
    K: Array

    masses: Ints
    links: Bools

    @cached_property
    def b(self) -> int:
        """Number of base parameters."""
        return len(self.names)

    def standard_parameters(self, beta: Array) -> Array:
        """Standard parameters chi (p,) with K chi = beta; all links whose masses are
        free have the same mass.

        Every chi with the same beta gives the same motion.
        """
        # pinocchio divides by masses. Free ones exceed those of beta, so that no
        # regrouped mass becomes zero.
        chi, given = np.zeros(self.K.shape[1]), beta[np.isin(self.columns, self.masses)]
        chi[np.setdiff1d(self.masses, self.columns)] = 1.0 + np.abs(given).max(initial=0.0)
        chi[self.columns] = beta - self.K @ chi
        return chi

    def without(self, names: Collection[str]) -> "BaseParameters":
        """The base parameters without these, which must be friction terms
        that are not regrouped.
        """
        others = [i for i, name in enumerate(self.names) if name not in names]
        return replace(
            self,
            names=tuple(self.names[i] for i in others),
            expressions=tuple(self.expressions[i] for i in others),
            units=tuple(self.units[i] for i in others),
            columns=self.columns[others],
            K=self.K[others],
            links=self.links[others],
        )


def load_parameters(base: BaseParameters) -> tuple[str, ...]:
    """Names of the load friction parameters mu1, mu2, ...; the model is not linear in them."""
    return tuple(filter(is_load, base.names))


def base_parameters(dynamics: InverseModel) -> BaseParameters:
    """Find the base parameters of a robot from its regressor at seeded random
    states, by QR (Gautier1991).
    """
    rng = np.random.default_rng(SEED)
    q, dq, ddq = (rng.uniform(-np.pi, np.pi, size=(STATES, dynamics.robot.n)) for _ in range(3))
    W = dynamics.regressor(q, dq, ddq).reshape(-1, dynamics.p)
    norms = np.linalg.norm(W, axis=0)
    shapes = [c for c, term in dynamics.terms.items() if term.kind in SHAPES]
    # Links from the base outwards, then rotors and friction: these are regrouped
    # into a link's parameter.
    order = sorted(range(dynamics.p), key=lambda c: (not dynamics.of_links[c], c))
    present = [c for c in order if norms[c] > TOLERANCE * norms.max() and c not in shapes]
    independent, regrouping = _regroup(W[:, present] / norms[present], norms, np.array(present))
    # friction shapes are regrouped with nothing
    independent = np.r_[independent, np.array(shapes, dtype=np.intp)]
    K = np.r_[regrouping, np.zeros((len(shapes), dynamics.p))]
    K[np.arange(len(independent)), independent] = 1.0
    by_column = np.argsort(independent)
    K, columns = K[by_column], independent[by_column]
    names = dynamics.names
    return BaseParameters(
        names=tuple(
            names[c] + "R" * bool(np.count_nonzero(row) > 1)
            for c, row in zip(columns, K, strict=True)
        ),
        expressions=tuple(
            _expression(row, int(c), names) for row, c in zip(K, columns, strict=True)
        ),
        units=tuple(dynamics.units[c] for c in columns),
        columns=columns,
        K=K,
        masses=link_columns(dynamics)[:, LINK.index("M")],
        links=dynamics.of_links[columns],
    )


def _regroup(scaled: Array, norms: Array, columns: Ints) -> tuple[Ints, Array]:
    """Independent ones (b,) of the `columns` of a regressor, and what is regrouped into each
    (b, p); `norms` (p,) are those of all columns, `scaled` the columns divided by theirs.
    """
    diagonal = np.abs(np.diag(np.linalg.qr(scaled, mode="r")))
    keep = diagonal > TOLERANCE * diagonal.max()
    independent, dependent = columns[keep], columns[~keep]
    regrouping = np.zeros((len(independent), len(norms)))
    if len(dependent):
        C = np.linalg.lstsq(scaled[:, keep], scaled[:, ~keep])[0]
        C = C * norms[dependent] / norms[independent][:, None]
        C[np.abs(C) < MIN_COEFFICIENT] = 0.0
        regrouping[:, dependent] = C
    return independent, regrouping


def _expression(row: Array, own: int, names: tuple[str, ...]) -> str:
    """Such as `ZZ2 + Ia2 + 0.0506 (M3 + M4)`: the parameter itself first, equal
    coefficients in one bracket.
    """
    groups: dict[float, list[str]] = {}
    for c in [own, *(int(c) for c in np.flatnonzero(row) if c != own)]:
        groups.setdefault(float(f"{row[c]:.6g}"), []).append(names[c])
    text = ""
    for coefficient, members in groups.items():
        inside, factor = " + ".join(members), f"{abs(coefficient):.6g} "
        if abs(coefficient) == 1.0:
            factor = ""
        if len(members) > 1 and (factor or coefficient < 0):
            inside = f"({inside})"
        text += (" - " if coefficient < 0 else " + " if text else "") + factor + inside
    return text
