"""Identify the base parameters of a robot from positions and torques, and judge the result.

    import identification
    log = identification.simulate_recording("robot.toml", "log.mcap")  # or your own arrays
    fit = identification.fit(log.q, log.effort, log.sample_rate_hz, "robot.toml", log.q_ref)
    print(fit.verdict, fit["Fv1"], fit.parameters, sep="\\n")
    fit.save("fit.json")
    fit.export(mjcf="robot.xml")

A robot.toml or a URDF describes the robot. `fit.parameters`, `fit.trust`, `fit.assumed`,
`fit.errors` and `fit.compare(other)` are tables with `to_dict()` and `to_dataframe()`. In a
notebook, `fit` shows its report and `fit.plot()` its figures. `help(identification.fit)` lists all
arguments, `help(identification.Fit)` all results. The main names:

    fit                      fit arrays; the result is a `Fit`
    fit_log                  fit a log of another program (CSV, MAT, ROS 2 bag) with its URDF
    load                     read a fit that `Fit.save` wrote
    validate                 compute the torque errors of a fit on another recording
    load_signals             read a recording: q, q_ref, effort, t_s, sample_rate_hz
    identify_ls, identify_iv fit recordings by least squares, by instrumental variables
    read_robot               read a robot.toml, or a URDF with the values that it lacks
    simulate_recording       simulate a robot with known parameters
    design_reference         design an exciting trajectory
    select_friction          choose the friction terms of a recording
    run_study                fit many simulated recordings

Guides: identification/docs/start.md (a first fit), howto/python.md (this package), reading-a-fit.md
(what the verdict means); replay_data/notebook.ipynb is a fit from URDF to MuJoCo.

For developers, the subpackages and the modules `fits` and `notebook`, lowest first. They use of
each other only what an `__init__` exports, and imports only run down::

    report       documents, their renderers, tables, the JSON file of a fit, comparisons
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
    notebook     the names above: fits of arrays and of recordings
"""

from typing import TYPE_CHECKING

from acquisition.lazy import lazy_names

if TYPE_CHECKING:  # type checkers follow names that a module imports only to their own modules
    from .data import RecordingFile, Recordings, Signals, Work, load_signals
    from .design import ExcitationSettings, select_friction
    from .errors import BadInputError, DoNotUseWarning, NoFitError, RobotIdimError
    from .fits import Fit, load
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
    "load",
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
