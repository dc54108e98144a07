"""`robot-acquire`: one file per command, listed here in the order of the help."""

from .command_line import Program

PROGRAM = Program(
    name="robot-acquire",
    description="Record robots and their drives.",
    package=__package__,
    commands={
        "scan": "find the drives of an unknown bus; listens and reads only",
        "check": "go or no go: which drives answer, do they match robot.toml",
        "record": "record drives; nothing moves without --track",
        "disable": "stop and disable all drives, whoever enabled them",
        "emulate": "put simulated drives, or those of a recording, on a bus",
        "import": "make a recording from tables, bags, logs or recorded frames",
        "info": "show what a recording contains, and write it as CSV",
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
