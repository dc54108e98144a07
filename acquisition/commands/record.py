"""`robot-acquire record`: a session with the drives of a description; nothing moves without `--track`."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import AcquisitionError, one_line
from .command_line import Commands, Progress, from_options

if TYPE_CHECKING:
    from rich.text import Text

    from ..recorder import Recorded, Status
    from ..robot import Robot
    from ..session import Outcome, ShowStatus, Stop


def add(commands: Commands) -> None:
    """Declare the command; options have the names of the fields of `RecordOptions`."""
    parser = commands.add_parser("record", help="record drives; nothing moves without --track")
    inputs = parser.add_argument_group("inputs")
    inputs.add_argument("robot", type=Path, metavar="ROBOT.toml")
    inputs.add_argument(
        "--track", type=Path, metavar="REFERENCE.csv", help="MOVES THE ROBOT along time_s and each joint's rad or m"
    )
    session = parser.add_argument_group("session")
    session.add_argument("--passive", action="store_true", help="another master owns the bus: send nothing, ever")
    session.add_argument("--dry-run", action="store_true", help="all of it on simulated drives, without any bus")
    session.add_argument(
        "--duration", dest="duration_s", type=float, metavar="S", help="seconds; without it until Ctrl-C"
    )
    session.add_argument("--speed", type=float, metavar="X", help="--track slower: more than 0 to 1, the default")
    session.add_argument(
        "--yes", action="store_true", help="--track without asking whether the joint positions are right"
    )
    outputs = parser.add_argument_group("outputs")
    outputs.add_argument("-o", "--output", required=True, type=Path, metavar="LOG.mcap", help="the recording to write")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Record, show the status, and print what was recorded; 1 when the session ended with a fault."""
    from ..robot import load_robot
    from ..session import Operator, RecordOptions, Stop, record, stop_on_signals

    if options.duration_s is not None and not 0 < options.duration_s < float("inf"):
        raise AcquisitionError(key="--duration", value=options.duration_s, expected="more than 0, and finite")
    robot = load_robot(options.robot)
    moves = options.track is not None and not options.dry_run
    if moves and not options.yes and not sys.stdin.isatty():
        text = "nobody is here to confirm the joint positions"
        raise AcquisitionError(text, place="--track", expected="a terminal, or --yes")
    stop = Stop()
    with stop_on_signals(stop), Progress("starting") as progress:

        def confirm(words: list[str]) -> bool:
            return options.yes or _agreed(words, stop, progress)

        operator = Operator(stop=stop, confirm=confirm, show=_shown_by(robot, progress), announce=_announce)
        asked = from_options(RecordOptions, options)
        outcome, recorded = record(robot, str(options.robot), options.output, asked, operator)
    return _report(options.output, robot, outcome, recorded)


def _report(out: Path, robot: "Robot", outcome: "Outcome", recorded: "Recorded") -> int:
    if outcome.fault:  # the reason is printed before what was recorded
        reason = "; ".join((outcome.reason, *outcome.reports))
        print(one_line(f"robot-acquire: {out}: ended by a fault: {reason}"), file=sys.stderr, flush=True)
    for text in () if outcome.fault else recorded.warnings:
        print(one_line(f"warning: {text}"), file=sys.stderr)
    held = f"{recorded.samples} samples, {recorded.frames} CAN frames"
    print(one_line(f"{out}: {robot.name}, {held}; {outcome.reason}"))
    if outcome.fault:
        return 1
    if outcome.alarm:
        raise AcquisitionError(outcome.alarm, place=str(out))
    if recorded.no_samples:
        raise AcquisitionError(f"no samples, but the frames are in the recording: {recorded.no_samples}")
    return 0


def _announce(outcome: "Outcome") -> None:
    """Print at once which drives may still be enabled, before the recording is closed."""
    if outcome.alarm:
        print(one_line(outcome.alarm), file=sys.stderr, flush=True)


def _agreed(words: list[str], stop: "Stop", progress: Progress) -> bool:
    """Show the joint positions and ask for confirmation; a stop in the meantime means no."""
    import select

    with progress.cleared():
        for text in words:
            print(one_line(text), file=sys.stderr)
        print("Does the robot stand like that, and may it move? yes or no: ", end="", file=sys.stderr, flush=True)
        while not stop.reason:
            if select.select([sys.stdin], [], [], 0.1)[0]:
                return sys.stdin.readline().strip().lower() in ("yes", "y")
        print(file=sys.stderr)
    return False


def _shown_by(robot: "Robot", progress: Progress) -> "ShowStatus":
    """The function that shows the status of a session: on the terminal, if there is one."""
    if not progress.shown:
        return lambda status, left_s: None
    return lambda status, left_s: progress.say(live_line(robot, status, left_s))


def live_line(robot: "Robot", status: "Status", left_s: float | None) -> "Text":
    """Rate, losses (bold where there are any), range of each joint so far, time left."""
    from rich.text import Text

    line = Text(f"{status.rate_hz:.0f} frames/s")
    for count, name in ((status.drops, "dropped"), (status.missing, "missing"), (status.late, "late")):
        line.append(f", {count} {name}", style="bold red" if count else "")
    for joint, low, high in zip(robot.joints, status.lowest, status.highest, strict=False):
        line.append(f", {joint.name} {low:.3f}..{high:.3f} {joint.position_unit}")
    if left_s is not None:
        line.append(f", {left_s:.0f} s left")
    return line
