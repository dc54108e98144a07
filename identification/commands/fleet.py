"""`robot-identify fleet`: one fit per recording, a table of the fits, and their drift."""

import argparse

from acquisition.commands import Progress, add_flag, add_path, from_options

from ..options import Overrides
from .arguments import (
    add_pictures,
    add_settings,
    add_work,
    make_folder,
    print_results,
    refuse_outputs,
    trust_status,
    work_of,
    write_pictures,
)


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    text = "folder with recordings (*.mcap), subfolders included; each folder has its control limits"
    add_path(inputs, "folders", "FOLDER", text, nargs="+")
    add_flag(inputs, "--by-folder", "fit the recordings of each folder together: one row per folder")
    add_path(inputs, "--robot", "ROBOT.toml", "use this description instead of the recordings' own")
    add_settings(parser, method=True)
    add_work(parser)
    outputs = parser.add_argument_group("outputs")
    text = "the table to write; finished rows are stored in the folder FLEET.parquet.rows; the next run does not fit them again"
    add_path(outputs, "-o --out", "FLEET.parquet", text, required=True)
    add_pictures(outputs, "draw the drift with control limits as a Rerun file")


def run(options: argparse.Namespace) -> int:
    """Fit every recording without a stored row, write and print the table; 3 if none could be fitted."""
    refuse_outputs([options.robot], options.out, report=options.report, picture=options.rrd)
    with Progress("reading") as progress:
        from acquisition.robot import load_robot

        from ..study import FleetSettings, drifts, fleet_document, found_recordings, method_of, run_fleet, write_table

        recordings = found_recordings(options.folders, by_folder=options.by_folder)
        paths = [entry.path for entry in recordings]
        settings = FleetSettings(
            description=tuple(load_robot(options.robot).files.items()) if options.robot else None,
            method=options.method or method_of(recordings),
            overrides=from_options(Overrides, options),
        )
        refuse_outputs(paths, options.out, options.rrd, report=options.report)
        rows_folder = options.out.with_name(f"{options.out.name}.rows")
        make_folder(rows_folder)

        def say(done: int, file: str) -> None:
            progress.say(f"{done} of {len(recordings)}: {file}")

        rows = run_fleet(recordings, settings, rows_folder, lambda tasks: work_of(options, tasks), say)
    write_table(options.out, rows)
    document, series = fleet_document(rows), drifts(rows)
    try:
        write_pictures(options, document, lambda view: [view.draw_fleet(series, document)])
    finally:  # print the table of a long run even if a file cannot be written
        print_results(document)
    return trust_status(
        [] if any(row.is_fitted for row in rows) else [f"no recording could be fitted: {rows[0].reason}"]
    )
