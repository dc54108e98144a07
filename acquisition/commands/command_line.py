"""The command line of both packages: parser, standard streams, errors in one line, exit statuses.

Each command is a module with `add(parser)`, which declares its options, and `run(options)`, which
calls the library and prints. The module of a command is imported when the command is chosen, and
`run` imports the libraries, so that `--help` is fast.
"""

import argparse
import errno
import gc
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, fields
from difflib import get_close_matches
from importlib import import_module
from keyword import iskeyword
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    NoReturn,
    TextIO,
    TypeVar,
    cast,
    get_args,
    get_origin,
)

from ..errors import RobotIdimError, one_line
from ..versions import version_of

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")

STATUSES = (
    "exit status: 0 success; 1 error, in one line on standard error; 2 wrong usage; "
    "3 result that must not be trusted (fit, fleet, validate); 130 Ctrl-C"
)
PACKAGES = (
    "numpy",
    "scipy",
    "pin",
    "rerun-sdk",
    "mcap",
    "rosbags",
    "python-can",
    "canopen",
    "msgspec",
)


@dataclass(frozen=True, kw_only=True)
class Program:
    """A command line.

    Attributes:
        name: name of the program.
        description: one line about it.
        package: package with a module for each command, of the same name. If the name is a Python
            keyword, the module has an underscore after it.
        commands: help of each command, in order.
        gone: what replaces a command, an option, or an option of one command ("command --option")
            of older versions.
    """

    name: str
    description: str
    package: str
    commands: Mapping[str, str]
    gone: Mapping[str, str]

    def parser(self, *chosen: str) -> argparse.ArgumentParser:
        """Return the parser of all commands; only those `chosen` have their options, and `run`."""
        parser = _Parser(
            prog=self.name, description=self.description, epilog=STATUSES, allow_abbrev=False
        )
        parser.add_argument(
            "--version",
            action=_Versions,
            nargs=0,
            help="print the versions of this program and its dependencies",
        )
        commands = parser.add_subparsers(required=True, metavar="COMMAND")
        for name, help_text in self.commands.items():
            command = commands.add_parser(
                name, help=help_text, description=help_text, allow_abbrev=False
            )
            if name in chosen:
                module = import_module(f"{self.package}.{name}{'_' * iskeyword(name)}")
                module.add(command)
                command.set_defaults(
                    run=module.run,
                    option_of_argument={
                        action.dest: action.option_strings[-1]
                        for action in command._actions
                        if action.option_strings
                    },
                )
        return parser

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Run the command in `arguments`, and return one of `STATUSES`.

        By default, the arguments are those of the process.
        """
        given = sys.argv[1:] if arguments is None else arguments
        # Imports leave little garbage, and looking for it would take 0.08 s of a fit.
        gc.set_threshold(200_000)
        # The matrices are so small that threads of OpenBLAS would only wait for each other.
        # OpenBLAS reads this variable when it is imported.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", os.environ.get("OMP_NUM_THREADS", "1"))

        names: dict[str, str] = {}

        def command() -> int | None:
            # The first word without a dash is the command, since no option before it takes a value.
            chosen = next((argument for argument in given if not argument.startswith("-")), "")
            parser, flags = (
                self.parser(chosen),
                [word.partition("=")[0] for word in given if word.startswith("-")],
            )
            for name in (chosen, *flags, *(f"{chosen} {flag}" for flag in flags)):
                if name in self.gone:
                    parser.error(f"{name} no longer exists: {self.gone[name]}")
            # The completion needs the options of all commands. shtab is an optional dependency.
            if flags[:1] == ["--print-completion"]:
                parser = self.parser(*self.commands)
                try:
                    import_module("shtab").add_argument_to(parser, "--print-completion")
                except ImportError:
                    parser.error(
                        "--print-completion needs shtab. Run: pip install 'robot-idim[completion]'"
                    )
            options = parser.parse_args(given)
            names.update(options.option_of_argument)
            return cast(int | None, options.run(options))

        return run_command(self.name, command, names)


class _Parser(argparse.ArgumentParser):
    """A parser that refuses wrong usage in one line.

    The line suggests the nearest option, command or choice.
    """

    def error(self, message: str) -> NoReturn:
        """Print the line, and exit with status 2."""
        commands = [
            c for a in self._actions if isinstance(a.choices, dict) for c in a.choices.values()
        ]
        options, choices = (
            {
                option.lstrip("-"): option
                for p in (self, *commands)
                for option in p._option_string_actions
            },
            {
                str(choice): str(choice)
                for action in self._actions
                for choice in action.choices or ()
            },
        )
        near = [
            known[x]
            for known, pattern, text in (
                (options, r" --?([\w-]+)", message.partition("unrecognized arguments:")[2]),
                (choices, r"invalid choice: '([^']*)'", message),
            )
            for word in re.findall(pattern, text)
            for x in get_close_matches(word, known, n=1, cutoff=0.75)
        ]
        message = (
            f"{message.partition(' (choose')[0]}: did you mean {near[0]}?" if near else message
        )
        self.exit(2, one_line(f"{self.prog}: error: {message}") + "\n")


class _Versions(argparse.Action):
    """An action that prints versions, one per line, and exits."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        print(
            f"{parser.prog} {version_of('robot-idim', 'not installed')}",
            f"Python {sys.version.split()[0]}",
            *(f"{package} {version_of(package, 'not installed')}" for package in PACKAGES),
            sep="\n",
        )
        parser.exit()


