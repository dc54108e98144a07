"""Dataclass fields that are command options, each with its default, unit and help.

The module has no heavy imports, because `--help` reads these records without the subpackages that
use them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any


def option(
    help: str,
    metavar: str | None = None,
    type: Callable[[str], Any] | None = None,
    flag: str = "",
    **others: Any,
) -> dict[str, Any]:
    """Return the annotation of a field that is an option.

    The annotation has the arguments of `ArgumentParser.add_argument`, without those that are None.
    `flag` defaults to `--` and the field's name. `commands.add_options` adds the default to the
    help.
    """
    return {"help": help, "metavar": metavar, "type": type, "flag": flag, **others}


@dataclass(frozen=True, kw_only=True)
class RecordOptions:
    """The options of `robot-acquire record`."""

    track: Annotated[
        Path | None,
        option(
            "MOVES THE ROBOT along this table of time_s and joint positions in rad or m",
            "REFERENCE.csv",
            Path,
        ),
    ] = None
    payload: Annotated[
        str | None,
        option(
            "payload mass in kg and its centre of mass in m; append +-H for a half-width of H m",
            "KG[@X,Y,Z]",
            str,
        ),
    ] = None
    passive: Annotated[
        bool, option("only listen and never send, for a bus with another master")
    ] = False
    dry_run: Annotated[bool, option("simulate the drives; no bus is needed")] = False
    duration_s: Annotated[
        float | None,
        option("recording time in s (default: until Ctrl-C)", "S", float, "--duration"),
    ] = None
    speed: Annotated[
        float, option("speed factor of --track, greater than 0 and at most 1", "X", float)
    ] = 1.0
    reset_faults: Annotated[bool, option("reset drive faults before motion without asking")] = False
    unsupervised_drives: Annotated[
        bool,
        option("allow --track although a drive does not monitor its master or following error"),
    ] = False
