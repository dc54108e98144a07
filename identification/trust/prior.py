"""A-priori links, of a URDF or `[parameters]`, as a witness of the recording: by joint and held out, and what may be exchanged.

The recorded torque of joint j is f_j times that of the prior's links, beside all that the prior does not know: rotors and
friction, with the instruments and weights of the fit. Only rows of joint j tell f_j: a wrong gain of one joint does not move
the others. Where the links do not fit, they are tried along the recorded motion with joints exchanged, and in other units.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import Estimate, System, instrumental_variables, intervals_of
from ..model import direct_model, prior_of_base
from ..regression import Problem, base_name, spaced_states
from .fit_data import FitData, LinkPrior
from .held_out import Predict, errors_together, held_out_parts
from .lines import Figure, TrustLine

MIN_FACTOR, MAX_FACTOR = 0.5, 2.0  # of a joint's torque over that of the prior's links
MAX_SPREAD = 1.5  # of factors that are one
MIN_EXPLAINED = (
    0.25  # of a joint's square, without what is not of links, for its factor to be one of the prior's torque
)
MIN_LEFT = 0.01  # smallest share of a joint's square left by the prior's links that counts
MIN_CAUSE = 1.5  # fall of the sum of the logarithms of these shares by which a cause is named
MIN_INDEPENDENT = 1e-6  # of the largest singular value of columns of norm one
UNITS = {
    180 / np.pi: "position of {} in rad declared as degrees",
    np.pi / 180: "position of {} in degrees declared as rad",
    -1.0: "sign of the position of {}",
}


def link_prior(problem: Problem) -> LinkPrior | None:
    """The a-priori links of a description; None where it has none, or the torques are not in N m."""
    if not problem.signals.robot.gain_known:
        return None
    values, source = prior_of_base(problem.model, problem.base)
    return LinkPrior(values=values, source=source) if np.isfinite(values).any() else None


def with_error(evidence: FitData, predict: Predict) -> LinkPrior | None:
    """The prior with the held-out error of its links: all else is fitted to the other blocks, or recordings."""
    if evidence.prior is None or evidence.gains or not evidence.held_out:
        return evidence.prior
    system, (known, free) = evidence.observed.system, _known_and_free(evidence)
    instruments = system.W if evidence.Z is None else evidence.Z
    rest = replace(system, Y=system.Y - system.W @ known).with_columns(free)

    def with_links(*estimates: Estimate, by_recording: bool = False) -> Array:
        whole = (replace(one, names=system.names, beta=known + one.values_of(system.names)) for one in estimates)
        return predict(*whole, by_recording=by_recording)

    with suppress(IdentificationError):
        others = instrumental_variables(rest, instruments[:, free], evidence.estimate.weights)
        observed = replace(evidence.observed, system=rest, Z=instruments[:, free])
        found = held_out_parts(replace(evidence, observed=observed, estimate=others), with_links)
        if found and all(one.error_percent is not None for one in found):
            return replace(evidence.prior, error_percent=errors_together(found)[0])
    return evidence.prior


@dataclass(frozen=True, kw_only=True)
class LinkFactor:
    """Torque of a joint over that of the prior's links, and half its 95 % interval.

    Attributes:
        explained, needed: shares of the square of the joint's torque, both without what is not of links: what the prior's
            links explain with the factor, and their own square.
    """

    value: float
    half_width: float
    explained: float
    needed: float

    @property
    def outside(self) -> bool:
        """Whether the interval is beyond what a prior may be off."""
        return self.value + self.half_width < MIN_FACTOR or self.value - self.half_width > MAX_FACTOR


def prior_test(evidence: FitData) -> TrustLine | None:
    """By joint its torque over that of the prior's links; joints that seem exchanged or in other units."""
    name, robot = "prior", evidence.problem.signals.robot
    if evidence.prior is None or evidence.gains:
        return None
    links = f"the {evidence.prior.source}'s links"
    found = {joint.name: one for j, joint in enumerate(robot.joints) if (one := _factor(evidence, j)) is not None}
    told = {joint: one for joint, one in found.items() if one.explained > MIN_EXPLAINED}
    figures = (Figure(name=j, value=x.value, half_width=x.half_width, expected=1.0) for j, x in told.items())
    line = TrustLine(name, "ok", f"torques are {_range(told)} times what {links} need", figures=tuple(figures))
    outside = {joint: one for joint, one in told.items() if one.outside}
    unlike = any(one.needed > MIN_EXPLAINED >= one.explained for one in found.values())
    if (outside or unlike) and (cause := _cause(evidence)):
        return replace(line, level="caution", text=f"{cause}? {links} then need the recorded torques", finding=cause)
    if not told:
        return replace(line, level="cannot tell", text=f"no torque is like that of {links}")
    if not outside:
        return line
    all_outside, values = len(outside) == len(told) > 1, [one.value for one in outside.values()]
    if all_outside and max(values) > max(MAX_SPREAD * min(values), 0.0):
        text = f"the prior is off everywhere: torques are {_range(outside)} times what {links} need"
        return replace(line, level="cannot tell", text=text)
    each = ", ".join(f"torque of {joint} is {one.value:.2g} times" for joint, one in outside.items())
    text = f"{f'torques of all joints are {_range(outside)} times' if all_outside else each} what {links} need"
    return replace(line, level="caution", text=f"{text}: drive_gain, ratio, unit, or the prior?", finding=text)


