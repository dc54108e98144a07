"""`robot-acquire`: recordings of drives and out of tables, what they hold, decoding, recovery, simulated drives.

Parse, one library call, print. Libraries are imported by the commands that use them, so that `--help` answers at once.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import AcquisitionError, one_line
from .command_line import STATUSES, run_command

if TYPE_CHECKING:
    from ..importing import Converted
    from ..robot import Robot
    from ..session import Ending, Stop, Told


Line = Callable[[], AbstractContextManager[None]]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status, as `command_line.STATUSES` says."""

    def command() -> int | None:
        arguments = _parser().parse_args(argv)
        status: int | None = arguments.run(arguments)
        return status

    return run_command("robot-acquire", (AcquisitionError,), command)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="robot-acquire", description="Recordings of robots and their drives.", epilog=STATUSES
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("check", help="who answers on the bus, and whether it is as described")
    command.add_argument("robot", type=Path, metavar="ROBOT.toml")
    command.set_defaults(run=_check)

    command = commands.add_parser("record", help="record drives; nothing moves without --track")
    command.add_argument("robot", type=Path, metavar="ROBOT.toml")
    command.add_argument("-o", "--output", required=True, type=Path, metavar="LOG.mcap", help="the recording to write")
    command.add_argument("--passive", action="store_true", help="another master owns the bus: send nothing, ever")
    command.add_argument("--duration", type=float, metavar="S", help="seconds; without it until Ctrl-C")
    command.add_argument(
        "--track", type=Path, metavar="REFERENCE.csv", help="MOVES THE ROBOT along time_s and each joint's rad or m"
    )
    command.add_argument(
        "--speed", type=float, default=1.0, metavar="X", help="--track slower: more than 0 to 1, the default"
    )
    command.add_argument(
        "--yes", action="store_true", help="--track without asking whether the joint positions are right"
    )
    command.add_argument("--dry-run", action="store_true", help="all of it on simulated drives, without any bus")
    command.set_defaults(run=_record)

    command = commands.add_parser("disable", help="stop and disable all drives, whoever enabled them; never refused")
    command.add_argument("robot", type=Path, metavar="ROBOT.toml")
    command.set_defaults(run=_disable)

    command = commands.add_parser("simulate", help="simulated drives on the bus of a description, for anyone's master")
    command.add_argument("robot", type=Path, metavar="ROBOT.toml")
    command.add_argument("--replay", type=Path, metavar="LOG.mcap", help="drives that replay a recording's samples")
    command.add_argument(
        "--unsupervised", action="store_true", help="drives that notice neither a lost SYNC nor a lost master"
    )
    command.add_argument("--duration", type=float, metavar="S", help="seconds; without it until Ctrl-C")
    command.set_defaults(run=_simulate)

    command = commands.add_parser(
        "import", help="tables (CSV, MAT) or CAN logs (candump, ASC, BLF, TRC) into a recording"
    )
    command.add_argument(
        "tables", nargs="+", type=Path, metavar="FILE", help="CSV or MAT files, as the map counts them; or one CAN log"
    )
    command.add_argument("--robot", required=True, type=Path, metavar="ROBOT.toml", help="the robot's description")
    command.add_argument(
        "--map", type=Path, metavar="MAP.toml", help="which column is what: for tables, none for CAN logs"
    )
    command.add_argument("-o", "--output", required=True, type=Path, metavar="LOG.mcap", help="the recording to write")
    command.set_defaults(run=_import)

    command = commands.add_parser("info", help="what a recording holds")
    command.add_argument("recording", type=Path, metavar="LOG.mcap")
    command.add_argument("--json", action="store_true", help="as JSON, for programs")
    command.set_defaults(run=_info)

    command = commands.add_parser("decode", help="a recording's CAN frames into joint samples again")
    command.add_argument("recording", type=Path, metavar="LOG.mcap")
    command.add_argument("--robot", type=Path, metavar="CORRECTED.toml", help="in place of the description inside")
    command.add_argument("-o", "--output", required=True, type=Path, metavar="OUT.mcap", help="the recording to write")
    command.set_defaults(run=_decode)

    command = commands.add_parser("export", help="joint samples as CSV")
    command.add_argument("recording", type=Path, metavar="LOG.mcap")
    command.add_argument("-o", "--output", required=True, type=Path, metavar="OUT.csv", help="the table to write")
    command.set_defaults(run=_export)

    command = commands.add_parser("replay", help="what a recording's drives sent, and SYNC, on a silent bus")
    command.add_argument("recording", type=Path, metavar="LOG.mcap")
    command.add_argument("--interface", required=True, help="python-can's name: socketcan, udp_multicast, ...")
    command.add_argument("--channel", required=True, help="can0, or a multicast group")
    command.add_argument("--speed", type=float, default=1.0, metavar="X", help="times as fast; default 1")
    command.add_argument("--onto-bus", action="store_true", help="also where hardware may be on the bus")
    command.set_defaults(run=_replay)

    command = commands.add_parser("recover", help="a whole recording from one that was cut")
    command.add_argument("recording", type=Path, metavar="CUT.mcap")
    command.add_argument("-o", "--output", required=True, type=Path, metavar="OUT.mcap", help="the recording to write")
    command.set_defaults(run=_recover)
    return parser


