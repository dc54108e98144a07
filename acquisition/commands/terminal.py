"""The terminal of a session: its status line, and the notes that the operator types or pipes in.

The SYNC loop writes the one and asks for the other after the drives have answered. It never waits
for either: a thread would hold Python's lock when SYNC is due.
"""

import os
import select
import sys
import termios
from contextlib import suppress
from typing import Any

from ..errors import one_line

STDIN = 0  # not `sys.stdin`, which is None if it is closed, and reads ahead
MAX_NOTE_BYTES = 1000  # of a line; the rest of a longer one is the next note


class StatusLine:
    """The status line of a session on the terminal, if there is one.

    It does not wait for a stopped terminal (Ctrl-S).
    """

    def __init__(self) -> None:
        self._rows, self._terminal = 0, -1
        if sys.stderr.isatty():
            # opened again, because other processes share standard error and expect it to block
            with suppress(OSError):
                self._terminal = os.open(
                    os.ttyname(sys.stderr.fileno()), os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY
                )

    def show(self, *parts: tuple[str, bool]) -> None:
        """Replace the line by `parts`, bold and red where the flag is true; without them remove it.

        Never raises: a terminal that is gone must not end the session that it shows.
        """
        if self._terminal >= 0 and (parts or self._rows):
            text = "".join(f"\x1b[1;31m{part}\x1b[0m" if bad else part for part, bad in parts)
            above = f"\x1b[{self._rows - 1}A" if self._rows > 1 else ""
            with suppress(OSError, ValueError):  # it is full or gone; a name of surrogates
                os.write(self._terminal, f"\r{above}\x1b[J{text}".encode())
                width = os.get_terminal_size(self._terminal).columns or 80
                self._rows = -(-sum(len(part) for part, _ in parts) // width)


class Notes:
    """Notes of the operator: lines of standard input, in a terminal from the key `m` to Enter.

    The terminal stays in its line mode, in which the system edits the line and Ctrl-C works. Until
    the key is pressed, `m` ends a line as Enter does, so that it can be read at once.
    """

    def __init__(self, line: StatusLine) -> None:
        self._line, self._is_terminal = line, os.isatty(STDIN)
        self._read = b""  # and not returned yet
        self._modes: list[Any] = []  # of the terminal before
        self.typing = False  # whether the key has been pressed, and Enter has not

    def take(self) -> list[str]:
        """Return the next note if there is one. Never waits or raises."""
        line = b""
        with suppress(OSError, termios.error):  # closed; a terminal that is gone
            if not self._is_terminal or self._in_foreground():
                line = self._next_line()
        text = one_line(line.decode(errors="replace"))
        return [text] if text else []

    def close(self) -> None:
        """Set the terminal back to its modes, and drop what was typed since the last Enter."""
        with suppress(OSError, termios.error):
            if self._modes and self._in_foreground():
                termios.tcflush(STDIN, termios.TCIFLUSH)
                termios.tcsetattr(STDIN, termios.TCSANOW, self._modes)

    def _in_foreground(self) -> bool:
        """Whether this process may use its terminal; in the background the system would halt it."""
        return os.tcgetpgrp(STDIN) == os.getpgrp()

    def _await_key(self, awaited: bool) -> None:
        """Let `m` end a line, or Enter alone as before."""
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
            ended = not read and not self._is_terminal  # a terminal goes on after Ctrl-D
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
            self._line.show()  # the text stays, above the next line
            self._await_key(True)
        return text
