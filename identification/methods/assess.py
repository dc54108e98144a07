"""Assesses an estimate: torque errors of all rows, intervals, tests, warnings."""

from collections.abc import Sequence

import numpy as np

from acquisition.robot import demand_ripple_warnings

from ..arrays import Array
from ..data import Signals
from ..estimation import (
    BlockSums,
    Estimate,
    Intervals,
    System,
    f_tail,
    independent_share,
    intervals,
    intervals_of_blocks,
    lag_one,
    sums_of_blocks,
    torque_errors,
)
from ..regression import Regression, base_name
from ..report import Method, OwnTest
from ..simulation import Instruments, Replica
from ..trust import Evidence, Lag, held_out_recordings, trust_in
from .fit import Fit, FittedRecording, LeastSquares, essential_names
from .observation import position_noise_line
from .system import StackedSystem


def evidence_of_ls(observed: StackedSystem, method: Method, ls: LeastSquares, lags: tuple[Lag, ...]) -> Evidence:
    """What least squares has to show for itself: it has no instruments, and cannot find the lags of the torques."""
    first = observed.problems()[0].with_samples()
    alone = len(observed.observations) == 1 and not observed.load.joints.size
    return Evidence(
        recordings=observed.observations,
        observed=observed.regression,
        method=method,
        fixed_point=True,
        estimate=ls.estimate,
        predicted=ls.tau_predicted,
        used=observed.regression.fast.T.reshape(-1).astype(float),
        intervals=ls.intervals,
        least_squares=ls.full,
        blocks=sums_of_blocks(ls.estimate, observed.regression.time_blocks),
        factors=factors_of_ls(observed),
        position_noise=position_noise_line(first, method, ls, alone=alone),
        lags=lags,
        essential=essential_names(ls.essential, ls.estimate, ls.intervals),
    )


def factors_of_ls(observed: StackedSystem) -> tuple[tuple[System, Array], ...]:
    """The reduced system of each of several recordings, W as its instruments; none where rows are held."""
    if not observed.regression.reduced or len(observed.observations) == 1:
        return ()
    return tuple((one.regression.system, one.regression.system.W) for one in observed.observations)


def fit_of(observed: StackedSystem, evidence: Evidence, solved: LeastSquares, replicas: Sequence[Replica] = ()) -> Fit:
    """A fit of the estimate that was `solved`, judged by its evidence; with the robot simulated in each recording, or none."""
    rows, predicted = observed.regression, solved.tau_predicted
    names = tuple(joint.name for joint in observed.problem.signals.robot.joints)
    trust, held_out = trust_in(evidence), held_out_recordings(evidence)
    judged, of_model = observed, predicted
    # errors of the model, without the noise that the fit lets through
    if (behind := observed.behind_rule()) is not None:
        judged = behind.at(solved.estimate.among(rows.system.names))
        of_model = judged.predicted(solved.estimate)
    seen = judged.regression
    fitted = [
        FittedRecording(
            problem=one.problem,
            parameters=observed.parameters.of[k],
            rows=part,
            errors=torque_errors(seen.tau[own], of_model[own], seen.speed[own], names),
            held_out=held,
            replica=replicas[k] if replicas else None,
            states=one.states,
        )
        for k, (one, part, own, held) in enumerate(
            zip(observed.observations, observed.parts, judged.parts, held_out, strict=True)
        )
    ]
    return Fit(
        recordings=tuple(fitted[k] for k in observed.order),
        method=evidence.method,
        status="solved",
        estimate=solved.estimate,
        intervals=solved.intervals,
        least_squares=solved,
        t_s=np.concatenate([one.t_s for one in observed.observations]),
        tau=rows.tau,
        tau_predicted=predicted,
        speed=rows.speed,
        errors=torque_errors(seen.tau, of_model, seen.speed, names),
        lags=evidence.lags,
        warnings=_warnings(observed),
        trust=trust,
        own=own_test(observed, solved.full),
    )


