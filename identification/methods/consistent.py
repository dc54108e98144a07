"""Physically consistent standard parameters nearest to the estimate of a fit: a
simulator accepts them.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from acquisition.robot import Robot, load_robot

from ..arrays import Array
from ..errors import BadInputError
from ..estimation import (
    consistent_parameters,
    covariance_of_all,
    one_thread,
    parameter_certainty,
    torque_errors,
)
from ..model import BaseParameters, InverseModel, expected_links, physical_parameters
from ..regression import equation_alone, recorded_power, torque_of_recording
from .fit import ConsistentSet, Fit

# of the variance by the prior alone: above, the value is more from the prior than the recording
MIN_PRIOR_SHARE = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Known:
    """An estimate beta (b,), its covariance C = D R D (b, b), and `reach`, deviations
    in half a 95 % interval.
    """

    beta: Array
    covariance: Array
    reach: float


def urdf_prior(robot: Robot, urdf: str, name: str) -> Robot:
    """The robot with a URDF (its text) as the only source of link parameters;
    joints are matched by name.
    """
    joints = tuple(msgspec.structs.replace(joint, dh=None) for joint in robot.joints)
    return replace(robot, name=name, joints=joints, urdf=urdf, parameters={})


def read_prior(path: Path, robot: Robot) -> Robot:
    """The fitted `robot` as another robot.toml or URDF, `path`, describes it, by its name; refuses
    one that cannot be read.
    """
    if path.suffix.lower() == ".toml":
        return replace(load_robot(path), name=path.name)
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise BadInputError(f"cannot be read: {error.strerror}", place=str(path)) from error
    return urdf_prior(robot, text, path.name)


@one_thread
def with_consistent(fit: Fit, prior: Robot | None = None) -> Fit:
    """The fit with the nearest physically consistent parameters and their torque errors; the
    estimate stays the same.

    `prior` describes the a-priori links; None: the fitted description. Raises `BadInputError`: a
    drive gain is not known, the prior is of another robot, or no consistent parameters are found.
    """
    problem, full = fit.problem, fit.least_squares.full
    covariance = covariance_of_all(full.names, fit.estimate, fit.intervals, full)
    # of own parameters those of one recording
    first = np.array([full.names.index(name) for name in fit.recordings[0].arm.names])
    covariance = covariance[np.ix_(first, first)]
    known = Known(beta=fit.beta, covariance=covariance, reach=fit.intervals.reach)
    alike = [one for one in fit.recordings if one.arm.names == fit.recordings[0].arm.names]
    power = recorded_power([one.problem for one in alike], fit.beta)
    found = consistent_set(problem.model, fit.base, known, prior=prior, power=power)
    carried = [one.arm.payload for one in fit.recordings]
    each = [
        (
            *torque_of_recording(
                *equation_alone(one.problem),
                found.beta if payload is None else found.beta + payload.known,
            ),
            one.problem.measured_rows(),
        )
        for one, payload in zip(fit.recordings, carried, strict=True)
    ]
    tau, predicted, speed, measured = (np.concatenate(x) for x in zip(*each, strict=True))
    names = tuple(joint.name for joint in problem.signals.robot.joints)
    return replace(
        fit,
        consistent_set=found,
        consistent_errors=torque_errors(tau, predicted, speed, measured, names),
    )


@one_thread
def consistent_set(
    model: InverseModel,
    base: BaseParameters,
    known: Known,
    *,
    prior: Robot | None = None,
    power: Array | None = None,
) -> ConsistentSet:
    """The physically consistent parameters nearest to the `known` base parameters of a robot, by
    the links of `prior`; None: of its own description. `power`: of friction at recorded speeds, for
    further friction terms; None without such terms or known speeds. Raises as `with_consistent`.
    """
    refuse_unknown_gain(model.robot)
    expected = None if prior is None else InverseModel(prior)
    physical = physical_parameters(model, expected, power)
    found = consistent_parameters(known.beta, known.covariance, base.K, physical)
    (sigma, share), (base_sigma, base_share) = parameter_certainty(
        found, known.covariance, base.K, physical
    )
    return ConsistentSet(
        names=model.names,
        units=model.units,
        chi=found.chi,
        half=known.reach * sigma,
        from_prior=share > MIN_PRIOR_SHARE,
        base_names=base.names,
        beta=found.beta,
        base_half=known.reach * base_sigma,
        base_from_prior=base_share > MIN_PRIOR_SHARE,
        prior=f"{'the description' if prior is None else prior.name}: "
        f"{_in_words(expected_links(model, expected)[1])}",
        chi_squared=found.chi_squared,
        deviations=found.deviations,
        reach=known.reach,
        certificate=found.decrement,
    )


def refuse_unknown_gain(robot: Robot) -> None:
    """Refuse a fit in A or V: joints have unknown gains of their own, and a link's
    parameters would mix them.
    """
    for k, motor in enumerate(robot.motors):
        if motor.gain is None and not robot.gain_known:
            raise BadInputError(
                f"the fit is in {motor.recorded_unit}; link parameters need N m",
                place=f"robot {robot.name}",
                key=f"motor[{k}].drive_gain",
                value=None,
                expected="a drive gain for every motor",
            )


def _in_words(sources: tuple[str, ...]) -> str:
    """`links 1, 2 by the URDF; link 3 by their lengths (guess)`."""
    words = {
        "[parameters]": "by [parameters]",
        "URDF": "by the URDF",
        "plausible": "by their lengths (guess)",
    }
    of = {source: [str(j + 1) for j, s in enumerate(sources) if s == source] for source in words}
    return "; ".join(
        f"{'all links' if len(links) == len(sources) else 'links ' + ', '.join(links)} "
        f"{words[source]}"
        for source, links in of.items()
        if links
    )
