"""`robot-acquire record`: a session with the drives of a description; nothing
moves without `--track`.
"""

import argparse
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import COMMAND_LINE, BusFaultError, Location, one_line
from ..options import RecordOptions
from .command_line import add_flag, add_options, add_path, from_options
from .terminal import STDIN, Notes, StatusLine

if TYPE_CHECKING:
    from ..robot import Robot
    from ..session import Outcome, RecordedSummary, Status, Stop


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    add_path(inputs, "robot", "ROBOT.toml", "description of robot and drives")
    add_options(inputs, RecordOptions, "track")
    session = parser.add_argument_group("session")
    add_options(session, RecordOptions, "payload", "passive", "dry_run", "duration_s", "speed")
    add_flag(session, "--yes", "start --track without asking whether the joint positions are right")
    add_options(session, RecordOptions, "reset_faults", "unsupervised_drives")
    add_path(
        parser.add_argument_group("outputs"),
        "-o --output",
        "LOG.mcap",
        "the recording to write",
        required=True,
    )


def run(options: argparse.Namespace) -> int:
    """Record, show the status, and print what was recorded; 1 when the
    session ended with a fault.
    """
    from ..robot import load_robot, parse_payload
    from ..session import Stop, UserInterface, record, stop_on_signals

    _check_options(options)
    robot = load_robot(options.robot)
    if options.payload is not None:
        payload = parse_payload(options.payload, robot).describe(robot.joints[-1].name)
        print(
            f"payload {payload}: no limit of robot.toml counts it; is it within the rated payload?",
            file=sys.stderr,
        )
    stop, line = Stop(), StatusLine()
    notes = Notes(line)

    def confirm(words: list[str], faults: list[str]) -> bool:
        if options.yes and not faults:
            return True
        return os.isatty(STDIN) and _ask(words + faults, stop, line)

    def announce(outcome: "Outcome") -> None:
        """Name the drives that may still be enabled, before the recording is closed."""
        line.show()
        if outcome.alarm:
            _tell(outcome.alarm)

    def show(status: "Status", left_s: float | None) -> None:
        if not notes.typing:
            line.show(*live_line(robot, status, left_s))

    if sys.stderr.isatty():
        print(
            f"watch it in a second terminal: robot-identify view {options.output} --follow",
            file=sys.stderr,
        )
        if os.isatty(STDIN):
            print("to note something: m, the text, Enter", file=sys.stderr)
    line.show(("starting", False))
    interface = UserInterface(
        stop=stop,
        confirm=confirm,
        show=show,
        announce=announce,
        note=_tell,
        notes=notes.take,
    )
    try:
        with stop_on_signals(stop):
            outcome, recorded = record(
                robot,
                str(options.robot),
                options.output,
                from_options(RecordOptions, options),
                interface,
            )
    finally:
        notes.close()
        line.show()
    return _report(options.output, robot, outcome, recorded)


def _check_options(options: argparse.Namespace) -> None:
    COMMAND_LINE.require(
        options.duration_s is None or 0 < options.duration_s < float("inf"),
        "--duration",
        options.duration_s,
        "more than 0, and finite",
    )
    Location("--track").require(
        options.track is None or options.dry_run or options.yes or os.isatty(STDIN),
        text="nobody can confirm the joint positions",
        expected="a terminal, or --yes",
    )


def _tell(text: str) -> None:
    """Print one line on standard error at once."""
    print(one_line(text), file=sys.stderr, flush=True)


def _report(out: Path, robot: "Robot", outcome: "Outcome", recorded: "RecordedSummary") -> int:
    from ..session import INTERRUPTED

    if outcome.fault:  # the reason is printed before what was recorded
        reasons = "; ".join((outcome.reason, *outcome.reports))
        _tell(f"robot-acquire: {out}: ended by a fault: {reasons}")
    for text in () if outcome.fault else recorded.warnings:
        _tell(f"warning: {text}")
    text = f"{out}: {robot.name}, {recorded.samples} samples, {recorded.frames} CAN frames"
    print(one_line(f"{text}; {outcome.reason}"))
    Location(str(out)).require(
        recorded.path is None or recorded.path.absolute() == out.absolute(),
        text=f"was deleted: the recording is in {recorded.path}",
    )
    if outcome.fault:
        return 1
    if outcome.alarm:
        raise BusFaultError(outcome.alarm, place=str(out))
    if outcome.cut_short and outcome.reason != INTERRUPTED:
        raise BusFaultError(f"the session was cut short: {outcome.reason}", place=str(out))
    left = (
        "nothing was recorded, and no file is left"
        if recorded.path is None
        else "no samples, but the frames are in the recording"
    )
    Location("").require(not recorded.no_samples, text=f"{left}: {recorded.no_samples}")
    return 0


def _ask(words: list[str], stop: "Stop", line: "StatusLine") -> bool:
    """Show joint positions and drives in fault, and ask for confirmation; a stop means no."""
    import select
    import termios

    line.show()
    for text in words:
        _tell(text)
    with suppress(termios.error):  # what was typed before the question does not answer it
        termios.tcflush(STDIN, termios.TCIFLUSH)
    print(
        "Are these joint positions right, and may the robot move? yes or no: ",
        end="",
        file=sys.stderr,
        flush=True,
    )
    while not stop.reason:
        if select.select([STDIN], [], [], 0.1)[0]:
            return os.read(STDIN, 4096).strip().lower() in (b"yes", b"y")
    print(file=sys.stderr)
    return False


def live_line(robot: "Robot", status: "Status", left_s: float | None) -> list[tuple[str, bool]]:
    """Rate, losses (true if there are any), range of each joint so far, time left."""
    losses = {"dropped": status.drops, **{k: status.losses[k] for k in ("missing", "late")}}
    ranges = zip(robot.joints, status.lowest, status.highest, strict=False)
    return [
        (f"{status.rate_hz:.0f} frames/s", False),
        *((f", {count} {name}", bool(count)) for name, count in losses.items()),
        *(
            (f", {j.name} {low:.3f}..{high:.3f} {j.position_unit}", False)
            for j, low, high in ranges
        ),
        *([] if left_s is None else [(f", {left_s:.0f} s left", False)]),
    ]
