"""The Python interface of `import identification`: a fit of arrays, the main names, and the report in a notebook."""

import os
from typing import Literal, Unpack, cast

from numpy.typing import ArrayLike

from acquisition.robot import Robot, load_robot

from .data import OptionalColumns, RecordingFile, Recordings, Signals, load_signals, processes, signals_from_arrays
from .errors import IdentificationError
from .methods import Fit, Iteration, identify, identify_iv, identify_ls, validate
from .regression import Overrides


class FitChoices(OptionalColumns, total=False):
    """Optional arguments of a fit of arrays: the method, and further columns."""

    method: Literal["iv", "wls", "ols"]


def fit(
    q: ArrayLike,
    tau: ArrayLike,
    sample_rate_hz: float,
    robot: str | os.PathLike[str] | Robot,
    q_ref: ArrayLike | None = None,
    **choices: Unpack[FitChoices],
) -> Fit:
    """Base parameters of a robot from arrays, with the settings of its description.

    `identify_ls` and `identify_iv` do the same for a recording, and take other settings.

    Parameters
    ----------
    q : (N, n) measured joint positions, rad or m, time first.
    tau : (N, n) torques at the joint in N m, forces in N; in A or V where the description has no drive gain. Their
        timing is unknown: `torque_lag_s` of `[identification]` states the lag.
    sample_rate_hz : sample rate.
    robot : the description, or the path of a robot.toml.
    q_ref : (N, n) reference positions; without them `iv` uses the measured positions, and the instruments are not
        strictly exogenous (a warning of the fit).
    choices : `method`: `iv`, instrumental variables (default with `q_ref`); `wls` (default without) or `ols`, least squares
        weighted joint by joint or not.
        Columns (N, n), as for an import: `known_torque` on the joints from other sources than the drives, N m or N, same
        sign as `tau`; the model explains the sum. `feedforward` added to the controller's output, per motor in the unit of
        the recorded effort (which includes it); the simulated controller adds it too. `velocity` of the joints, rad/s or
        m/s, only compared with the derivative of q, which is fitted.

    Returns
    -------
    Fit : `beta` (b,) in the order of `base.names`, `estimate` with deviations, `errors`, `status`, `warnings`.

    Raises
    ------
    IdentificationError : arrays that do not fit together, or too little motion.
    AcquisitionError : the description cannot be read, or a velocity has a wrong unit or sign.
    """
    method = choices.get("method")
    columns = cast(OptionalColumns, {name: x for name, x in choices.items() if name != "method"})
    if method not in (None, "iv", "wls", "ols"):
        raise IdentificationError(key="method", value=method, expected="'iv', 'wls' or 'ols'")
    described = robot if isinstance(robot, Robot) else load_robot(robot)
    signals = signals_from_arrays(q, tau, sample_rate_hz, described, q_ref, **columns)
    return identify(signals, Overrides(), method=method)


def _fit_html(fit: Fit) -> str:
    """The report of a fit as HTML."""
    from .methods import fit_document
    from .report import to_html

    return to_html(fit_document(fit.problem.signals, fit))


Fit._repr_html_ = _fit_html
