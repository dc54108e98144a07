"""Identifies the base dynamic parameters of a robot from a recording.

The rooms, ground floor first. Each is entered by its face, what its `__init__` shows; imports only run down::

    data         a recording as signals on a uniform grid
    model        inverse and direct dynamics, friction and rotors, base parameters (pinocchio)
    regression   settings, filters, the over-determined system W, Y, and the rows that count
    estimation   least squares, instrumental variables and their tests, on arrays
    simulation   the robot in closed loop: control laws, friction with stick phases
    methods      the method on one screen (`idim`), the simulated replica of the experiment, what a fit is worth
    study        robots whose parameters are known: simulated recordings, the demo, Monte-Carlo studies
    report       what is told of a fit: tables, JSON, comparison, the terminal
    view         pictures for Rerun
    commands     the command line
"""
