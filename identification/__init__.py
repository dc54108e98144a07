"""Identifies the base dynamic parameters of a robot from a recording.

The rooms, ground floor first. Each is entered by its face, what its `__init__` shows; imports only run down::

    estimation   least squares, instrumental variables and their tests, on arrays
    data         a recording as signals on a uniform grid
    model        inverse and direct dynamics, friction and rotors, base parameters (pinocchio)
    regression   settings, filters, the over-determined system W, Y, and the rows that count
    simulation   the robot in closed loop: control laws, friction with stick phases
    methods      the method on one screen (`idim`), the simulated replica of the experiment, what a fit is worth
    study        robots whose parameters are known: simulated recordings, the demo, Monte-Carlo studies
    report       what is told of a fit: tables, JSON, comparison, the terminal
    view         pictures for Rerun
    commands     the command line

From Python, what the rooms show is here under one name, imported when it is first used::

    import identification

    fit = identification.fit(q, tau, 1000.0, "robot.toml", q_ref)
    print(fit)
"""

from typing import TYPE_CHECKING, Literal

from acquisition.lazy import lazy_names

if TYPE_CHECKING:
    import os

    from numpy.typing import ArrayLike

    from acquisition.robot import Robot

    from .data import Signals, load_signals
    from .errors import IdentificationError
    from .methods import Fit, Iteration, identify_iv, identify_ls, validate
    from .regression import Overrides

__all__ = [
    "Fit",
    "IdentificationError",
    "Iteration",
    "Overrides",
    "Signals",
    "fit",
    "identify_iv",
    "identify_ls",
    "load_signals",
    "validate",
]

if not TYPE_CHECKING:  # a type checker would take any name
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "data": ("Signals", "load_signals"),
            "errors": ("IdentificationError",),
            "methods": ("Fit", "Iteration", "identify_iv", "identify_ls", "validate"),
            "regression": ("Overrides",),
        },
        "fit",
    )


def fit(
    q: "ArrayLike",
    tau: "ArrayLike",
    sample_rate_hz: float,
    robot: "str | os.PathLike[str] | Robot",
    q_ref: "ArrayLike | None" = None,
    method: Literal["iv", "wls", "ols"] = "iv",
) -> "Fit":
    """Base parameters of a robot from arrays, with the settings of its description.

    `identify_ls` and `identify_iv` do the same for a recording, and take other settings.

    Parameters
    ----------
    q : (N, n) measured joint positions, rad or m, time first.
    tau : (N, n) torques at the joint in N m, forces in N; in A or V where the description has no drive gain.
    sample_rate_hz : rate of the samples.
    robot : the description, or the path of a robot.toml.
    q_ref : (N, n) reference positions; without them the measured positions take their place, which leaves the instruments of
        `iv` not strictly exogenous (a warning of the fit).
    method : `iv`, instrumental variables; `wls` or `ols`, least squares weighted joint by joint or not.

    Returns
    -------
    Fit : `beta` (b,) in the order of `base.names`, `estimate` with deviations, `errors`, `status`, `warnings`.

    Raises
    ------
    IdentificationError : where arrays do not belong together, or hold too little motion.
    AcquisitionError : where the description cannot be read.
    """
    from acquisition.robot import Robot, load_robot

    from .data import signals_from_arrays
    from .errors import IdentificationError
    from .methods import Iteration, identify_iv, identify_ls
    from .regression import Overrides

    if method not in ("iv", "wls", "ols"):
        raise IdentificationError(f"method = {method!r}: expected 'iv', 'wls' or 'ols'")
    described = robot if isinstance(robot, Robot) else load_robot(robot)
    signals = signals_from_arrays(q, tau, sample_rate_hz, described, q_ref)
    if method == "iv":
        return identify_iv(signals, Overrides(), Iteration())
    return identify_ls(signals, Overrides(), method=method)
