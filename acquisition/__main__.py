"""`robot-acquire`: tables into recordings, what a recording holds, recovery of a cut one.

Parse, one library call, print. Libraries are imported by the commands that use them, so that `--help` answers at once.
"""

import argparse
import io
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from . import AcquisitionError, one_line


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line. Exit status: 0, 1 after an error told in one line, 2 for wrong usage, 130 on Ctrl-C."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Unicode shows ? where it has no sign
    arguments = _parser().parse_args(argv)
    try:
        arguments.run(arguments)
        sys.stdout.flush()
    except AcquisitionError as error:
        print(f"robot-acquire: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("robot-acquire: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of the output went away; Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        print(f"robot-acquire: standard output: cannot be written: {error.strerror}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="robot-acquire", description="Recordings of robots and their drives.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("import", help="tables recorded elsewhere (CSV, MAT) into a recording")
    command.add_argument(
        "tables", nargs="+", type=Path, metavar="TABLE", help="CSV or MAT files, as the map counts them"
    )
    command.add_argument("--robot", required=True, type=Path, metavar="ROBOT.toml", help="the robot's description")
    command.add_argument("--map", required=True, type=Path, metavar="MAP.toml", help="which column is what")
    command.add_argument("-o", "--output", required=True, type=Path, metavar="LOG.mcap", help="the recording to write")
    command.set_defaults(run=_import)

    command = commands.add_parser("info", help="what a recording holds")
    command.add_argument("recording", type=Path, metavar="LOG.mcap")
    command.add_argument("--json", action="store_true", help="as JSON, for programs")
    command.set_defaults(run=_info)

    command = commands.add_parser("recover", help="a whole recording from one that was cut")
    command.add_argument("recording", type=Path, metavar="CUT.mcap")
    command.add_argument("-o", "--output", required=True, type=Path, metavar="OUT.mcap", help="the recording to write")
    command.set_defaults(run=_recover)
    return parser


def _import(arguments: argparse.Namespace) -> None:
    with _working("importing"):
        from .robot import load_robot
        from .tables import import_tables
        from .whole_file import refuse_input

        refuse_input(arguments.output, [arguments.robot, arguments.map, *arguments.tables])
        result = import_tables(arguments.tables, load_robot(arguments.robot), arguments.map, arguments.output)
    units = ", ".join(dict.fromkeys(result.effort_units))
    reference = ", with reference" if result.has_reference else ""
    rate = f"{result.samples} samples at {result.sample_rate_hz:g} Hz"
    print(one_line(f"{result.out}: {result.robot}, {rate}, effort in {units}{reference}"))


def _info(arguments: argparse.Namespace) -> None:
    with _working("reading"):
        from .overview import as_tables, overview
        from .recording import read_recording

        found = overview(read_recording(arguments.recording))
    if arguments.json:
        import msgspec

        print(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
    else:
        from rich.console import Console

        # A pipe has no width of its own: lines are not to be broken there.
        Console(width=None if sys.stdout.isatty() else 500).print(as_tables(found))


def _recover(arguments: argparse.Namespace) -> None:
    with _working("recovering"):
        from .recording import recover
        from .whole_file import refuse_input

        refuse_input(arguments.output, [arguments.recording])
        found = recover(arguments.recording, arguments.output)
    samples = 0 if found.samples is None else len(found.samples)
    frames = sum(len(block) for block in found.frames.values())
    held = f"{samples} samples, {frames} CAN frames, {len(found.events)} events"
    print(one_line(f"{arguments.output}: {found.robot.name}, {held}"))


@contextmanager
def _working(what: str) -> Iterator[None]:
    """Show on a terminal that work is going on."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(what):
        yield


if __name__ == "__main__":
    sys.exit(main())
