"""`robot-acquire`: its commands, in the order of the help. Each command has a file."""

from .command_line import Program

PROGRAM = Program(
    name="robot-acquire",
    description="Record robots with CANopen drives, and import recordings.",
    package=__package__,
    commands={
        "scan": "find the drives of an unknown bus by listening and reading only",
        "check": "check whether the drives answer and match robot.toml (go/no-go)",
        "record": "record the drives; the robot moves only with --track",
        "disable": "stop and disable all drives, including those enabled by another program",
        "emulate": "run simulated drives for any CANopen master, or replay recorded ones",
        "import": "convert tables, bags, logs or recorded frames to a recording",
        "info": "show what a recording contains, and export it as CSV",
    },
    gone={
        "decode": "use import LOG.mcap -o OUT.mcap",
        "recover": "use import CUT.mcap -o OUT.mcap",
        "simulate": "use emulate",
        "mark": "press the key m in robot-acquire record, or pipe a line into it",
        "export": "use info LOG.mcap --csv OUT.csv",
        "replay": "use emulate LOG.mcap --interface NAME --channel NAME",
    },
)
main = PROGRAM.main
