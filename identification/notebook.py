"""The Python interface of `import identification`.

It has fits, what one does with a fit, and the main names.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, wraps
from pathlib import Path
from typing import Any, Literal, ParamSpec

import numpy as np
from numpy.typing import ArrayLike

from acquisition.errors import COMMAND_LINE
from acquisition.files import refuse_clash, write_text
from acquisition.robot import Robot, parse_payload

from . import design, export, report, results, study
from .arrays import Array
from .data import (
    RecordingFile,
    Recordings,
    Signals,
    Work,
    load_signals,
    signals_from_arrays,
)
from .design import Excitation, ExcitationSettings, select_friction
from .errors import BadInputError, DoNotUseWarning, NoFitError, RobotIdimError
from .fits import File, Fit, load
from .methods import Iteration
from .options import LogOptions
from .regression import Overrides
from .report import ValidationFile
from .study import Noise, Run, Study

P = ParamSpec("P")


def _of_user(found: results.Evidence) -> Fit:
    """Return a fit, with a `DoNotUseWarning` at the user's line if its verdict is `do not use`.

    Only functions that users call directly call this, because the warning counts the frames up to
    the line of the user.
    """
    fit = Fit.of(found)
    if refused := [line.text for line in fit.trust if line.level == "do not use"]:
        warnings.warn(f"do not use {fit!r}: {'; '.join(refused)}", DoNotUseWarning, stacklevel=3)
    return fit


def _for_users(identify: Callable[P, results.Evidence]) -> Callable[P, Fit]:
    @wraps(identify)
    def identified(*args: P.args, **kwargs: P.kwargs) -> Fit:
        return _of_user(identify(*args, **kwargs))

    return identified


identify_ls, identify_iv = _for_users(results.identify_ls), _for_users(results.identify_iv)


def read_fit(path: File) -> Fit:
    """Read a fit: the earlier name of `load`."""
    return load(path)


def read_robot(
    path: File,
    *,
    joints: Sequence[str] = (),
    bandwidth_hz: float | None = None,
    position: float | Sequence[float] | None = None,
    speed: float | Sequence[float] | None = None,
    acceleration: float | Sequence[float] | None = None,
) -> Robot:
    """Read a robot from a robot.toml, or from a URDF and the values that a URDF lacks.

    Other functions of this package accept the path of either file in place of a robot.

    Parameters
    ----------
    path : robot.toml or URDF.
    joints : names of the joints to identify, from the base outwards. Default: the longest serial
        chain of the URDF.
    bandwidth_hz : bandwidth of the position loops, Hz. A fit needs it.
    position : position limits, ± about zero, rad or m; one value for all joints, or one per joint.
    speed : speed limits, rad/s or m/s; one value for all joints, or one per joint.
    acceleration : acceleration limits, rad/s² or m/s²; one value for all joints, or one per joint.

    Returns
    -------
    The robot.

    Raises
    ------
    BadInputError : the file cannot be read, or values are given for a robot.toml, which has keys
        for them.
    """
    given = _as_tuples(
        bandwidth_hz=bandwidth_hz, position=position, speed=speed, acceleration=acceleration
    )
    return export.read_robot(Path(path), joints, given)


def _as_tuples(**given: Any) -> dict[str, tuple[Any, ...]]:
    """Return what is given, one value or several, as tuples."""
    return {
        name: tuple(np.atleast_1d(value).tolist())
        for name, value in given.items()
        if value is not None
    }


def _robot(robot: File | Robot) -> Robot:
    return robot if isinstance(robot, Robot) else read_robot(robot)


def fit(
    q: ArrayLike | Sequence[ArrayLike],
    tau: ArrayLike | Sequence[ArrayLike],
    sample_rate_hz: float | Sequence[float],
    robot: File | Robot,
    q_ref: ArrayLike | Sequence[ArrayLike] | None = None,
    *,
    method: Literal["iv", "wls", "ols"] | None = None,
    bandwidth_hz: float | None = None,
    cutoff_hz: float | None = None,
    decimation: int | None = None,
    low_speed_percent: float | None = None,
    torque_lag_s: float | Literal["none"] | None = None,
    essential: bool = False,
    velocity: ArrayLike | Sequence[ArrayLike] | None = None,
    known_torque: ArrayLike | Sequence[ArrayLike] | None = None,
    feedforward: ArrayLike | Sequence[ArrayLike] | None = None,
    payload: str | Sequence[str | None] | None = None,
    gains: Sequence[str] = (),
) -> Fit:
    """Identify the base parameters of a robot from arrays.

    To fit several recordings together, pass a list of arrays for each array, one per recording, and
    one sample rate or a list. Settings that are not given follow the keys of `[identification]`,
    else the rules of the package. `identify_ls` and `identify_iv` fit files.

    Parameters
    ----------
    q : measured joint positions, shape (N, n), rad or m, time first.
    tau : joint torques, shape (N, n), N m, or forces, N; in A or V if the description has no drive
        gains. Their timing is taken as unknown; `torque_lag_s` gives their delay.
    sample_rate_hz : sample rate, Hz. If `q` comes from a recording whose rate differs by more than
        5 %, a warning is given and the rate of the recording is used.
    robot : the robot, or the path of its robot.toml or URDF.
    q_ref : reference positions, shape (N, n), rad or m. Without them `iv` takes its instruments
        from the measured positions, which are not strictly exogenous; the fit then has a warning.
    method : `iv`, instrumental variables; `wls`, least squares weighted by joint; `ols`, least
        squares without weights. Default: `iv` if `q_ref` is given, else `wls`.
    bandwidth_hz : bandwidth of the position loops, Hz; allowed only with the path of a URDF, which
        does not contain it.
    cutoff_hz : cut-off frequency of the position filter, Hz; 0 for no filter. Default: 5 times the
        bandwidth.
    decimation : samples per row of the fit. Default: from the sample rate and the bandwidth.
    low_speed_percent : speed below which samples have zero weight, percent of the peak speed.
    torque_lag_s : delay of the torque to be compensated, s, positive if late; `none` for no
        correction.
    essential : True to fit only the essential parameters.
    velocity : measured joint speeds, shape (N, n), rad/s or m/s. They are only compared with the
        derivative of `q`, which is fitted.
    known_torque : external torques on the joints, shape (N, n), N m or N, with the sign of `tau`.
        The model explains the sum of both.
    feedforward : feed-forward added to the output of the controller, shape (N, n), one column per
        motor, in the unit of the recorded effort, which includes it. The simulated controller adds
        it too.
    payload : payload of the robot as `KG@X,Y,Z`, kg and m. For several recordings, a sequence with
        None for no payload.
    gains : names of the motors whose drive gains are identified, from recordings with and without a
        payload; `("all",)` for all motors.

    Returns
    -------
    The fit. The verdict `do not use` also gives a `DoNotUseWarning`.

    Raises
    ------
    BadInputError : the arrays do not fit together, a setting is out of range, the description
        cannot be read, or a velocity has the wrong unit or sign.
    NoFitError : the robot moves too little.
    """
    COMMAND_LINE.require(
        method in (None, "iv", "wls", "ols"), "method", method, "'iv', 'wls' or 'ols'"
    )
    COMMAND_LINE.require(
        not isinstance(robot, Robot) or bandwidth_hz is None,
        "bandwidth_hz",
        bandwidth_hz,
        text="requires the path of a URDF as robot",
    )
    overrides = Overrides(
        cutoff_hz=cutoff_hz,
        decimation=decimation,
        low_speed_percent=low_speed_percent,
        torque_lag_s=torque_lag_s,
        gains=tuple(gains) or None,
    )
    for key in ("cutoff_hz", "decimation", "low_speed_percent"):
        value = getattr(overrides, key)
        COMMAND_LINE.require(value is None or 0 <= value < float("inf"), key, value, "0 or greater")
    described = robot if isinstance(robot, Robot) else read_robot(robot, bandwidth_hz=bandwidth_hz)
    first = q[0] if isinstance(q, list | tuple) and q else ()
    several = isinstance(payload, list | tuple) or np.asarray(first, dtype=object).ndim == 2
    given: dict[str, Any] = {
        "q": q,
        "effort": tau,
        "sample_rate_hz": sample_rate_hz,
    }
    optional = {
        "q_ref": q_ref,
        "velocity": velocity,
        "known_torque": known_torque,
        "feedforward": feedforward,
        "payload": payload or "",
    }
    given |= {name: x for name, x in optional.items() if x is not None}
    sources = _several_of_arrays(described, given) if several else (_of_arrays(described, given),)
    return _of_user(
        results.identify(Recordings(sources=sources), overrides, method=method, essential=essential)
    )


def fit_log(
    path: File,
    robot: File,
    *,
    effort_unit: str | Sequence[str] | None = None,
    drive_gain: float | Sequence[float] | None = None,
    ratio: float | Sequence[float] | None = None,
    position_unit: str | Sequence[str] | None = None,
    columns: str | None = None,
    topic: str | None = None,
    method: Literal["iv", "wls", "ols"] | None = None,
    overwrite: bool = False,
) -> Fit:
    """Identify the base parameters of a robot from the log of another program.

    Recording, description and map are written beside the log: `LOG.mcap`, `LOG.robot.toml` for a
    URDF, and `LOG.map.toml` for a table, with the reason of each of its lines. What the log does
    not show is never guessed.

    Parameters
    ----------
    path : CSV or MAT table, ROS 2 bag, CAN log or EtherCAT capture.
    robot : URDF, or robot.toml, which a CAN log needs.
    effort_unit : unit of the efforts: `N m` or `N` at the joints, or at motors with a `ratio`; `A`,
        `mA`, `V`, `%`, ... of the motors. One for all joints, or one per joint.
    drive_gain : torque, N m, or force, N, per unit of effort: of the motor, or without `ratio` at
        the joint.
    ratio : motor rad (or m) per joint rad (or m), sign included.
    position_unit : unit of the positions: `rad`, `deg`, `m` or `mm`.
    columns : columns of a table, as `position=2-7,effort=8-13`; `rate=250` for a table without
        times.
    topic : topic of a ROS 2 bag. Default: the only one.
    method : as for `fit`.
    overwrite : True to make recording, description and map anew.

    Returns
    -------
    The fit. The verdict `do not use` also gives a `DoNotUseWarning`.

    Raises
    ------
    BadInputError : the log does not show something that is not given, a file cannot be read, or one
        to be written exists.
    NoFitError : the robot moves too little.
    """
    given = LogOptions(
        columns=columns,
        topic=topic,
        overwrite=overwrite,
        **_as_tuples(
            effort_unit=effort_unit,
            drive_gain=drive_gain,
            ratio=ratio,
            position_unit=position_unit,
        ),
    )
    recording, document = export.import_foreign_log(Path(path), Path(robot), given)
    for text in (text for section in document.sections for text in section.warnings):
        warnings.warn(text, stacklevel=2)
    source = RecordingFile.at(recording)
    return _of_user(results.identify(Recordings(sources=(source,)), Overrides(), method=method))


def _several_of_arrays(robot: Robot, given: dict[str, Any]) -> tuple[Signals, ...]:
    """Make recordings from lists of arrays; what is not a list belongs to every recording."""
    count = len(given["q"])
    for name, x in given.items():
        given[name] = x if isinstance(x, list | tuple | np.ndarray) else [x] * count
        COMMAND_LINE.require(
            len(given[name]) == count,
            f"len({name})",
            len(given[name]),
            f"{count}, one for each array of q",
        )
    each = (_of_arrays(robot, {name: x[k] for name, x in given.items()}) for k in range(count))
    return tuple(
        replace(one, recording=f"{one.recording} {k}") for k, one in enumerate(each, start=1)
    )


def _of_arrays(robot: Robot, given: dict[str, Any]) -> Signals:
    text = given.pop("payload")
    return replace(
        signals_from_arrays(robot=robot, **given),
        payload=parse_payload(text, robot, "payload") if text else None,
    )


# `help` would write out numpy's ArrayLike, in 5000 characters
fit.__annotations__ = {"return": Fit}


def validate(
    fit: Fit, recording: Signals | File, overrides: Overrides | None = None
) -> ValidationFile:
    """Compute the torque errors of a fit on a recording that it was not fitted to.

    Parameters
    ----------
    fit : the fit.
    recording : another recording of the robot, or its path.
    overrides : settings that replace those of the fit.

    Returns
    -------
    The torque errors, percent: `relative_error_percent` of all joints and, in `joints`, of each
        joint; `warnings`; and `ahead`, the errors of positions that the fit predicts by simulation,
        by time in s.

    Raises
    ------
    BadInputError : the recording cannot be read, or is of another robot.
    """
    return fit.validate(recording, overrides)


def design_reference(
    robot: File | Robot,
    settings: ExcitationSettings | None = None,
    *,
    fit: File | None = None,
    noise: Sequence[float] | None = None,
    after: Sequence[File] = (),
    payload: str | None = None,
) -> Excitation:
    """Design an exciting reference trajectory within the limits of the robot.

    Parameters
    ----------
    robot : the robot, or the path of its robot.toml or URDF. All joints need limits.
    settings : period, harmonics, number of periods, seed, and share of the limits.
    fit : JSON file of a fit, for parameters and noise. Default: `[parameters]` of the description.
    noise : standard deviation of the torque noise per row of the fit, N m or N; one value for all
        joints, or one per joint. Default: from the fit, else 2 % of the rms torque.
    after : paths of earlier recordings, whose information is added.
    payload : payload of a second run of the reference, to identify drive gains, as `KG@X,Y,Z`, kg
        and m.

    Returns
    -------
    The reference with the expected intervals. Its `write` makes the CSV for `robot-acquire record
    --track`.

    Raises
    ------
    BadInputError : a limit is missing, the drives cannot follow the reference, or no reference
        excites all parameters.
    NoFitError : no reference within the limits is found.
    """
    described = _robot(robot)
    place, folder = (
        (robot.name, None) if isinstance(robot, Robot) else (str(robot), Path(robot).parent)
    )
    prior = design.prior_information(
        described,
        folder,
        fit=None if fit is None else Path(fit),
        noise=noise,
        after=[Path(path) for path in after],
        payload=parse_payload(payload, described, "payload") if payload else None,
    )
    return design.excite(described, settings or ExcitationSettings(), prior, place)


def simulate_recording(
    robot: File | Robot, out: File, settings: Study | None = None, payload: str | None = None
) -> Signals:
    """Simulate the robot of `[parameters]`, write a recording of it, and read the recording.

    Parameters
    ----------
    robot : the robot, or the path of its robot.toml or URDF.
    out : MCAP file to write.
    settings : length, sample rate, seed and noise.
    payload : payload as `KG@X,Y,Z`, kg and m.

    Returns
    -------
    The signals of the recording.

    Raises
    ------
    BadInputError : a parameter or a limit is missing, or `out` exists.
    NoFitError : the robot cannot be simulated along the reference.
    """
    described = _robot(robot)
    refuse_clash((), of_kinds={"mcap": Path(out)})
    study.simulate_recording(
        described,
        Path(out),
        settings or Study(),
        parse_payload(payload, described, "payload") if payload else None,
    )
    return load_signals(out)


def run_study(
    robot: File | Robot, settings: Study | None = None, work: Work | None = None
) -> list[Run]:
    """Fit simulated recordings of the robot of `[parameters]` by least squares and by IV.

    Parameters
    ----------
    robot : the robot, or the path of its robot.toml or URDF.
    settings : number, length, sample rate, seed and noise of the recordings.
    work : where the recordings are simulated and fitted, such as `Work(4)` for four processes.

    Returns
    -------
    The runs, in order.

    Raises
    ------
    BadInputError : a parameter or a limit is missing.
    """
    return list(study.run_study(_robot(robot), settings or Study(), work or Work()))