def _check(arguments: argparse.Namespace) -> None:
    from ..robot import load_robot, resolve
    from .checking import check

    robot = load_robot(arguments.robot)
    findings = check(robot, resolve(robot, str(arguments.robot)))
    for finding in findings:
        print(one_line(f"{'ok' if finding.ok else 'NO'}: {finding.subject}: {finding.found}"))
    against = [finding.subject for finding in findings if not finding.ok]
    if against:
        raise AcquisitionError(f"no go: {', '.join(dict.fromkeys(against))}")
    print("go")


def _record(arguments: argparse.Namespace) -> int:
    from ..robot import load_robot
    from ..session import Stop, Wanted, record, stop_on_signals

    if arguments.duration is not None and not 0 < arguments.duration < float("inf"):
        raise AcquisitionError(f"--duration {arguments.duration:g}: expected more than 0, and an end")
    robot = load_robot(arguments.robot)
    if robot.bus is None:
        raise AcquisitionError(
            f"{arguments.robot}: bus is not there: expected a [bus] section with one drive per motor"
        )
    moves = arguments.track is not None and not arguments.dry_run
    if moves and not arguments.yes and not sys.stdin.isatty():
        raise AcquisitionError("--track: nobody is here to confirm the joint positions: expected a terminal, or --yes")
    stop = Stop()
    with stop_on_signals(stop), _live_line(robot) as (told, line):
        wanted = Wanted(
            passive=arguments.passive,
            dry_run=arguments.dry_run,
            duration_s=arguments.duration,
            track=arguments.track,
            speed=arguments.speed,
            confirm=lambda words: arguments.yes or _agreed(words, stop, line),
        )
        ending, recorded = record(robot, str(arguments.robot), arguments.output, wanted, told, stop, _announce)
    if ending.fault:  # the reason comes before what was recorded
        reason = "; ".join((ending.reason, *ending.reports))
        print(one_line(f"robot-acquire: {arguments.output}: ended by a fault: {reason}"), file=sys.stderr, flush=True)
    for text in () if ending.fault else recorded.warnings:
        print(one_line(f"warning: {text}"), file=sys.stderr)
    held = f"{recorded.samples} samples, {recorded.frames} CAN frames"
    print(one_line(f"{arguments.output}: {robot.name}, {held}; {ending.reason}"))
    if ending.fault:
        return 1
    if ending.alarm:
        raise AcquisitionError(f"{arguments.output}: {ending.alarm}")
    if recorded.no_samples:
        raise AcquisitionError(f"no samples, the frames are kept: {recorded.no_samples}")
    return 0


def _announce(ending: "Ending") -> None:
    """Say at once which drives may still be enabled: before the recording is closed, and before all else."""
    if ending.alarm:
        print(one_line(ending.alarm), file=sys.stderr, flush=True)


def _agreed(words: list[str], stop: "Stop", line: "Line") -> bool:
    """Show joint positions, and wait until somebody says yes or something else; a stop asked for is no."""
    import select

    with line():
        for text in words:
            print(one_line(text), file=sys.stderr)
        print("Does the robot stand like that, and may it move? yes or no: ", end="", file=sys.stderr, flush=True)
        while not stop.reason:
            if select.select([sys.stdin], [], [], 0.1)[0]:
                return sys.stdin.readline().strip().lower() in ("yes", "y")
        print(file=sys.stderr)
    return False


def _disable(arguments: argparse.Namespace) -> int:
    from ..master import not_disabled
    from ..robot import load_robot
    from .disabling import disable

    robot = load_robot(arguments.robot)
    nodes = [drive.node for drive in robot.bus.drive] if robot.bus is not None else []
    try:
        unconfirmed = disable(robot, str(arguments.robot))
    except AcquisitionError:
        print(not_disabled(nodes), file=sys.stderr)
        raise
    if unconfirmed:
        print(not_disabled(unconfirmed), file=sys.stderr)
        return 1
    print(f"disabled: nodes {', '.join(map(str, nodes))}; all in pre-operational")
    return 0


def _simulate(arguments: argparse.Namespace) -> None:
    import time

    from ..recording import read_recording
    from ..robot import load_robot, resolve
    from ..session import Stop, stop_on_signals
    from ..simulated import Mechanism, TablePlant, mechanism_of, rated_motor_effort, serve, typical_loops

    robot = load_robot(arguments.robot)
    bus = resolve(robot, str(arguments.robot))
    if arguments.replay is None:
        mechanism = mechanism_of(robot, bus)
    else:
        recording = read_recording(arguments.replay)
        if recording.samples is None:
            raise AcquisitionError(f"{arguments.replay}: holds no joint samples: expected some to replay")
        plant = TablePlant(recording.samples, recording.sample_rate_hz)
        mechanism = Mechanism(plant=plant, loops=typical_loops(robot, rated_motor_effort(bus)))
    stop, end_s = Stop(), time.monotonic() + (arguments.duration if arguments.duration is not None else float("inf"))
    nodes = ", ".join(str(drive.node) for drive in bus.drives)
    told = f"simulated drives, nodes {nodes}, on {bus.file.interface} {bus.file.channel}"
    told += f"; {mechanism.warning}" if mechanism.warning else ""
    with stop_on_signals(stop):
        serve(
            robot,
            bus,
            lambda: bool(stop.reason) or time.monotonic() > end_s,
            mechanism,
            ready=lambda: print(told, file=sys.stderr, flush=True),
            supervised=not arguments.unsupervised,
        )


