"""`robot-identify`: one file per command, listed here in the order of the help."""

from acquisition.commands import Program

PROGRAM = Program(
    name="robot-identify",
    description="Identify the dynamic parameters of a robot from recordings.",
    package=__package__,
    commands={
        "fit": "identify base parameters from one or more recordings",
        "friction": "select friction terms by cross-validation",
        "fleet": "fit every recording in folders, and tabulate the parameters that changed",
        "view": "draw a recording, or a fit that was stored",
        "compare": "compare the parameters of two fits",
        "validate": "report the torque error of a fit on recordings that it was not fitted to",
        "init": "write a robot.toml from a URDF, and mark missing values",
        "export": "export a fit as URDF, MuJoCo model or robot.toml",
        "base": "print the base parameters and their expressions",
        "excite": "design an exciting trajectory within the robot's limits",
        "simulate": "simulate a recording of a robot with known parameters",
        "study": "compare LS and IV on simulated recordings, or on variations of one recording",
        "demo": "record simulated drives, fit, and compare with the true values",
    },
    # what older versions had, and what to use instead
    gone={
        "schema": "all keys of robot.toml are in identification/docs/reference.md",
        "sensitivity": "use study LOG.mcap",
        "study --cutoffs": "use study LOG.mcap, which varies the cut-off",
        "study --starts": "use study LOG.mcap, which varies the start",
        "study --low-speed-percent": "set low_speed_percent under [identification] of robot.toml",
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
        "demo --noise": "use simulate --effort-noise-percent",
        "friction --rrd": "use --report FILE.html, which has the charts",
        **dict.fromkeys(
            ["fleet --rrd", "fleet --report"], "use the table of -o OUT.csv, which marks changes"
        ),
    },
)
main = PROGRAM.main
