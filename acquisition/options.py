"""Dataclass fields that are command options, each with its default, unit and help.

No heavy imports: `--help` reads these records without the rooms that use them.
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
    """The annotation of a field that is an option: arguments of
    `ArgumentParser.add_argument`; None is left out.

    `flag` defaults to `--` and the field's name. `commands.add_options` adds
    the default to the help.
    """
    return {"help": help, "metavar": metavar, "type": type, "flag": flag, **others}


@dataclass(frozen=True, kw_only=True)
class RecordOptions:
    """The options of `robot-acquire record`."""

    track: Annotated[
        Path | None,
        option(
            "MOVES THE ROBOT along this table of time_s and joint positions (rad, m)",
            "REFERENCE.csv",
            Path,
        ),
    ] = None
    payload: Annotated[
        str | None,
        option(
            "mass that the robot carries, kg, and centre of mass, m (+-0.005 after it)",
            "KG[@X,Y,Z]",
            str,
        ),
    ] = None
    passive: Annotated[bool, option("never send anything, because another master owns the bus")] = (
        False
    )
    dry_run: Annotated[bool, option("use simulated drives, without a bus")] = False
    duration_s: Annotated[
        float | None, option("seconds to record (default: until Ctrl-C)", "S", float, "--duration")
    ] = None
    speed: Annotated[
        float, option("speed factor of --track, above 0 and at most 1 (default 1)", "X", float)
    ] = 1.0
    reset_faults: Annotated[bool, option("with --track, reset drive faults without asking")] = False
    unsupervised_drives: Annotated[
        bool, option("allow --track with drives that do not supervise themselves")
    ] = False