def own_test(observed: StackedSystem, full: Estimate) -> OwnTest | None:
    """The F test of the recordings' own parameters against shared ones, by least squares; None where they have none."""
    parameters, rows = observed.parameters, observed.regression
    if not parameters.any:
        return None
    W, Y = rows.system.weighted(full.weights)
    shared = list(dict.fromkeys(map(base_name, parameters.names)))
    merge = np.array([[float(base_name(name) == one) for one in shared] for name in parameters.names])
    norm = np.linalg.norm(Y - W @ full.beta)
    together = W @ merge
    scale = np.linalg.norm(together, axis=0)
    left = np.linalg.norm(Y - together / scale @ np.linalg.lstsq(together / scale, Y)[0])
    rho = (rows.tau - observed.predicted(full)) * full.weights * rows.fast
    more, freedom = len(parameters.names) - len(shared), full.rows - len(parameters.names)
    F = float((left**2 - norm**2) / more / (norm**2 / freedom)) if norm > 0 else float("inf")
    share = independent_share(lag_one(rho) or 0.0)
    p = f_tail(F * share, more, max(1.0, full.rows * share - len(parameters.names)))
    names = tuple(name for name in parameters.names if "@" in name)
    return OwnTest(names=names, F=F, p_value=f_tail(F, more, freedom), F_effective=F * share, p_effective=p)


def intervals_of(observed: Regression, estimate: Estimate, predicted: Array, used: Array) -> Intervals:
    """Intervals of an estimate from the rows that are `used` (r,)."""
    if observed.time_blocks:
        return intervals_of_blocks(estimate, sums_of_blocks(estimate, observed.time_blocks))
    rho = ((observed.tau - predicted) * estimate.weights).T.reshape(-1)
    return intervals(estimate, rho * used, observed.tau.shape[1], observed.parts)


def intervals_along(observed: StackedSystem, z: Instruments, estimate: Estimate) -> Intervals:
    """Intervals of an estimate by instruments, from the rows that count or from the blocks of long recordings."""
    if z.system is None:
        about = observed.about(z)
        return intervals_of(about.regression, estimate, about.predicted(estimate), z.used)
    return intervals_of_blocks(estimate, sums_along(z, estimate))


def sums_along(z: Instruments, estimate: Estimate) -> tuple[BlockSums, ...]:
    """Sums over the blocks of long recordings of an estimate by instruments; none where rows are held."""
    if z.system is None:
        return ()
    among = np.array([z.system.names.index(name) for name in estimate.names])
    R = estimate.Q.T @ (z.Z[:, among] * estimate.weights[z.system.joint_of_row, None])  # of the weighted Z = Q R
    return sums_of_blocks(estimate, z.time_blocks, np.asarray(np.linalg.inv(R)))


def _warnings(observed: StackedSystem) -> tuple[str, ...]:
    """Those of the settings and of the recordings, which several recordings may share."""
    problems = [observed.observations[k].problem for k in observed.order]
    of_settings = [[*p.settings.warnings, *gain_warnings(p.signals), *ripple_warnings(p.signals)] for p in problems]
    if len(problems) == 1:
        return (*of_settings[0], *recording_warnings(problems[0].signals))
    named = [f"{p.signals.recording}: {text}" for p in problems for text in recording_warnings(p.signals)]
    return (*dict.fromkeys(text for texts in of_settings for text in texts), *named)


def recording_warnings(signals: Signals) -> tuple[str, ...]:
    """What the recorder warned of, such as SYNC at another period than described: estimates rest on it."""
    return tuple(f"recording: {event.text}" for event in signals.events if event.kind == "warning")


def ripple_warnings(signals: Signals) -> tuple[str, ...]:
    """Where torque demands of drives are sampled at one phase of their control: that error is no lag, and stays in inertias."""
    bus, bandwidth_hz = signals.robot.bus, signals.robot.controller.bandwidth_hz
    return demand_ripple_warnings(bus, bandwidth_hz) if signals.of_drives else ()


def gain_warnings(signals: Signals) -> tuple[str, ...]:
    """What a reader must know of the units where the drive gains are not given."""
    robot = signals.robot
    if robot.gain_known:
        return ()
    units = " and ".join(sorted(set(robot.effort_units)))
    text = f"the drive gains are not known: torques and parameters are in {units}, not in N m"
    shared = (
        "; joints share parameters, so the values hold only if all drives have the same gain" if robot.n > 1 else ""
    )
    return (text + shared,)
