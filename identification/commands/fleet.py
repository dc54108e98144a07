"""`robot-identify fleet`: one fit per recording of many, a table of them, and their drift."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from acquisition.commands import Progress, add_flag, add_path, from_options

from .arguments import (
    add_method,
    add_settings,
    add_work,
    make_folder,
    print_results,
    refuse_outputs,
    untrusted,
    work_of,
)

if TYPE_CHECKING:
    from ..study import FleetSettings


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    add_path(
        inputs, "folders", "FOLDER", "every *.mcap in it and below; control limits are those of a folder", nargs="+"
    )
    add_flag(inputs, "--by-folder", "fit recordings that lie in one folder together: a row per folder")
    add_path(inputs, "--robot", "ROBOT.toml", "use this description instead of the recordings' own")
    add_method(add_settings(parser))
    add_work(parser)
    outputs = parser.add_argument_group("outputs")
    text = "the table to write; rows are kept in the folder FLEET.parquet.rows, and are not fitted again"
    add_path(outputs, "-o --out", "FLEET.parquet", text, required=True)
    add_path(outputs, "--rrd", "FILE", "draw the drift with control limits as a Rerun file")


def run(options: argparse.Namespace) -> int:
    """Fit every recording that is not kept, write the table, print it; 3 where none could be fitted."""
    refuse_outputs([options.robot], options.out, picture=options.rrd)
    with Progress("reading") as progress:
        from ..study import drifts, fleet_document, found_recordings, run_fleet, write_table

        recordings = found_recordings(options.folders, by_folder=options.by_folder)
        settings = _settings(options, [path for _, path in recordings])
        refuse_outputs([path for _, path in recordings], options.out, options.rrd)
        kept = options.out.with_name(f"{options.out.name}.rows")
        make_folder(kept)
        rows = run_fleet(
            recordings,
            settings,
            kept,
            lambda tasks: work_of(options, tasks),
            lambda done, file: progress.say(f"{done} of {len(recordings)}: {file}"),
        )
    write_table(options.out, rows)
    document, series = fleet_document(rows), drifts(rows)
    try:
        if options.rrd:
            with Progress("writing the Rerun file"):
                from ..view import write_fleet_rrd

                write_fleet_rrd(options.rrd, series, document)
    finally:  # print the table of a long run even if a file cannot be written
        print_results(document)
    return untrusted([] if any(row.is_fitted for row in rows) else [f"no recording could be fitted: {rows[0].reason}"])


def _settings(options: argparse.Namespace, recordings: list[Path]) -> "FleetSettings":
    from acquisition.robot import load_robot

    from ..regression import Overrides
    from ..study import FleetSettings, method_of

    robot = load_robot(options.robot) if options.robot else None
    return FleetSettings(
        method=options.method or method_of(recordings),
        overrides=from_options(Overrides, options),
        description=None if robot is None else tuple(robot.files.items()),
    )
