"""Identification of the base dynamic parameters of a robot from a recording.

The subpackages, and the modules `fits` and `notebook`, lowest first. They use of each other
only what an `__init__` exports, and imports only run down::

    report       documents, their renderers, the JSON file of a fit, comparisons
    estimation   least squares, instrumental variables and their tests, on arrays
    data         a recording as signals on a uniform grid; where tasks run
    model        inverse and direct dynamics, friction and rotors, base parameters, physical
                 consistency (pinocchio)
    regression   settings, filters, weights of samples; the terms of the equation of motion, their
                 unknowns x, and the rows J, Z, r
    control      the control law that moves the robot: described, found, or the default PD
    simulation   the robot in closed loop, instruments along its motion
    trust        tests of a solution
    methods      the method on one screen (`idim`), from recordings to a solution
    results      a fit with its tests, its file and its documents
    study        robots with known parameters: simulated recordings, the demo, studies; fits of
                 several robots over time
    export       a fit as URDF, MJCF and robot.toml; a description from a URDF
    design       exciting references, the choice of friction terms
    view         Rerun files and pages
    fits         a fit that was made or read, and what one does with it
    commands     the command line
    notebook     the names below: fits of arrays and of recordings

The main names are imported here on first use. A fit of arrays, its report and its
model for a simulator:

>>> import identification
>>> log = identification.simulate_recording("robot.toml", "log.mcap")
>>> fit = identification.fit(log.q, log.effort, log.sample_rate_hz, "robot.toml", log.q_ref)
>>> fit.verdict
'trust'
>>> [f"{p.value:.2f} {p.unit}" for p in fit.parameters if p.name == "ZZ2"]
['0.06 kg m²']
>>> fit.write_report("report.html")
>>> limits_of_the_format = fit.export(mjcf="robot.xml")
"""

from typing import TYPE_CHECKING

from acquisition.lazy import lazy_names

if TYPE_CHECKING:  # type checkers follow names that a module imports only to their own modules
    from .data import RecordingFile, Recordings, Signals, Work, load_signals
    from .design import ExcitationSettings, select_friction
    from .errors import BadInputError, DoNotUseWarning, NoFitError, RobotIdimError
    from .fits import Fit
    from .methods import Iteration
    from .notebook import *
    from .regression import Overrides
    from .study import Noise, Study

__all__ = [
    "BadInputError",
    "DoNotUseWarning",
    "ExcitationSettings",
    "Fit",
    "Iteration",
    "NoFitError",
    "Noise",
    "Overrides",
    "RecordingFile",
    "Recordings",
    "RobotIdimError",
    "Signals",
    "Study",
    "Work",
    "design_reference",
    "fit",
    "fit_log",
    "identify_iv",
    "identify_ls",
    "load_signals",
    "read_fit",
    "read_robot",
    "run_study",
    "select_friction",
    "simulate_recording",
    "validate",
]

_ERRORS = ("BadInputError", "DoNotUseWarning", "NoFitError", "RobotIdimError")

if not TYPE_CHECKING:  # a type checker would accept any name
    __getattr__, __dir__ = lazy_names(
        __name__,
        {"errors": _ERRORS, "notebook": tuple(name for name in __all__ if name not in _ERRORS)},
    )