def _range(found: dict[str, LinkFactor]) -> str:
    values = [one.value for one in found.values()]
    return f"{min(values, default=0.0):.2g} to {max(values, default=0.0):.2g}"


def _known_and_free(evidence: FitData) -> tuple[Array, NDArray[np.intp]]:
    """(p,) values of the system's parameters by the prior, zero where it has none; places of those that are fitted instead."""
    assert evidence.prior is not None
    of_prior = dict(zip(evidence.problem.base.names, evidence.prior.values, strict=True))
    names = evidence.observed.system.names
    known = np.array([of_prior.get(base_name(name), np.nan) for name in names])
    free = np.isnan(known) & np.isin(names, evidence.estimate.names)
    return np.nan_to_num(known), np.flatnonzero(free)


def _factor(evidence: FitData, j: int) -> LinkFactor | None:
    """The factor of joint j; None where no link of the prior acts, or nothing tells it."""
    system, (known, free) = evidence.observed.system, _known_and_free(evidence)
    own = system.joint_of_row == j
    W, Z = (A[own] * system.used[own, None] for A in (system.W, system.W if evidence.Z is None else evidence.Z))
    Y, torque, free = system.Y[own] * system.used[own], W @ known, free[W[:, free].any(axis=0)]
    d = np.linalg.norm(W[:, free], axis=0)
    U, sizes, axes = np.linalg.svd(W[:, free] / d, full_matrices=False)
    kept = sizes > MIN_INDEPENDENT * sizes.max(initial=0.0)
    others, basis = U[:, kept], (axes[kept] / d).T
    whole, needed = (float(np.linalg.norm(x - others @ (others.T @ x))) ** 2 for x in (Y, torque))
    alone = System(
        W=np.c_[torque, W[:, free] @ basis],
        Y=Y,
        joint_of_row=np.zeros(len(Y), dtype=np.intp),
        names=("factor", *map(str, range(basis.shape[1]))),
        share=system.share[own],
        rows=system.rows[[j]],
        spans=system.spans,
    )
    with suppress(IdentificationError):
        found = instrumental_variables(alone, np.c_[Z @ known, Z[:, free] @ basis], np.ones(1))
        return LinkFactor(
            value=float(found.beta[0]),
            half_width=float(intervals_of(alone, found).half[0]),
            explained=1 - found.residual_norm**2 / max(whole, 1e-300),
            needed=needed / max(whole, 1e-300),
        )
    return None


def _cause(evidence: FitData) -> str:
    """What, corrected, lets the prior's links explain the torques far better, in some 300 rows of the first recording."""
    assert evidence.prior is not None
    problem, arm = evidence.problem, evidence.arms[0]
    carried = arm.payload.values(evidence.estimate) if arm.payload else 0.0
    beta = np.nan_to_num(evidence.prior.values) + carried * problem.base.links
    links = direct_model(problem.model, problem.base.standard_parameters(beta))
    states, names = spaced_states(problem), [joint.name for joint in problem.signals.robot.joints]
    recorded, motion = evidence.observed.tau[states.rows], np.stack([states.q, states.dq, states.ddq])

    def left(motion: Array, tau: Array, torque: Array | None = None) -> float:
        rigid = links.torques_of_links(*motion) if torque is None else torque
        return float(sum(np.log(_unexplained(motion[..., j], tau[:, j], rigid[:, j])) for j in range(len(names))))

    def tried() -> Iterator[tuple[float, str]]:
        n = len(names)
        for a, b in combinations(range(n), 2):
            order = np.arange(n)
            order[[a, b]] = b, a
            pair = f"of joints {names[a]} and {names[b]} exchanged"
            yield left(motion, recorded[:, order], torque), f"recorded efforts {pair}"
            yield left(motion[..., order], recorded), f"recorded positions {pair}"
        for factor, text in UNITS.items():
            for joints in [*([j] for j in range(n)), list(range(n))] if n > 1 else [[0]]:
                scale = np.where(np.isin(np.arange(n), joints), factor, 1.0)
                yield (
                    left(motion * scale, recorded),
                    text.format(names[joints[0]] if len(joints) == 1 else "all joints"),
                )

    torque = links.torques_of_links(*motion)
    least, cause = min(tried())
    return cause if least < left(motion, recorded, torque) - MIN_CAUSE else ""


def _unexplained(motion: Array, tau: Array, torque: Array) -> float:
    """Share of a joint's torque (N,), without what rotor, friction and offset explain, that the links' torque leaves."""
    _, dq, ddq = motion
    others = np.linalg.qr(np.c_[ddq, dq, np.sign(dq), np.ones_like(dq)])[0]
    left, whole = (x - others @ (others.T @ x) for x in (tau - torque, tau))
    return float(np.clip((left @ left) / max(float(whole @ whole), 1e-300), MIN_LEFT, 1.0))
