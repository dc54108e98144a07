"""The Python interface of `import identification`: fits, what one does with a
fit, and the main names.
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
from .fits import File, Fit
from .methods import Iteration
from .regression import Overrides
from .report import ValidationFile
from .study import Noise, Run, Study

P = ParamSpec("P")


def _of_user(found: results.Evidence) -> Fit:
    """Return the fit as users have it; called by what users call, so that the warning names their
    line.
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
    """Read the JSON file of a fit, or of known values.

    Parameters
    ----------
    path : file that `robot-identify fit --json` or `Fit.to_json` wrote.

    Returns
    -------
    The fit, without its rows and curves.

    Raises
    ------
    BadInputError : the file cannot be read, or is not a fit of this format.
    """
    return Fit.read(path)


def read_robot(
    path: File,
    *,
    joints: Sequence[str] = (),
    bandwidth_hz: float | None = None,
    position: float | Sequence[float] | None = None,
    speed: float | Sequence[float] | None = None,
    acceleration: float | Sequence[float] | None = None,
) -> Robot:
    """Read a robot from a robot.toml, or from a URDF with values that it lacks.

    Other functions take its path, too.

    Parameters
    ----------
    path : robot.toml or URDF.
    joints : joints to identify, from the base outwards; default: the longest serial chain of the
        URDF.
    bandwidth_hz : bandwidth of the position loops, Hz, which fits need.
    position, speed, acceleration : limits in rad or m (per s, s²), for all joints or by joint; the
        position is ± about zero.

    Returns
    -------
    The robot.

    Raises
    ------
    BadInputError : no such file, or a value beside a robot.toml, which has a key for it.
    """
    given = {
        name: tuple(np.atleast_1d(value).tolist())
        for name, value in (
            ("bandwidth_hz", bandwidth_hz),
            ("position", position),
            ("speed", speed),
            ("acceleration", acceleration),
        )
        if value is not None
    }
    return export.read_robot(Path(path), joints, given)


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

    For several recordings give lists of arrays, one for each, and one rate or a list. `identify_ls`
    and `identify_iv` do the same for files.

    Parameters
    ----------
    q : (N, n) measured joint positions, rad or m, time first.
    tau : (N, n) torques at the joint in N m, forces in N; in A or V if the description has no drive
        gain. Their timing is unknown: `torque_lag_s` gives the delay.
    sample_rate_hz : sample rate, Hz. If `q` is read from a recording whose rate differs by more
        than
        5 %, the recording's rate is used, with a warning.
    robot : the description, or the path of a robot.toml or of a URDF.
    q_ref : (N, n) reference positions; without them `iv` uses the measured positions, and the
        instruments are not strictly exogenous (a warning of the fit).
    method : `iv`, instrumental variables (default with `q_ref`); `wls` (default without), least
        squares
        weighted by joint; or `ols`, without weights.
    bandwidth_hz : bandwidth of the position loops, Hz; for a URDF, which has none.
    cutoff_hz, decimation, low_speed_percent, torque_lag_s, essential : as options of
        `robot-identify fit` and keys of `[identification]`, in place of the rules; `cutoff_hz` 0:
        no filter; `torque_lag_s` `none`: no correction.
    velocity : (N, n) speeds of the joints, rad/s or m/s, only compared with the derivative of q,
        which is fitted.
    known_torque : (N, n) external torques on the joints, N m or N, same sign as `tau`; the model
        explains the sum.
    feedforward : (N, n) added to the controller's output, per motor in the unit of the recorded
        effort (which includes it); the simulated controller adds it too.
    payload : payload of the robot as `KG@X,Y,Z`, m; with a sequence, of each recording, None for
        nothing.
    gains : motors whose drive gains are identified, `("all",)` for all, from recordings with and
        without a payload.

    Returns
    -------
    Fit : `verdict`, `parameters`, `beta` (b,) in the order of `base.names`, `errors`, `status`,
        `warnings`; the verdict `do not use` is also a `DoNotUseWarning`.

    Raises
    ------
    BadInputError : arrays that do not fit together, a setting out of range, a description that
        cannot be read, or a velocity in a wrong unit or of a wrong sign.
    NoFitError : too little motion.
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


def _several_of_arrays(robot: Robot, given: dict[str, Any]) -> tuple[Signals, ...]:
    """Make recordings from lists of their arrays; what is not a list belongs to each."""
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
    """Make a recording from its arrays."""
    text = given.pop("payload")
    payload = parse_payload(text, robot, "payload") if text else None
    return replace(signals_from_arrays(robot=robot, **given), payload=payload)


# `help` would write out numpy's ArrayLike, in 5000 characters
fit.__annotations__ = {"return": Fit}


def validate(
    fit: Fit, recording: Signals | File, overrides: Overrides | None = None
) -> ValidationFile:
    """Compute the torque errors of a fit on another recording of the robot.

    Parameters
    ----------
    fit : the fit.
    recording : a recording that it was not fitted to.
    overrides : settings that replace those of the fit.

    Returns
    -------
    Errors in `relative_error_percent` and `joints`, `warnings`, and how far the fit predicts the
    motion,
    `ahead`.

    Raises
    ------
    BadInputError : the recording is of another robot.
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
    """Design an exciting reference within the limits of the robot.

    Parameters
    ----------
    robot : the description, or the path of a robot.toml or of a URDF; all joints need limits.
    settings : period, harmonics, seed and others.
    fit : JSON file with parameters and noise; default: `[parameters]`.
    noise : standard deviation of the torque per row of the fit, N m or N, one or by joint.
    after : recordings whose information is added.
    payload : `KG@X,Y,Z`, m, of a second run of the reference, to identify drive gains.

    Returns
    -------
    The reference with its expected intervals; `write` makes the CSV for `robot-acquire record
    --track`.

    Raises
    ------
    BadInputError : a limit is missing, or no reference is found.
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
    """Write and read a recording of the robot simulated with its `[parameters]`.

    Parameters
    ----------
    robot : the description, or the path of a robot.toml or of a URDF.
    out : file of the recording.
    settings : length, rate, seed and noise.
    payload : `KG@X,Y,Z`, m.

    Returns
    -------
    The signals of the recording.

    Raises
    ------
    BadInputError : a value or a limit is missing, or `out` exists.
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
    """Fit simulated recordings of the robot of `[parameters]`, by least squares and instrumental
    variables.

    Parameters
    ----------
    robot : the description, or the path of a robot.toml or of a URDF.
    settings : number, length, rate and noise of the recordings.
    work : where they run, such as `Work(4)`.

    Returns
    -------
    The runs, in order.

    Raises
    ------
    BadInputError : a value or a limit is missing.
    """
    return list(study.run_study(_robot(robot), settings or Study(), work or Work()))
