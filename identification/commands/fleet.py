"""`robot-identify fleet`: a fit of each recording in folders, as a table that marks changes."""

import argparse

from acquisition.commands import Progress, add_flag, add_path
from acquisition.errors import Location

from .arguments import (
    add_method,
    add_work,
    make_folder,
    print_results,
    refuse_outputs,
    trust_status,
    work_of,
)


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs = parser.add_argument_group("inputs")
    add_path(
        inputs,
        "folders",
        "FOLDER",
        "folder with recordings (*.mcap), subfolders included",
        nargs="+",
    )
    add_flag(inputs, "--by-folder", "fit the recordings of each folder together, in one row")
    add_path(inputs, "--robot", "ROBOT.toml", "use this description instead of the recorded one")
    add_method(parser.add_argument_group("settings of the fit"))
    add_work(parser)
    add_path(
        parser.add_argument_group("outputs"),
        "-o --out",
        "OUT",
        "table to write, .parquet or .csv; the next run reuses the fits in the folder OUT.rows",
        required=True,
    )


def run(options: argparse.Namespace) -> int:
    """Fit every recording without a stored fit, and write and print the table.

    The exit status is 3 if no recording could be fitted.
    """
    out, ending = options.out, options.out.suffix
    Location(str(out)).require(ending in (".parquet", ".csv"), "ending", ending, ".parquet or .csv")
    refuse_outputs([options.robot], out)
    with Progress("reading") as progress:
        from ..study import fleet_document, found_recordings, run_fleet, write_table

        found = found_recordings(options.folders, options.robot, by_folder=options.by_folder)
        store = out.with_name(f"{out.name}.rows")
        make_folder(store)
        rows = run_fleet(found, options.method, store, work_of(options, len(found)), progress.say)
    write_table(out, rows)
    print_results(fleet_document(rows), everything=False)
    return trust_status(
        []
        if any(row.parameters for row in rows)
        else [f"no recording could be fitted: {rows[0].reason}"]
    )