def _import(arguments: argparse.Namespace) -> None:
    if arguments.map is None:
        _import_log(arguments)
        return
    with _working("importing"):
        from ..files import refuse_input
        from ..importing import import_tables
        from ..robot import load_robot

        refuse_input(arguments.output, [arguments.robot, arguments.map, *arguments.tables])
        result = import_tables(arguments.tables, load_robot(arguments.robot), arguments.map, arguments.output)
    units = ", ".join(dict.fromkeys(result.effort_units))
    reference = ", with reference" if result.has_reference else ""
    rate = f"{result.samples} samples at {result.sample_rate_hz:g} Hz"
    print(one_line(f"{result.out}: {result.robot}, {rate}, effort in {units}{reference}"))
    for text in result.warnings:
        print(one_line(f"warning: {text}"))


def _import_log(arguments: argparse.Namespace) -> None:
    with _working("importing"):
        from ..files import refuse_input
        from ..importing import import_log, is_log
        from ..robot import load_robot

        tables = [path for path in arguments.tables if not is_log(path)]
        if tables:
            expected = "expected MAP.toml, which says what its columns are; CAN logs end in .log, .asc, .blf or .trc"
            raise AcquisitionError(f"{tables[0]}: a table, and --map is not there: {expected}")
        if len(arguments.tables) > 1:
            raise AcquisitionError(f"{arguments.tables[1]}: a second CAN log: expected one")
        refuse_input(arguments.output, [arguments.robot, *arguments.tables])
        found = import_log(arguments.tables[0], arguments.output, load_robot(arguments.robot), str(arguments.robot))
    _tell_converted(arguments.output, found)


def _decode(arguments: argparse.Namespace) -> None:
    with _working("decoding"):
        from ..files import refuse_input
        from ..importing import decode_recording
        from ..robot import load_robot

        refuse_input(arguments.output, [arguments.recording, *([arguments.robot] if arguments.robot else [])])
        robot = None if arguments.robot is None else load_robot(arguments.robot)
        place = str(arguments.robot or f"{arguments.recording}: robot.toml")
        found = decode_recording(arguments.recording, arguments.output, robot, place)
    _tell_converted(arguments.output, found)


def _tell_converted(out: Path, found: "Converted") -> None:
    for text in found.warnings:
        print(one_line(f"warning: {text}"), file=sys.stderr)
    reference = ", with reference" if found.has_reference else ""
    print(one_line(f"{out}: {found.robot}, {found.samples} samples at {found.sample_rate_hz:g} Hz{reference}"))


def _export(arguments: argparse.Namespace) -> None:
    with _working("exporting"):
        from ..files import refuse_input
        from ..importing import export_csv

        refuse_input(arguments.output, [arguments.recording])
        rows = export_csv(arguments.recording, arguments.output)
    print(one_line(f"{arguments.output}: {rows} rows"))


def _replay(arguments: argparse.Namespace) -> None:
    from ..robot import BusFile
    from ..session import Stop, replay, stop_on_signals

    stop = Stop()
    file = BusFile(interface=arguments.interface, channel=arguments.channel, drive=(), sync_period_s=1.0)
    with stop_on_signals(stop):
        count = replay(arguments.recording, file, stop, speed=arguments.speed, onto_bus=arguments.onto_bus)
    print(one_line(f"{count} frames sent on {arguments.interface} {arguments.channel}"))


def _info(arguments: argparse.Namespace) -> None:
    with _working("reading"):
        from ..recording import as_tables, overview, read_recording

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
        from ..files import refuse_input
        from ..recording import recover

        refuse_input(arguments.output, [arguments.recording])
        found = recover(arguments.recording, arguments.output)
    samples = 0 if found.samples is None else len(found.samples)
    frames = sum(len(block) for block in found.frames.values())
    held = f"{samples} samples, {frames} CAN frames, {len(found.events)} events"
    print(one_line(f"{arguments.output}: {found.robot.name}, {held}"))


@contextmanager
def _live_line(robot: "Robot") -> Iterator[tuple["Told", "Line"]]:
    """Show on a terminal how a session goes; the line is told anew twice a second. The second clears it for a while."""
    if not sys.stderr.isatty():
        yield lambda status, left_s: None, nullcontext
        return
    from rich.console import Console

    from .live import live_line

    with Console(stderr=True).status("starting") as shown:

        @contextmanager
        def cleared() -> Iterator[None]:
            shown.stop()
            try:
                yield
            finally:
                shown.start()

        yield lambda status, left_s: shown.update(live_line(robot, status, left_s)), cleared


@contextmanager
def _working(what: str) -> Iterator[None]:
    """Show on a terminal that work is going on."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(what):
        yield
