"""`robot-identify`: one file per command, listed here in the order of the help."""

from acquisition.commands import Program

PROGRAM = Program(
    name="robot-identify",
    description="Identify the dynamic parameters of a robot from a recording.",
    package=__package__,
    commands={
        "fit": "identify base parameters from one or more recordings",
        "friction": "choose friction terms by cross-validation",
        "fleet": "fit all recordings of folders, and mark what has changed",
        "view": "draw a recording in Rerun, before a fit",
        "compare": "compare the parameters of two fits",
        "validate": "torque error of a fit on other recordings",
        "init": "make a robot.toml from a URDF; missing values are marked",
        "export": "export a fit as URDF, MJCF or robot.toml for simulation",
        "base": "base parameters of a robot, with their expressions",
        "excite": "make an exciting trajectory within the limits",
        "simulate": "make a recording of a simulated robot with known parameters",
        "study": "show how far to trust LS and IV, on a robot or a recording",
        "demo": "record simulated drives, fit, compare with the true values",
    },
    # what older versions had, and what to use instead
    gone={
        "schema": "all keys of robot.toml are in identification/docs/reference.md",
        "sensitivity": "use study LOG.mcap",
        "study --cutoffs": "use study LOG.mcap, which varies the cut-off",
        "study --starts": "use study LOG.mcap, which varies the start",
        "study --low-speed-percent": "state low_speed_percent in [identification]",
        "study --encoder-step": "use --position-noise",
        "study --rrd": "use --report FILE.html",
        "--all-samples": 'use span = "all" under [identification] of robot.toml',
        **{
            name: f"use {key} under [identification] of robot.toml"
            for key, names in {
                "cutoff_hz": ["fleet --cutoff-hz"],
                "decimation": ["--decimate"],
                "low_speed_percent": [
                    f"{command} --low-speed-percent" for command in ("fit", "friction", "fleet")
                ],
                "max_iterations": ["--max-iterations"],
                "tolerance_percent": ["--tolerance-percent"],
                "torque_lag_s": ["fleet --torque-lag-s", "view --torque-lag-s"],
            }.items()
            for name in names
        },
        "--cluster": "use --workers tcp://HOST:8786",
        "compare --rrd": "use --report FILE.html, which has the charts",
        "demo --noise": "use simulate --effort-noise-percent",
        "friction --rrd": "use --report FILE.html, which has the charts",
        **dict.fromkeys(
            ["fleet --rrd", "fleet --report"], "use the table of -o OUT.csv, which marks changes"
        ),
    },
)
main = PROGRAM.main