def add_options(
    parser: "argparse._ActionsContainer",
    record: type["DataclassInstance"],
    *names: str,
    **defaults: Any,
) -> None:
    """Declare options for the fields of `record` that have an `option`: all, or those in `names`.

    If an option is not given, its value is that in `defaults`, or None, for which `from_options`
    uses the default of the field.
    """
    for field in fields(record):
        if get_origin(field.type) is not Annotated or (names and field.name not in names):
            continue
        kind, arguments = get_args(field.type)
        how = {key: value for key, value in arguments.items() if value is not None}
        default = defaults.get(field.name, field.default)
        if kind is bool:
            how["action"] = "store_true"
        elif get_origin(kind) is Literal:
            how |= {"choices": get_args(kind), "type": str.lower}
        if default is not None and kind is not bool and "default" not in how["help"]:
            how["help"] += f" (default: {_default_text(default)})"
        parser.add_argument(
            how.pop("flag") or f"--{field.name.replace('_', '-')}",
            dest=field.name,
            default=defaults.get(field.name),
            **how,
        )


def _default_text(default: Any) -> str:
    if isinstance(default, tuple):
        return ",".join("none" if part == 0 else _default_text(part) for part in default)
    return default if isinstance(default, str) else f"{default:g}"


def from_options(kind: type[T], options: argparse.Namespace, **others: Any) -> T:
    """Make a dataclass from the options that have the names of its fields, and from `others`.

    An option that is None leaves the default of the field.
    """
    given = {field.name: getattr(options, field.name, None) for field in fields(kind)}
    return kind(**{**{name: value for name, value in given.items() if value is not None}, **others})


def add_path(
    parser: "argparse._ActionsContainer", names: str, metavar: str, help: str = "", **how: Any
) -> None:
    """Declare a file or a folder. The names of an option are separated by blanks."""
    action = parser.add_argument(
        *names.split(), type=Path, metavar=metavar, help=help or None, **how
    )
    # This is `FILE` of shtab.
    vars(action)["complete"] = {"bash": "_shtab_compgen_files", "zsh": "_files"}


def add_flag(parser: "argparse._ActionsContainer", name: str, help: str) -> None:
    """Declare an option without a value."""
    parser.add_argument(name, action="store_true", help=help)


def add_bus(parser: "argparse._ActionsContainer", *, required: bool) -> None:
    """Declare the bus of a command without robot.toml."""
    parser.add_argument(
        "--interface",
        required=required,
        metavar="NAME",
        help="interface of python-can, such as socketcan or udp_multicast",
    )
    parser.add_argument(
        "--channel",
        required=required,
        metavar="NAME",
        help="channel of the interface, such as can0 or a multicast group",
    )


def add_overwrite(parser: "argparse._ActionsContainer") -> None:
    """Declare `--overwrite` of commands that write recordings."""
    add_flag(parser, "--overwrite", "replace an existing recording once the new one is complete")


class Progress(ExitStack):
    """A progress line on standard error, only on a terminal.

    Attributes:
        say: replaces the text of the line; accepts a `rich.text.Text`, too.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.say: Callable[[Any], None] = lambda text: None
        if sys.stderr.isatty():
            from rich.console import Console

            self.say = self.enter_context(Console(stderr=True).status(text)).update


class _Stream:
    """A text stream that stores its first error and drops later text.

    A failed `print` therefore does not end a command.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self.error: OSError | None = None
        if isinstance(stream, io.TextIOWrapper):
            # A terminal without Unicode shows ? for other characters, instead of raising an error.
            stream.reconfigure(errors="replace")

    def write(self, text: str) -> int:
        self._unless_failed(lambda: self.stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._unless_failed(self.stream.flush)

    def __getattr__(self, name: str) -> object:
        return getattr(self.stream, name)

    def _unless_failed(self, call: Callable[[], object]) -> None:
        try:
            if self.error is None:
                call()
        except OSError as error:
            self.error = error
            # Python flushes again at exit and would report the error, so the rest goes to
            # /dev/null. The stream of a test has no descriptor.
            with suppress(OSError), open(os.devnull, "w") as null:
                os.dup2(null.fileno(), self.stream.fileno())


def run_command(
    program: str,
    command: Callable[[], int | None],
    options: Mapping[str, str] | None = None,
) -> int:
    """Run `command` and return the exit status.

    A pipe of standard output that is closed early (`| head -1`) is not an error. If standard output
    cannot be written for another reason (a full disk), the command finishes, then the status is 1.

    Parameters
    ----------
    program : name of the program, for errors.
    command : returns the exit status; None stands for 0.
    options : options of the arguments that errors may name.

    Returns
    -------
    The status of the command, 1 after an error, or 130 on Ctrl-C.
    """
    with _standard_streams() as (out, err):
        try:
            status = command() or 0
        except KeyboardInterrupt:
            return _refuse(err, program, "interrupted", 130)
        except RobotIdimError as error:
            return _refuse(err, program, error.message(options), 1)
        except OSError as error:
            where = "" if error.filename is None else f"{error.filename}: "
            return _refuse(err, program, f"{where}{error.strerror or error}", 1)
        out.flush()
        if out.error is not None and out.error.errno != errno.EPIPE:
            return _refuse(
                err,
                program,
                f"standard output cannot be written: {out.error.strerror or out.error}",
                1,
            )
        return status


def _refuse(err: _Stream, program: str, text: str, status: int) -> int:
    err.write(f"{program}: {one_line(text)}\n")
    return status


@contextmanager
def _standard_streams() -> Iterator[tuple[_Stream, _Stream]]:
    """Guard standard output and error inside the block.

    Output to a closed stream (`>&-`) is discarded.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            # This reserves the number, which the next opened file would get otherwise.
            os.open(os.devnull, os.O_RDWR)
    out, err = _Stream(sys.stdout or io.StringIO()), _Stream(sys.stderr or io.StringIO())
    with redirect_stdout(cast(TextIO, out)), redirect_stderr(cast(TextIO, err)):
        try:
            yield out, err
        finally:
            out.flush()
            err.flush()
