"""Exciting references within the limits of a robot, and their report."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from acquisition.errors import Location
from acquisition.files import find_mesh, write_columns
from acquisition.robot import (
    HARMONICS,
    FourierReference,
    Robot,
    refuse_out_of_range,
    resolve,
)

from ..arrays import Array
from ..estimation import one_thread
from ..model import (
    BaseParameters,
    InverseModel,
    Obstacles,
    base_parameters,
    load_parameters,
    obstacles_of,
)
from ..options import ReferenceOptions
from ..report import Document, Number, Row, Section, Table, columns
from ..results import Evidence, fit_file
from .information import (
    NORMAL_QUANTILE,
    Information,
    PriorInformation,
    earlier_information,
    inverse,
    loads_of,
    prior_information,
    rows_per_s,
    torque_noise,
)
from .limits import KINDS, Limits, Motion, Series, limits_of, motion_of
from .search import (
    MARGIN_M,
    SAMPLES_PER_PERIOD,
    SearchProblem,
    best_of_searches,
    random_within,
)

# The criterion is relative to the geometric mean of these random references, so that parameters of
# all units and sizes count equally. Their seeds begin at 0.
PLAIN_REFERENCES = 20
SAMPLE_POSES = 200  # to find links that are always close to each other
# The position loop would not follow harmonics above this share of its bandwidth.
MAX_BANDWIDTH_SHARE = 1 / 3
CREEP_SHARE = 0.05  # of a joint's speed limit
# A single harmonic cannot have zero speed and zero acceleration at the ends of the period.
MIN_HARMONICS = 2
CURVE_SAMPLES = 100  # per period of the highest harmonic, in plots


class ExcitationSettings(ReferenceOptions):
    """Settings of an exciting reference; the same `seed` gives the same reference.

    Attributes:
        period_s: period of the Fourier series, s.
        harmonics: number of harmonics, at least 2.
        periods: number of periods.
        seed: seed of the random search.
        limits_percent: share of each limit that may be used, percent.
    """


@dataclass(frozen=True, kw_only=True, eq=False)
class Excitation:
    """An exciting reference, and the results that are expected from it.

    Attributes:
        base: base parameters, without load-dependent friction.
        settings: settings of the design.
        reference: one period of the reference.
        sigma: expected standard errors of the parameters, shape (b,).
        plain: geometric mean of those with plain references, shape (b,).
        noise: standard deviation of the torque in a row of the fit, shape (n,).
        noise_from: origin of `noise`, in words.
        limits: limits of the robot.
        used: largest share used of each limit, shape (L,); 1 is the whole limit.
        nearest: smallest distance, m, and its pair of links, or link and ground; None without
            shapes.
        beta: parameters for the torque, shape (b,); None if the torque was not checked.
        knowledge: prior information: origin of `beta`, earlier recordings, payload of a second run.
        gains: expected half-widths of the drive gains after both runs, shape (n,), percent.
        warnings: what was not checked, one line each.
    """

    base: BaseParameters
    settings: ExcitationSettings
    reference: FourierReference
    sigma: Array
    plain: Array
    noise: Array
    noise_from: str
    limits: Limits
    used: Array
    nearest: tuple[float, str] | None
    beta: Array | None
    knowledge: PriorInformation
    gains: Array
    warnings: tuple[str, ...]

    @property
    def robot(self) -> Robot:
        """Robot of the reference."""
        return self.limits.robot

    @property
    def half(self) -> Array:
        """Expected half-widths of the 95 % intervals, shape (b,)."""
        return NORMAL_QUANTILE * self.sigma

    @property
    def plain_half(self) -> Array:
        """Expected half-widths of the 95 % intervals with plain references, shape (b,)."""
        return NORMAL_QUANTILE * self.plain

    def curves(self) -> tuple[Array, Array, Array, Array | None]:
        """Return one period of the reference as curves.

        Returns
        -------
        Times, shape (N,), s; positions, rad or m; speeds, rad/s or m/s; and torques, N m or N, or
        None if unknown. The last three have the shape (N, n).
        """
        t_s = np.linspace(0.0, self.settings.period_s, CURVE_SAMPLES * self.settings.harmonics + 1)
        motion = self.reference.at(t_s)
        return (
            t_s,
            *motion[:2],
            None if self.limits.model is None else self.limits.model.torque(*motion),
        )

    def write(self, path: Path) -> None:
        """Write the reference as a CSV for `robot-acquire record --track`.

        It contains the times in s and the positions in rad or m of all periods, dense enough for
        splines. The file is written completely or not at all.

        Parameters
        ----------
        path : file to write.
        """
        s = self.settings
        # The session interpolates by splines, which need many samples per harmonic.
        steps = math.ceil(max(200 * s.harmonics, 100 * s.period_s))
        t_s = np.arange(steps * s.periods + 1, dtype=np.float64) * (s.period_s / steps)
        write_columns(
            path,
            ("time_s", *(joint.name for joint in self.robot.joints)),
            [np.column_stack([t_s, self.reference.at(t_s)[0]])],
        )


@one_thread
def excite(
    robot: Robot,
    settings: ExcitationSettings,
    knowledge: PriorInformation,
    place: str,
    say: Callable[[str], None] = lambda text: None,
    *,
    quick: bool = False,
) -> Excitation:
    """Design an exciting reference within the limits of the robot.

    It minimises the standard errors of the base parameters relative to those of plain references.

    Parameters
    ----------
    robot : the robot; all joints need limits.
    settings : settings of the reference.
    knowledge : prior information about the robot.
    place : name of the description in errors.
    say : called with a line of text at each step of the search.
    quick : True for one short search, which shows roughly what to expect of the whole one.

    Returns
    -------
    The reference with the expected intervals.

    Raises
    ------
    BadInputError : a limit is missing, or the drives cannot follow the reference or represent it.
    NoFitError : no reference within the limits is found.
    """
    _refuse_fast(robot, settings, place)
    model = InverseModel(robot)
    every = base_parameters(model)
    loads = loads_of(model, every, knowledge, place)
    # The columns of load-dependent friction depend on the parameters, so the criterion leaves it
    # out. The limits count its torque.
    mus = load_parameters(every)
    base = every.without(mus)
    obstacles = _obstacles(model, knowledge)
    limits = limits_of(robot, loads, settings.limits_percent / 100, place)
    _refuse_rest(limits, place)
    # Plain references make the criterion relative. Their torque also gives the noise if no other
    # value is known.
    plain = _plain_motions(limits, settings)
    noise, noise_from = torque_noise(robot, loads[-1] if loads else None, knowledge, plain)
    information = Information(
        model=model,
        base=base,
        noise=noise,
        rows=rows_per_s(robot) * settings.period_s * settings.periods,
        earlier=earlier_information(base, noise, knowledge.recordings),
        creep=CREEP_SHARE * np.array([joint.si("speed") for joint in robot.joints]),
    )
    problem = SearchProblem(
        series=Series(period_s=settings.period_s, harmonics=settings.harmonics),
        information=information,
        limits=limits,
        plain=np.exp(np.mean([np.log(information.sigma(motion)) for motion in plain], axis=0)),
        obstacles=obstacles if obstacles.names else None,
        quick=quick,
    )
    # A series may exceed a limit between the samples of the search, so the result is checked at
    # more samples.
    x, sigma = best_of_searches(problem, settings.seed, place, say)
    fine = motion_of(x, problem.finer)
    excitation = Excitation(
        base=base,
        settings=settings,
        reference=problem.series.reference(x),
        sigma=sigma,
        plain=problem.plain,
        noise=noise,
        noise_from=noise_from,
        limits=limits,
        used=limits.share_of_whole(fine),
        nearest=obstacles.nearest(fine[0]) if obstacles.names else None,
        beta=None
        if knowledge.beta is None
        else knowledge.beta[[every.names.index(name) for name in base.names]],
        knowledge=knowledge,
        gains=np.zeros(0)
        if knowledge.payload is None
        else 100
        * NORMAL_QUANTILE
        * information.gain_deviations(motion_of(x, problem.basis), loads, knowledge.payload),
        warnings=(*_warnings(limits, obstacles, mus), *knowledge.warnings),
    )
    if robot.bus is not None:
        refuse_out_of_range(
            excitation.reference.at(np.arange(0.0, settings.period_s, robot.bus.sync_period_s))[0],
            robot,
            resolve(robot, place),
            "the reference",
        )
    return excitation


def expected_after(fit: Evidence, place: Path) -> tuple[float, dict[str, float]]:
    """Return what to expect of one more recording, along a reference designed after those of a fit.

    Parameters
    ----------
    fit : the fit.
    place : the description, for errors, and for meshes in its folder.

    Returns
    -------
    The period of the reference, longer than usual if the position loop requires it, s. By
    parameter the width of its interval with the recording, as a share of that without it. The
    uncertainty of the delay stays. The values are from a quick search.

    Raises
    ------
    BadInputError, NoFitError : as in `excite`.
    """
    recordings, robot = [one.problem.signals for one in fit.recordings], fit.problem.signals.robot
    found = excite(
        robot,
        ExcitationSettings(
            period_s=max(
                ExcitationSettings.period_s,
                math.ceil(
                    ExcitationSettings.harmonics / (MAX_BANDWIDTH_SHARE * robot.bandwidth_hz)
                ),
            )
        ),
        prior_information(robot, place.parent, fit=fit_file(fit), after=recordings),
        str(place),
        quick=True,
    )
    # The noise usually grows with the torque.
    growth = np.mean(np.asarray(found.curves()[3]) ** 2, axis=0) / np.mean(fit.tau**2, axis=0)
    left = (
        max(1.0, np.median(growth))
        * found.sigma**2
        / inverse(earlier_information(found.base, found.noise, recordings)).diagonal()
    )
    # Shares of variances. More motion does not reduce that of the delay.
    of_delay = sum(x.moved**2 for x in fit.data.lags) / fit.data.intervals.sigma**2
    return found.settings.period_s, {
        name: math.sqrt(delay + left[found.base.names.index(name)] * (1 - delay))
        for name, delay in zip(fit.data.estimate.names, of_delay, strict=True)
        if name in found.base.names
    }


def _obstacles(model: InverseModel, knowledge: PriorInformation) -> Obstacles:
    """Return pairs of links to be kept apart, without those that are always close to each other."""
    low, high = np.array([joint.si("position") or (0.0, 0.0) for joint in model.robot.joints]).T
    return obstacles_of(
        model,
        partial(find_mesh, folder=knowledge.folder),
        np.random.default_rng(0).uniform(low, high, (SAMPLE_POSES, model.robot.n)),
        MARGIN_M,
    )


def _plain_motions(limits: Limits, settings: ExcitationSettings) -> list[Motion]:
    """Return motions of random references within the limits, with the usual number of harmonics."""
    harmonics, samples = settings.harmonics, SAMPLES_PER_PERIOD * settings.harmonics
    t_s = np.arange(samples, dtype=np.float64) * (settings.period_s / samples)
    series = Series(period_s=settings.period_s, harmonics=min(HARMONICS, harmonics))
    return [random_within(limits, series, seed).at(t_s) for seed in range(PLAIN_REFERENCES)]


def _refuse_fast(robot: Robot, settings: ExcitationSettings, place: str) -> None:
    """Refuse harmonics near the bandwidth, which the position loops would not follow."""
    highest_hz, max_hz = (
        settings.harmonics / settings.period_s,
        MAX_BANDWIDTH_SHARE * robot.bandwidth_hz,
    )
    count = math.floor(max_hz * settings.period_s + 1e-9)
    fewer = f"{count} or fewer harmonics, or " if count >= MIN_HARMONICS else ""
    Location(place).require(
        highest_hz <= max_hz * (1 + 1e-9),
        "harmonics",
        settings.harmonics,
        text=f"the highest harmonic of {highest_hz:.4g} Hz exceeds a third of the bandwidth of "
        f"{robot.bandwidth_hz:g} Hz",
        advice=f"Use {fewer}a period of at least "
        f"{math.ceil(100 * settings.harmonics / max_hz) / 100:g} s",
        arguments=("harmonics", "period_s")[not fewer :],
    )


def _refuse_rest(limits: Limits, place: str) -> None:
    """Refuse a robot that cannot rest in the middle of its ranges, where references start."""
    n = limits.robot.n
    used = np.abs(limits.shares((limits.middle[None], np.zeros((1, n)), np.zeros((1, n)))))[0]
    if used.max() > 1:
        most, effort = int(used.argmax()), limits.effort
        worst = (most - 3 * n) % len(effort.names)
        held = limits.coulomb[worst] + used[most] * limits.allowed[worst]
        Location(place).refuse(
            text=f"{limits.names[most].removeprefix('effort of ')} needs {held:.4g} "
            f"{effort.units[worst]} to start from rest in the middle of the ranges, more than "
            f"{100 * limits.share:g} % of its effort limit of {effort.limits[worst]:.4g}",
            advice="Check the effort limits and the position ranges",
        )


def _warnings(limits: Limits, obstacles: Obstacles, mus: Sequence[str]) -> Iterator[str]:
    """Yield warnings about torques and distances that were not checked.

    `mus` are the parameters of load-dependent friction, which the criterion leaves out.
    """
    if obstacles.missing:
        yield (
            f"distances of links are not checked, because {len(obstacles.missing)} meshes of the "
            f"URDF are missing, such as {obstacles.missing[0]}: set ROS_PACKAGE_PATH, or describe "
            "capsules"
        )
    if obstacles.near:
        yield (
            f"distances are not checked for pairs that are always closer than {MARGIN_M:g} m: "
            f"{'; '.join(obstacles.near)}"
        )
    if limits.model is None:
        yield "torques are not checked, because there is neither a fit nor [parameters]"
    elif not limits.robot.gain_known:
        yield (
            "limits in N m or N are not checked, because efforts are in A or V and the drive gains "
            "are unknown"
        )
    free = ", ".join(
        joint.name
        for joint, column in zip(limits.robot.joints, limits.effort.directions.T, strict=True)
        if not column.any()
    )
    if limits.model is not None and free:
        yield (
            f"the reference may exceed the torque limits of {free}, because robot.toml gives none: "
            "set effort_nm, effort_n or the motor's saturation"
        )
    if mus:
        yield (
            f"load-dependent friction ({', '.join(mus)}) counts in the effort limits, but not in "
            "the expected intervals"
        )


def excitation_document(excitation: Excitation) -> Document:
    """Make the report of a reference: its expected intervals, and the limits that it uses.

    The short form has the widest intervals only.
    """
    e, s = excitation, excitation.settings
    return Document(
        title=f"{e.robot.name}: reference of {s.periods} periods of {s.period_s:g} s, "
        f"{s.harmonics} harmonics up to {s.harmonics / s.period_s:g} Hz, seed {s.seed}",
        sections=(
            _interval_section(e).with_short_table(np.argsort(-e.half).tolist()),
            _limit_section(e),
        ),
    )


def _interval_section(e: Excitation) -> Section:
    smaller, payload = e.plain / e.sigma, e.knowledge.payload
    table = Table(
        columns=(
            *columns("parameter", numbers=("value",) if e.beta is not None else ()),
            *columns(numbers=("95 %\nhalf-width", "of plain\nreferences", "ratio")),
            *columns("unit"),
        ),
        rows=tuple(
            (
                name,
                *((Number(float(e.beta[i]), ".4g"),) if e.beta is not None else ()),
                Number(float(e.half[i]), ".3g"),
                Number(float(e.plain_half[i]), ".3g"),
                Number(float(smaller[i]), ".2f"),
                e.base.units[i],
            )
            for i, name in enumerate(e.base.names)
        ),
    )
    gains = [
        f"{motor.name} {percent:.2g} %" if percent < 100 else f"{motor.name} not identifiable"
        for motor, percent in zip(e.robot.motors, e.gains, strict=False)  # empty without a payload
    ]
    lines = (
        f"ratio of intervals, plain to this reference: median {np.median(smaller):.2f}, smallest "
        f"{smaller.min():.2f}",
        f"plain references: geometric mean of {PLAIN_REFERENCES} random ones with "
        f"{min(HARMONICS, e.settings.harmonics)} harmonics and the same share of all limits",
        f"torque noise per row of the fit: {', '.join(f'{x:.3g}' for x in e.noise)} "
        f"({', '.join(dict.fromkeys(e.robot.effort_units))}): {e.noise_from}",
        f"parameters for the torque: {'none' if e.beta is None else e.knowledge.beta_from}",
        *(
            (
                f"expected 95 % half-widths of drive gains, from a run without and a run with "
                f"{payload}: {', '.join(gains)}",
            )
            if payload is not None
            else ()
        ),
    )
    return Section(title="expected intervals", table=table, lines=lines)


def _limit_section(e: Excitation) -> Section:
    n, percents = e.robot.n, [Number(100 * float(x), ".1f") for x in e.used]
    efforts = dict(zip(e.limits.names[3 * n : len(e.used)], percents[3 * n :], strict=True))
    rows: list[Row] = [
        (joint.name, *percents[j : 3 * n : n], efforts.pop(f"effort of joint {joint.name}", ""))
        for j, joint in enumerate(e.robot.joints)
    ]
    rows += [
        (name.removeprefix("effort of ").removeprefix("joint "), "", "", "", percent)
        for name, percent in efforts.items()
    ]
    return Section(
        title="used share of the limits, %",
        table=Table(columns=columns("joint", numbers=(*KINDS, "effort")), rows=tuple(rows)),
        lines=()
        if e.nearest is None
        else (f"smallest distance: {e.nearest[1]}, {e.nearest[0]:.3f} m",),
        warnings=e.warnings,
    )
