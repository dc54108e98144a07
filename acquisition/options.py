"""Fields of records that are options of commands: default, unit and help of an option stand at its field, once.

Nothing heavy is imported here: `--help` reads these records without the rooms that use them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any


def option(
    help: str, metavar: str | None = None, type: Callable[[str], Any] | None = None, flag: str = "", **others: Any
) -> dict[str, Any]:
    """What `Annotated` says of a field that is an option: arguments of `ArgumentParser.add_argument`, those not None.

    `flag` is `--` and the field's name where it is not given. `commands.add_options` adds the default to the help.
    """
    return {"help": help, "metavar": metavar, "type": type, "flag": flag, **others}


@dataclass(frozen=True, kw_only=True)
class RecordOptions:
    """What a session is to do: the options of `robot-acquire record`."""

    track: Annotated[
        Path | None, option("MOVES THE ROBOT along time_s and each joint's rad or m", "REFERENCE.csv", Path)
    ] = None
    passive: Annotated[bool, option("another master owns the bus: send nothing, ever")] = False
    dry_run: Annotated[bool, option("all of it on simulated drives, without any bus")] = False
    duration_s: Annotated[float | None, option("seconds; without it until Ctrl-C", "S", float, "--duration")] = None
    speed: Annotated[float, option("--track slower: more than 0 to 1, the default", "X", float)] = 1.0
    reset_faults: Annotated[bool, option("--track without asking whether to reset faults")] = False
    unsupervised_drives: Annotated[bool, option("--track with drives that do not supervise themselves")] = False
