"""Identifies the base dynamic parameters of a robot from a recording.

The rooms, lowest first. Other rooms use only what a room's `__init__` exports; imports only run down::

    report       documents, their renderers, the JSON file of a fit, comparisons
    estimation   least squares, instrumental variables and their tests, on arrays
    data         a recording as signals on a uniform grid; where tasks run
    model        inverse and direct dynamics, friction and rotors, base parameters, physical consistency (pinocchio)
    regression   settings, filters, the over-determined system W, Y, row selection; load friction
    simulation   the robot in closed loop; the recorded experiment simulated, instruments
    trust        tests of a fit
    methods      the method on one screen (`idim`), several recordings, the verdict, documents of a fit
    study        robots with known parameters: simulated recordings, the demo, studies; fleets
    export       a fit as URDF, MJCF and robot.toml; a description from a URDF
    design       exciting references, the choice of friction terms
    view         Rerun files
    commands     the command line
    notebook     the names below, and a fit shown in a notebook

The main names are imported here on first use::

    import identification

    fit = identification.fit(q, tau, 1000.0, "robot.toml", q_ref)
    print(fit)
"""

from typing import TYPE_CHECKING

from acquisition.lazy import lazy_names

if TYPE_CHECKING:
    from .errors import IdentificationError
    from .notebook import (
        Fit,
        Iteration,
        Overrides,
        RecordingFile,
        Recordings,
        Signals,
        fit,
        identify_iv,
        identify_ls,
        load_signals,
        processes,
        validate,
    )

__all__ = [
    "Fit",
    "IdentificationError",
    "Iteration",
    "Overrides",
    "RecordingFile",
    "Recordings",
    "Signals",
    "fit",
    "identify_iv",
    "identify_ls",
    "load_signals",
    "processes",
    "validate",
]

if not TYPE_CHECKING:  # a type checker would accept any name
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "errors": ("IdentificationError",),
            "notebook": tuple(name for name in __all__ if name != "IdentificationError"),
        },
    )
