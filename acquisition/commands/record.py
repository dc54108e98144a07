"""`robot-acquire record`: record the drives of a description. The robot moves only with `--track`.

The SYNC loop writes the status line of the terminal, and reads the notes that the operator types or
pipes in, after the drives have answered. It never waits for either. A thread would hold the lock of
Python when SYNC is due.
"""

import argparse
import os
import select
import subprocess
import sys
import termios
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import COMMAND_LINE, BusFaultError, Location, one_line
from ..options import RecordOptions
from .command_line import add_flag, add_options, add_path, from_options

if TYPE_CHECKING:
    from ..robot import Robot
    from ..session import Outcome, RecordedSummary, Status, Stop


# The descriptor is used, because `sys.stdin` is None if it is closed, and reads ahead.
STDIN = 0
# The rest of a longer line becomes the next note.
MAX_NOTE_BYTES = 1000


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    add_path(inputs, "robot", "ROBOT.toml", "description of the robot and its drives")
    add_options(inputs, RecordOptions, "track")
    session = parser.add_argument_group("session")
    add_options(session, RecordOptions, "payload", "passive", "dry_run", "duration_s", "speed")
    add_flag(session, "--yes", "start --track without asking to confirm the joint positions")
    add_options(session, RecordOptions, "reset_faults", "unsupervised_drives")
    add_flag(session, "--no-fit", "do not fit the recording of --track afterwards")
    add_path(
        parser.add_argument_group("outputs"),
        "-o --output",
        "LOG.mcap",
        "recording to write",
        required=True,
    )


def run(options: argparse.Namespace) -> int:
    """Record, show the status, and print a summary; return 1 if the session ended with a fault."""
    from ..robot import load_robot, parse_payload
    from ..session import Stop, UserInterface, record, stop_on_signals

    _check_options(options)
    robot = load_robot(options.robot)
    if options.payload is not None:
        payload = parse_payload(options.payload, robot).describe(robot.joints[-1].name)
        print(
            f"payload {payload}: the limits of robot.toml ignore it. Check the rated payload.",
            file=sys.stderr,
        )
    stop, line = Stop(), StatusLine()
    notes = Notes(line)

    def confirm(words: list[str], faults: list[str]) -> bool:
        return (options.yes and not faults) or (
            os.isatty(STDIN) and _ask(words + faults, stop, line)
        )

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
            "To watch the session in a second terminal: "
            f"robot-identify view {options.output} --follow",
            file=sys.stderr,
        )
        if os.isatty(STDIN):
            print("To add a note: press m, type the text, press Enter", file=sys.stderr)
    line.show(("starting", False))
    try:
        with stop_on_signals(stop):
            outcome, recorded = record(
                robot,
                str(options.robot),
                options.output,
                from_options(RecordOptions, options),
                UserInterface(
                    stop=stop,
                    confirm=confirm,
                    show=show,
                    announce=announce,
                    note=_tell,
                    notes=notes.take,
                ),
            )
    finally:
        notes.close()
        line.show()
    _report(options.output, robot, outcome, recorded)
    if (
        options.track is not None
        and not (outcome.fault or outcome.cut_short or options.no_fit)
        and find_spec("identification")
    ):
        _fit(options.output, options.robot)
    return int(outcome.fault)


def _check_options(options: argparse.Namespace) -> None:
    COMMAND_LINE.require(
        options.duration_s is None or 0 < options.duration_s < float("inf"),
        "--duration",
        options.duration_s,
        "a finite number greater than 0",
    )
    Location("--track").require(
        options.track is None or options.dry_run or options.yes or os.isatty(STDIN),
        text="without a terminal, the joint positions cannot be confirmed",
        advice="Run the command in a terminal, or pass --yes",
    )


def _tell(text: str) -> None:
    """Print one line on standard error at once."""
    print(one_line(text), file=sys.stderr, flush=True)


def _report(out: Path, robot: "Robot", outcome: "Outcome", recorded: "RecordedSummary") -> None:
    """Print how the session ended; raise an error if it was not as asked, without a fault."""
    from ..session import INTERRUPTED

    # The reason is printed before the summary of the recording.
    if outcome.fault:
        _tell(
            f"robot-acquire: {out}: the session ended with a fault: "
            f"{'; '.join((outcome.reason, *outcome.reports))}"
        )
    for text in () if outcome.fault else recorded.warnings:
        _tell(f"warning: {text}")
    print(
        one_line(
            f"{out}: {robot.name}, {recorded.samples} samples, {recorded.frames} CAN frames; "
            f"{outcome.reason}"
        )
    )
    Location(str(out)).require(
        recorded.path is None or recorded.path.absolute() == out.absolute(),
        text=f"the file was deleted during the session; the recording is now in {recorded.path}",
    )
    if outcome.fault:
        return
    if outcome.alarm:
        raise BusFaultError(outcome.alarm, place=str(out))
    if outcome.cut_short and outcome.reason != INTERRUPTED:
        raise BusFaultError(f"the session ended early: {outcome.reason}", place=str(out))
    left = (
        "nothing was recorded, so no file was kept"
        if recorded.path is None
        else "the recording contains frames, but no samples"
    )
    Location("").require(not recorded.no_samples, text=f"{left}: {recorded.no_samples}")


