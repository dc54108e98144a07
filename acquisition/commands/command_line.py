"""The command line of both packages: parser of all commands, standard streams, errors in one line, exit statuses.

Each command is a module with `add(commands)`, which declares its options and sets `run`, and `run(options)`, which carries
it out: parse, one library call, print. Libraries are imported by `run`, so that `--help` loads nothing heavy.
"""

import argparse
import errno
import io
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from types import ModuleType
from typing import TYPE_CHECKING, Any, TextIO, TypeAlias, TypeVar, cast

from ..errors import one_line

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
T = TypeVar("T", bound="DataclassInstance")

STATUSES = (
    "exit status: 0 done; 1 an error, in one line on standard error; 2 wrong usage; "
    "3 done, but the result is not to be trusted (robot-identify fit, validate); 130 interrupted by Ctrl-C"
)
DISTRIBUTION = "robot-idim"
PACKAGES = ("numpy", "scipy", "pin", "rerun-sdk", "mcap", "rosbags", "python-can", "canopen", "msgspec")


@dataclass(frozen=True, kw_only=True)
class Program:
    """A command line: its name, one line about it, its commands in the order of the help, the errors it prints in one line."""

    name: str
    description: str
    commands: tuple[ModuleType, ...]
    errors: tuple[type[Exception], ...]

    def parser(self) -> argparse.ArgumentParser:
        """The parser of all commands; the options that it returns have `run`."""
        parser = argparse.ArgumentParser(prog=self.name, description=self.description, epilog=STATUSES)
        versions = "versions of this program and its dependencies"
        parser.add_argument("--version", action=_Versions, nargs=0, help=versions)
        commands = parser.add_subparsers(required=True, metavar="COMMAND")
        for command in self.commands:
            command.add(commands)
        return parser

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Run the command that `arguments` name (default: those of the process); the exit status is one of `STATUSES`."""

        def command() -> int | None:
            options = self.parser().parse_args(arguments)
            return cast(int | None, options.run(options))

        return run_command(self.name, self.errors, command)


class _Versions(argparse.Action):
    """Print versions, one per line, and exit."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import PackageNotFoundError, version

        def of(package: str) -> str:
            try:
                return version(package)
            except PackageNotFoundError:
                return "not installed"

        print(f"{parser.prog} {of(DISTRIBUTION)}")
        print(f"Python {sys.version.split()[0]}", *(f"{package} {of(package)}" for package in PACKAGES), sep="\n")
        parser.exit()


def from_options(kind: type[T], options: argparse.Namespace, **others: Any) -> T:
    """A dataclass made of the options that have the names of its fields, and of `others`.

    An option that was not given (None) leaves the field's default.
    """
    given = {field.name: getattr(options, field.name, None) for field in fields(kind)}
    return kind(**{**{name: value for name, value in given.items() if value is not None}, **others})


def add_overwrite(parser: "argparse._ActionsContainer") -> None:
    """Declare the option of commands that write recordings."""
    parser.add_argument(
        "--overwrite", action="store_true", help="replace an existing recording when the new one is whole"
    )


class Progress:
    """A line on standard error that shows progress; only on a terminal (`shown`)."""

    def __init__(self, text: str) -> None:
        self.shown = sys.stderr.isatty()
        if self.shown:
            from rich.console import Console

            self._status = Console(stderr=True).status(text)

    def say(self, text: Any) -> None:
        """Replace the text, by another or by a `rich.text.Text`."""
        if self.shown:
            self._status.update(text)

    def __enter__(self) -> "Progress":
        if self.shown:
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.shown:
            self._status.stop()


class _Stream:
    """A text stream that drops what cannot be written and stores the first error, so that no `print` ends a command."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self.error: OSError | None = None
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Unicode shows ? for other characters

    def write(self, text: str) -> int:
        self._unless_failed(lambda: self.stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._unless_failed(self.stream.flush)

    def __getattr__(self, name: str) -> object:
        return getattr(self.stream, name)

    def _unless_failed(self, call: Callable[[], object]) -> None:
        if self.error is not None:
            return
        try:
            call()
        except OSError as error:
            self.error = error
            # Python flushes again at exit and would report the error: the rest is written to /dev/null.
            with suppress(OSError):  # the stream of a test has no descriptor
                null = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null, self.stream.fileno())
                os.close(null)


def run_command(program: str, errors: Sequence[type[Exception]], command: Callable[[], int | None]) -> int:
    """Run `command` and return the exit status: its own (None is 0), 1 after one of `errors` in one line, 130 on Ctrl-C.

    A pipe of standard output that is closed early (`| head -1`) is no error. Standard output that cannot be written for
    another reason (a full disk) is status 1 and one line, after the command has done everything else.
    """
    with _standard_streams() as (out, err):
        try:
            status = command() or 0
        except KeyboardInterrupt:
            return _refuse(err, program, "interrupted", 130)
        except tuple(errors) as error:
            return _refuse(err, program, str(error), 1)
        except OSError as error:
            place = "" if error.filename is None else f"{error.filename}: "
            return _refuse(err, program, f"{place}{error.strerror or error}", 1)
        out.flush()
        if out.error is not None and out.error.errno != errno.EPIPE:
            text = f"standard output: cannot be written: {out.error.strerror or out.error}"
            return _refuse(err, program, text, 1)
        return status


def _refuse(err: _Stream, program: str, text: str, status: int) -> int:
    err.write(f"{program}: {one_line(text)}\n")
    return status


@contextmanager
def _standard_streams() -> Iterator[tuple[_Stream, _Stream]]:
    """Standard output and error, guarded inside the block; output to a closed stream (`>&-`) is discarded."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes this number, which the next file to be written would get otherwise
    before = sys.stdout, sys.stderr
    with suppress(OSError):
        null = open(os.devnull, "w")  # noqa: SIM115
    out, err = _Stream(sys.stdout or null), _Stream(sys.stderr or null)
    sys.stdout, sys.stderr = cast(TextIO, out), cast(TextIO, err)
    try:
        yield out, err
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = before
