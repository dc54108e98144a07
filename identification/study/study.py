"""Monte-Carlo studies of robots with known parameters.

Simulated recordings are each fitted by both methods as users fit. The module has the summaries,
report and file of a study, and those of base parameters. It also reports fits of simulated
recordings beside the true values.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.robot import Payload, Robot, robot_from_files

from ..arrays import Array, Bools
from ..data import Signals, Work
from ..errors import RobotIdimError
from ..estimation import one_thread
from ..methods import Iteration
from ..model import (
    BaseParameters,
    InverseModel,
    direct_model_of_base,
    known_parameters,
    poses_of,
    why_not_positive,
)
from ..options import StudyOptions
from ..regression import Overrides
from ..report import PER_INTERVAL, Document, Number, Row, Section, Table, columns, value_form
from ..results import Evidence, identify_iv, identify_ls
from .simulated_cell import Noise, closed_loop, random_reference, study_truth, write_signals

FALSE_TRUST = 3.0  # half-widths: largest error of an essential parameter for `trust`
METHODS = (("wls", "ls"), ("iv", "iv"))  # and the field of a `Run`
# Headings and formats of the fields of a `Summary`, in their order.
HEADINGS = ("runs", "bias, %", "coverage, %", "spread /\nhalf-width", "trust", "false\ntrust")
FORMATS = ("d", ".3f", ".1f", ".2f", "d", "d")


@dataclass(frozen=True, kw_only=True)
class Study(StudyOptions):
    """Settings of simulated recordings; the seed of each follows from `seed` and its number.

    Attributes:
        runs: number of recordings.
        duration_s: length of a recording, s.
        sample_rate_hz: sample rate, Hz.
        seed: seed of the random references and of the noise.
        noise: noise of the simulated measurements.
    """

    noise: Noise = field(default_factory=Noise)


def simulate_recording(
    robot: Robot, out: Path, study: Study, payload: Payload | None = None
) -> None:
    """Write a recording of the simulated robot of `[parameters]`.

    Parameters
    ----------
    robot : the robot, with `[parameters]`.
    out : MCAP file to write.
    study : length, sample rate, seed and noise.
    payload : payload of the robot; None for no payload.

    Raises
    ------
    BadInputError : as in `random_reference` and `closed_loop`, or the file cannot be written.
    NoFitError : the robot does not follow the reference.
    """
    write_signals(
        out,
        _simulated(robot, study, study.seed, payload),
        source=f"simulated: random reference and noise of seed {study.seed}",
        noise=study.noise,
    )


def _simulated(robot: Robot, study: Study, seed: int, payload: Payload | None = None) -> Signals:
    return closed_loop(
        robot,
        random_reference(
            robot, duration_s=study.duration_s, sample_rate_hz=study.sample_rate_hz, seed=seed
        ),
        study.sample_rate_hz,
        noise=study.noise,
        seed=seed,
        payload=payload,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class RunFit:
    """The fit of a run by one method, compared with the truth. Vectors are (b,).

    Attributes:
        error: |beta - true| / |true| over all parameters.
        low, high: the 95 % intervals.
        verdict: of the fit's tests.
        essential: True if the recording determines a parameter well.
        positive: True if M of the estimate is positive along the motion.
    """

    beta: Array
    error: float
    low: Array
    high: Array
    verdict: str
    essential: Bools
    positive: bool

    def half_widths_off(self, true: Array) -> Array:
        """Return distances (b,) of the true values from the middles of the intervals.

        Distances are in half-widths.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.abs(self.low + self.high - 2 * true) / (self.high - self.low))


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One run of a study, and its fits if it has any.

    Attributes:
        number: number of the run, from 0.
        status: status of IV.
        reason: why it is not `converged`, or why there is no fit; None if it converged.
        ls: the fit by least squares; None if it failed.
        iv: the fit by instrumental variables; None if it failed.
    """

    number: int
    status: str = "diverged"
    reason: str | None = None
    ls: RunFit | None = None
    iv: RunFit | None = None


def run_study(robot: Robot, study: Study, work: Work) -> Iterator[Run]:
    """Simulate and fit all runs of a study.

    Parameters
    ----------
    robot : the robot, with `[parameters]`.
    study : number, length, sample rate, seed and noise of the recordings.
    work : where the runs are simulated and fitted.

    Returns
    -------
    The runs in order, as an iterator; a run that fails has a `reason`.

    Raises
    ------
    BadInputError : the description has no `[parameters]`, or neither a controller nor a bandwidth.
        The iterator raises it too, if a worker ends early.
    """
    study_truth(robot)
    if robot.controller.structure is None:
        _ = robot.bandwidth_hz  # of the PD that is simulated: refused before any run
    return work.run(one_run, [(dict(robot.files), study, number) for number in range(study.runs)])


@one_thread
def one_run(files: Mapping[str, bytes], study: Study, number: int) -> Run:
    """Simulate and fit one run of a study.

    The same number gives the same run.

    Parameters
    ----------
    files : files of the description by name.
    study : length, sample rate, seed and noise of the recordings.
    number : number of the run.

    Returns
    -------
    The run; if it fails, with a `reason`.

    Raises
    ------
    BadInputError : a file of the description is missing or wrong, or has no `[parameters]`.
    """
    robot, run = robot_from_files(files, "study"), Run(number=number)
    base, true = study_truth(robot)

    def result(fit: Evidence) -> RunFit:
        model = direct_model_of_base(InverseModel(robot), base, fit.beta)
        return RunFit(
            beta=fit.beta,
            error=float(np.linalg.norm(fit.beta - true) / np.linalg.norm(true)),
            low=fit.intervals.low,
            high=fit.intervals.high,
            verdict=fit.trust.verdict,
            essential=np.isin(base.names, fit.essential.names),
            positive=why_not_positive(model.inertia(poses_of(signals.q))) is None,
        )

    try:
        signals = _simulated(
            robot, study, int(np.random.default_rng([study.seed, number]).integers(2**31))
        )
        ls = identify_ls(signals, Overrides())
        run = replace(run, ls=result(ls))
        iv = identify_iv(signals, Overrides(law=ls.law), Iteration())
    except RobotIdimError as error:
        return replace(run, reason=str(error))
    return replace(run, status=iv.status, reason=iv.solution.reason, iv=result(iv))


@dataclass(frozen=True, kw_only=True, eq=False)
class Summary:
    """Runs by one method: of wls those with an estimate, of iv those that converged.

    NaN if there are none.

    Attributes:
        bias_percent: norm of the mean error over all parameters, in percent of the norm of the true
            ones.
        coverage_percent: true values inside their 95 % intervals, over all parameters.
        spread_over_interval: median over the parameters of 1.96 observed standard deviations over
            the half-width.
        trusted, false_trust: runs with the verdict `trust`; those of them in which an essential
            parameter is wrong by more than `FALSE_TRUST` half-widths or M is not positive.
    """

    method: str
    runs: int
    bias_percent: float
    coverage_percent: float
    spread_over_interval: float
    trusted: int
    false_trust: int


def summaries(runs: Sequence[Run], true: Array) -> list[Summary]:
    """Return one summary per method.

    Parameters
    ----------
    runs : the runs.
    true : values of the base parameters simulated with, shape (b,).

    Returns
    -------
    The summaries of `wls` and `iv`.
    """
    rows = []
    for method, kind in METHODS:
        fits = [
            fit
            for r in runs
            if (fit := getattr(r, kind)) and (method == "wls" or r.status == "converged")
        ]
        beta, low, high = (
            np.array([getattr(x, k) for x in fits] or [true * np.nan])
            for k in ("beta", "low", "high")
        )
        spread = beta.std(axis=0, ddof=1) if len(fits) > 1 else true * np.nan
        inside = [fit.half_widths_off(true) <= 1 for fit in fits]
        rows.append(
            Summary(
                method=method,
                runs=len(fits),
                bias_percent=float(
                    100 * np.linalg.norm(beta.mean(axis=0) - true) / np.linalg.norm(true)
                ),
                coverage_percent=float(100 * np.mean(inside)) if inside else np.nan,
                spread_over_interval=float(
                    np.median(2 * PER_INTERVAL * spread / np.median(high - low, axis=0))
                ),
                trusted=sum(fit.verdict == "trust" for fit in fits),
                false_trust=sum(false_trust(fit, true) for fit in fits),
            )
        )
    return rows


def false_trust(fit: RunFit, true: Array) -> bool:
    """Test whether the verdict is wrongly `trust`.

    It is wrong if an essential parameter is more than `FALSE_TRUST` half-widths off, or if M is not
    positive.

    Parameters
    ----------
    fit : the fit of a run.
    true : true values of the base parameters, shape (b,).

    Returns
    -------
    True if the verdict is `trust` and wrong.
    """
    off = fit.half_widths_off(true)[fit.essential]
    return fit.verdict == "trust" and (not fit.positive or bool((off > FALSE_TRUST).any()))


def study_file(
    study: Study, runs: Sequence[Run], base: BaseParameters, true: Array
) -> dict[str, Any]:
    """Make the JSON file of a study.

    Parameters
    ----------
    study : settings of the study.
    runs : all runs.
    base : base parameters of the robot.
    true : their true values, shape (b,).

    Returns
    -------
    The content by key: settings, names of the parameters, their true values, summaries, and every
    run.
    """
    return {
        "study": study,
        "parameters": base.names,
        "true": true,
        "summaries": summaries(runs, true),
        "runs": runs,
    }


def study_document(robot: str, study: Study, runs: Sequence[Run], true: Array) -> Document:
    """Make the report of a study.

    Parameters
    ----------
    robot : name of the robot.
    study : settings of the study.
    runs : the runs made.
    true : true values of the base parameters, shape (b,).

    Returns
    -------
    The report: summaries by method, the settings, and the runs with false trust.
    """
    false = [
        f"{method} in run {run.number}"
        for run in runs
        for method, kind in METHODS
        if (fit := getattr(run, kind)) and false_trust(fit, true)
    ]
    section = Section(
        table=Table(
            columns=columns("method", numbers=HEADINGS),
            rows=tuple(
                (method, *map(Number, numbers, FORMATS))
                for method, *numbers in map(astuple, summaries(runs, true))
            ),
        ),
        lines=(
            f"{study.runs} runs of {study.duration_s:g} s at {study.sample_rate_hz:g} Hz, seed "
            f"{study.seed}; noise: {study.noise.text}; of iv only runs that converged",
            "false trust (verdict trust, but an essential parameter is wrong by more than "
            f"{FALSE_TRUST:g} half-widths or M is not positive): {', '.join(false) or 'no run'}",
        ),
    )
    return Document(title=f"{robot}: {len(runs)} runs", sections=(section,))


def border_line(robot: Robot) -> tuple[str, ...]:
    """Return a line on the friction and rotors that the study simulated without.

    No real robot lacks these.

    Parameters
    ----------
    robot : the robot, with `[parameters]`.

    Returns
    -------
    The line, or nothing if all have values.

    Raises
    ------
    BadInputError : the description has no `[parameters]`, or the robot cannot be modelled.
    """
    model = InverseModel(robot)
    names = [
        name
        for name, skip in zip(
            model.names, model.of_links | (known_parameters(model) != 0), strict=True
        )
        if not skip and not name.startswith("Off")
    ]
    text = f"0 or missing in [parameters], unlike in a real robot: {', '.join(names)}"
    return (text,) if names else ()


def base_file(base: BaseParameters, robot: Robot, true: Array | None = None) -> dict[str, Any]:
    """Make the JSON file of base parameters.

    Their names end with a joint's number from 1.

    Parameters
    ----------
    base : the base parameters.
    robot : the robot.
    true : their true values, shape (b,), in SI units; None if they are not known.

    Returns
    -------
    The content by key: robot, joint names, and parameters with name, expression, unit and, if
    known, value.
    """
    each = {
        "name": base.names,
        "expression": base.expressions,
        "unit": base.units,
        **({} if true is None else {"value": true.tolist()}),
    }
    return {
        "robot": robot.name,
        "joint_names": [joint.name for joint in robot.joints],
        "parameters": [
            dict(zip(each, row, strict=True)) for row in zip(*each.values(), strict=True)
        ],
    }


def base_document(base: BaseParameters, robot: Robot) -> Document:
    """Make the report of the base parameters as sums of standard parameters.

    The short form has the regrouped ones.

    Parameters
    ----------
    base : the base parameters.
    robot : the robot.

    Returns
    -------
    The report, with the numbers of the joints.
    """
    section = Section(
        table=Table(
            columns=columns("name", "expression", "unit"),
            rows=tuple(zip(base.names, base.expressions, base.units, strict=True)),
        )
    )
    return Document(
        title=f"{robot.name}: {base.b} base parameters",
        sections=(
            section.with_short_table(
                sorted(range(base.b), key=lambda k: base.expressions[k] == base.names[k]), 20
            ),
            Section(
                title="joints by the number at the end of names",
                table=Table(
                    columns=columns("number", "joint", "type"),
                    rows=tuple(
                        (str(j), joint.name, joint.type) for j, joint in enumerate(robot.joints, 1)
                    ),
                ),
            ),
        ),
    )


def truth_document(robot: str, fits: Sequence[Evidence], true: Array) -> Document:
    """Make the report of estimates next to the true values of a simulated recording.

    Parameters
    ----------
    robot : name of the robot.
    fits : fits of the recording by different methods.
    true : true values of the base parameters, shape (b,).

    Returns
    -------
    The report: estimates, half-widths of their 95 % intervals, and errors in these.
    """
    halves, rows = [fit.intervals.half for fit in fits], list[Row]()
    for i, (name, x) in enumerate(zip(fits[0].base.names, true, strict=True)):
        of_fits = [(fit.beta[i], half[i]) for fit, half in zip(fits, halves, strict=True)]
        form = value_form(float(min(half for _, half in of_fits)) / 2)
        cells = (
            cell
            for value, half in of_fits
            for cell in (
                Number(float(value), form),
                Number(float(half), form),
                Number(float((value - x) / half) if half > 0 else None, "+.2f"),
            )
        )
        rows.append((name, Number(float(x), form), *cells))
    headings = (
        heading for x in fits for heading in (x.method, "95 % half-width", "error, half-widths")
    )
    section = Section(
        title="Estimates compared with the true values",
        table=Table(columns=columns("parameter", numbers=("true", *headings)), rows=tuple(rows)),
        lines=tuple(
            f"{fit.method}: {(np.abs(fit.beta - true) <= half).sum()} of {len(true)} true values "
            f"lie inside their 95 % intervals ({0.95 * len(true):.0f} expected); total error "
            f"{100 * np.linalg.norm(fit.beta - true) / np.linalg.norm(true):.2f} %"
            for fit, half in zip(fits, halves, strict=True)
        ),
    )
    largest = np.lexsort(
        (-np.abs(true), ~np.isin(fits[-1].base.names, fits[-1].essential_names))
    ).tolist()
    return Document(
        title=f"{robot}: {len(true)} estimated parameters and their true values",
        sections=(section.with_short_table(largest),),
    )


def gains_document(fit: Evidence, true: Sequence[float]) -> Document:
    """Make the report of identified drive gains beside the described and the true ones.

    Parameters
    ----------
    fit : fit with drive gains.
    true : true gains by motor, in the unit of the identified ones.

    Returns
    -------
    The report; each gain has its error in half-widths.
    """
    off = [x.value - y for x, y in zip(fit.gains, true, strict=True)]
    within = sum(abs(x) <= one.half_width for x, one in zip(off, fit.gains, strict=True))
    rows: list[Row] = [
        (
            one.motor,
            *(Number(x, form) for x in (one.described, of_drive, one.value, one.half_width)),
            Number(error / one.half_width, "+.2f"),
            one.unit,
        )
        for one, of_drive, error in zip(fit.gains, true, off, strict=True)
        for form in [value_form(one.half_width / 2)]
    ]
    section = Section(
        table=Table(
            columns=columns(
                "motor",
                numbers=(
                    "in robot.toml",
                    "true",
                    "identified",
                    "95 % half-width",
                    "error, half-widths",
                ),
            )
            + columns("unit"),
            rows=tuple(rows),
        ),
        lines=(
            f"{within} of {len(true)} true values lie inside their 95 % intervals. Verdict of the "
            f"fit: {fit.trust.verdict}.",
            f"Payload of {fit.recordings[-1].signals.recording}: "
            f"{fit.recordings[-1].signals.payload}",
        ),
    )
    return Document(
        title=f"Drive gains of {', '.join(one.signals.recording for one in fit.recordings)}",
        sections=(section,),
    )