def _fit(recording: Path, robot: Path) -> None:
    """Show what the recording determines: by least squares, in a process of its own.

    Every drive is disabled and the file is closed before. Signals end the fit alone. It cannot
    change the exit status.
    """
    from ..session import Stop, stop_on_signals

    print(f"Least-squares fit of {recording} (--no-fit leaves it out):", flush=True)
    with stop_on_signals(Stop()), suppress(OSError, subprocess.TimeoutExpired):
        done = subprocess.run(
            [
                *(sys.executable, "-P", "-m", "identification"),
                *("fit", recording, "--robot", robot, "--method", "wls", "--brief"),
            ],
            stdin=subprocess.DEVNULL,
            timeout=60,
            check=False,
            preexec_fn=lambda: os.nice(10),
        )
        # The status is negative after a signal. Otherwise a result or an error is printed.
        if done.returncode >= 0:
            return
    _tell(f"The fit has ended without a result. To repeat it: robot-identify fit {recording}")


def _ask(words: list[str], stop: "Stop", line: "StatusLine") -> bool:
    """Show joint positions and faults, and ask for confirmation. A stop means no."""
    line.show()
    for text in words:
        _tell(text)
    # Text that was typed before the question must not answer it.
    with suppress(termios.error):
        termios.tcflush(STDIN, termios.TCIFLUSH)
    print(
        "Are these joint positions correct, and may the robot move? (yes or no) ",
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
    """Return rate, losses, range of each joint so far, and time left.

    The flag of a part is True if it is a loss that is not 0.
    """
    losses = {"dropped": status.drops, **{k: status.losses[k] for k in ("missing", "late")}}
    return [
        (f"{status.rate_hz:.0f} frames/s", False),
        *((f", {count} {name}", bool(count)) for name, count in losses.items()),
        *(
            (f", {j.name} {low:.3f}..{high:.3f} {j.position_unit}", False)
            for j, low, high in zip(robot.joints, status.lowest, status.highest, strict=False)
        ),
        *([] if left_s is None else [(f", {left_s:.0f} s left", False)]),
    ]


class StatusLine:
    """The status line of a session, if there is a terminal.

    It does not wait for a stopped terminal (Ctrl-S).
    """

    def __init__(self) -> None:
        self._rows, self._terminal = 0, -1
        if sys.stderr.isatty():
            # The terminal is opened again, because other processes share standard error and expect
            # it to block.
            with suppress(OSError):
                self._terminal = os.open(
                    os.ttyname(sys.stderr.fileno()), os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY
                )

    def show(self, *parts: tuple[str, bool]) -> None:
        """Replace the line by `parts`, bold and red if the flag is True. Without parts, remove it.

        It never raises, because a terminal that is closed must not end the session.
        """
        if self._terminal >= 0 and (parts or self._rows):
            text = "".join(f"\x1b[1;31m{part}\x1b[0m" if bad else part for part, bad in parts)
            above = f"\x1b[{self._rows - 1}A" if self._rows > 1 else ""
            # The terminal may be full or closed, or a name may have surrogates.
            with suppress(OSError, ValueError):
                os.write(self._terminal, f"\r{above}\x1b[J{text}".encode())
                width = os.get_terminal_size(self._terminal).columns or 80
                self._rows = -(-sum(len(part) for part, _ in parts) // width)


class Notes:
    """Notes of the operator: lines of standard input; in a terminal, from the key `m` to Enter.

    The terminal stays in its line mode, in which the system edits the line and Ctrl-C works. Until
    the key is pressed, `m` ends a line as Enter does, so that it can be read at once.

    Attributes:
        typing: True from the key to Enter.
    """

    def __init__(self, line: StatusLine) -> None:
        self._line, self._is_terminal = line, os.isatty(STDIN)
        self._read = b""  # bytes that are not returned yet
        self._modes: list[Any] = []  # modes of the terminal before
        self.typing = False

    def take(self) -> list[str]:
        """Return the next note if there is one. It never waits or raises."""
        line = b""
        # Standard input or the terminal may be closed.
        with suppress(OSError, termios.error):
            if not self._is_terminal or self._in_foreground():
                line = self._next_line()
        text = one_line(line.decode(errors="replace"))
        return [text] if text else []

    def close(self) -> None:
        """Restore the modes of the terminal, and drop the text typed since the last Enter."""
        with suppress(OSError, termios.error):
            if self._modes and self._in_foreground():
                termios.tcflush(STDIN, termios.TCIFLUSH)
                termios.tcsetattr(STDIN, termios.TCSANOW, self._modes)

    def _in_foreground(self) -> bool:
        """Test whether this process may use its terminal.

        In the background the system would halt it.
        """
        return os.tcgetpgrp(STDIN) == os.getpgrp()

    def _await_key(self, awaited: bool) -> None:
        """Let `m` end a line, or only Enter again."""
        self._modes = self._modes or termios.tcgetattr(STDIN)
        modes = [*self._modes[:6], list(self._modes[6])]
        if awaited:
            modes[6][termios.VEOL] = b"m"
        termios.tcsetattr(STDIN, termios.TCSANOW, modes)
        self.typing = not awaited

    def _next_line(self) -> bytes:
        if self._is_terminal and not self._modes:
            self._await_key(True)
        ended = False
        if b"\n" not in self._read and select.select([STDIN], [], [], 0)[0]:
            read = os.read(STDIN, MAX_NOTE_BYTES - len(self._read))
            # A terminal continues after Ctrl-D, but a pipe has ended.
            ended = not read and not self._is_terminal
            self._read += read
        if self._is_terminal and not self.typing:
            _, key, self._read = self._read.partition(b"m")
            if not key:
                return b""
            self._await_key(False)
            self._line.show(("note: ", False))
        text, end, rest = self._read.partition(b"\n")
        if not (end or ended or len(text) == MAX_NOTE_BYTES):
            return b""
        self._read = rest
        if self._is_terminal:
            # The text of the note stays above the next status line.
            self._line.show()
            self._await_key(True)
        return text
