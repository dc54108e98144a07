"""Fits of every recording in folders, as rows of a table for several robots over time.

Fits of earlier runs are reused.
"""

import hashlib
import textwrap
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

import msgspec

from acquisition.errors import Location, RobotIdimError
from acquisition.files import atomic_write
from acquisition.robot import load_robot

from ..data import RecordingFile, Recordings, Work
from ..regression import Overrides
from ..report import (
    Document,
    Method,
    Number,
    Parameter,
    ResultFile,
    Section,
    Table,
    columns,
    versions,
    write_json,
)
from ..results import fitted_parameters, identify

MAX_WIDTH = 60  # characters of the changes in a line of the printed table
# by the path of a recording, or of a folder of some, what is fitted
Found = dict[Path, list[RecordingFile]]


class FleetRow(ResultFile, frozen=True, kw_only=True):
    """The fit of a recording, or of the recordings of a folder together.

    Attributes:
        file: path of the recording, or of the folder.
        sha256: SHA-256 digests of the recordings, separated by spaces; empty if the fit failed.
        start: start of the first recording; None if it is not known.
        robot: name of the robot.
        method: method of the fit, `iv`, `wls` or `ols`.
        status: status of the fit; `failed` for a `reason`.
        verdict: verdict of the tests of the fit.
        reason: why the fit failed or did not converge; empty if it did.
        changed: parameters that changed since the fit before, by `with_changes`.
        torque_error_percent: relative torque error of all joints, percent; None if the fit failed.
        parameters: parameters with their 95 % intervals, by name; empty if the fit failed.
    """

    file: str
    sha256: str = ""
    start: datetime | None = None
    robot: str = ""
    method: str = ""
    status: str = "failed"
    verdict: str = ""
    reason: str = ""
    changed: str = ""
    torque_error_percent: float | None = None
    parameters: dict[str, Parameter] = msgspec.field(default_factory=dict)


def found_recordings(
    folders: Sequence[Path], robot: Path | None = None, *, by_folder: bool = False
) -> Found:
    """Find every `*.mcap` under the folders.

    Parameters
    ----------
    folders : folders to search, with their subfolders.
    robot : robot.toml that replaces the recorded descriptions; None for the recorded ones.
    by_folder : True to put recordings of the same folder together.

    Returns
    -------
    The recordings of each entry, by the path of the recording, or of the folder.

    Raises
    ------
    BadInputError : one of `folders` has no recording, or the description cannot be read.
    """
    files, found, described = set[Path](), Found(), load_robot(robot) if robot else None
    for folder in folders:
        # hidden ones are being written
        new = {x for x in folder.rglob("*.mcap") if x.is_file() and x.name[0] != "."}
        Location(str(folder)).require(new, text="contains no recordings (*.mcap)")
        files |= new
    for file in sorted(files):
        found.setdefault(file.parent if by_folder else file, []).append(
            RecordingFile.at(file, described)
        )
    return found


def run_fleet(
    found: Found, method: Method | None, store: Path, work: Work, say: Callable[[str], None]
) -> list[FleetRow]:
    """Return a row for each entry of `found`, ordered by start.

    Entries without a start come last. A failure is a row with a `reason`. A stored fit is reused
    until a file, its description, the method or versions of packages differ.

    Parameters
    ----------
    found : recordings by path, of `found_recordings`.
    method : method of the fits; None for `iv` where recordings have their reference, else `wls`.
    store : folder in which each fit is stored.
    work : where the recordings are fitted.
    say : called with a line of text after each new fit.

    Returns
    -------
    The rows, with their changes by `with_changes`.

    Raises
    ------
    BadInputError : a fit cannot be stored, the workers cannot be used, or one ends early.
    OSError : a recording no longer exists.
    """
    rows, tasks = list[FleetRow](), dict[Path, tuple[object, ...]]()
    for path, sources in found.items():
        made_from = (
            sources,
            [Path(source.path).stat().st_mtime_ns for source in sources],
            method,
            versions(),
        )
        name = store / f"{hashlib.sha256(repr(made_from).encode()).hexdigest()[:32]}.json"
        try:
            rows.append(
                msgspec.structs.replace(
                    msgspec.json.decode(name.read_bytes(), type=FleetRow), file=str(path)
                )
            )
        except (OSError, msgspec.DecodeError):  # none, damaged, or of another version
            tasks[name] = str(path), sources, method
    for name, row in zip(tasks, work.run(fit_row, list(tasks.values())), strict=True):
        if row.parameters:  # what failed is tried again
            write_json(name, row)
        rows.append(row)
        say(f"{len(rows)} of {len(found)}: {row.file}")
    return with_changes(
        sorted(
            rows, key=lambda row: (row.start.timestamp() if row.start else float("inf"), row.file)
        )
    )


def fit_row(file: str, sources: Sequence[RecordingFile], method: Method | None) -> FleetRow:
    """Return the row with the fit of one recording, or of several of one robot together.

    A failed fit gives a row with the reason.
    """
    try:
        loaded = tuple(source.load() for source in sources)
        fit = identify(Recordings(sources=loaded), Overrides(), method=method)
    except Exception as error:  # a bug that one recording triggers must not end a run of days
        expected = isinstance(error, RobotIdimError | OSError)
        return FleetRow(
            file=file,
            reason=(getattr(error, "strerror", None) or str(error))
            if expected
            else f"unexpected {error!r}",
        )
    return FleetRow(
        file=file,
        sha256=" ".join(signals.sha256 for signals in loaded),
        start=min((signals.began for signals in loaded if signals.began is not None), default=None),
        robot=loaded[0].robot.name,
        method=fit.method,
        status=fit.status,
        verdict=fit.trust.verdict,
        reason=fit.solution.reason or "",
        torque_error_percent=fit.errors[-1].relative_error_percent,
        parameters=dict(fitted_parameters(fit).parameters),
    )


def with_changes(rows: Sequence[FleetRow]) -> list[FleetRow]:
    """Name in `changed` the parameters whose 95 % interval does not overlap that of the fit before.

    The rows are compared in their order: fits of one robot in one folder by one method with a known
    start, but not with the verdict `do not use`. Of two independent estimates of one value with
    equal intervals 0.6 % are named: |a - b| > 2 * 1.96 sigma.

    Parameters
    ----------
    rows : rows ordered by start.

    Returns
    -------
    The rows in the same order, each with `changed`.
    """
    marked, before = list[FleetRow](), dict[tuple[str, ...], FleetRow]()
    for row in rows:
        is_known = row.start is not None and row.verdict != "do not use"
        key = (str(Path(row.file).parent), row.robot, row.method) if is_known else (row.file,)
        earlier, before[key] = before.get(key, row).parameters, row
        changed = [
            f"{name} {old.value:.4g} to {x.value:.4g} {x.unit}"
            for name, x in row.parameters.items()
            if (old := earlier.get(name, x)) and abs(x.value - old.value) > old.half + x.half
        ]
        marked.append(msgspec.structs.replace(row, changed=", ".join(changed)))
    return marked


def write_table(path: Path, rows: Sequence[FleetRow]) -> None:
    """Write the rows as a table, completely or not at all.

    Columns are the fields of `FleetRow`, and for each parameter its name, and name_half_width of
    its 95 % interval, with the `unit` in the metadata of a Parquet column. Missing values are null,
    in CSV empty.

    Parameters
    ----------
    path : file to write; CSV if it ends in .csv, else Parquet.
    rows : rows of the table.

    Raises
    ------
    BadInputError : the file cannot be written.
    """
    import pyarrow
    from pyarrow import csv, parquet

    kinds = {"start": pyarrow.timestamp("us", tz="UTC"), "torque_error_percent": pyarrow.float64()}
    units = {name: x.unit for row in rows for name, x in row.parameters.items()}
    fields = [
        *(
            pyarrow.field(name, kinds.get(name, pyarrow.string()))
            for name in FleetRow.__struct_fields__
            if name not in ("format", "parameters")
        ),
        *(
            pyarrow.field(name + end, pyarrow.float64(), metadata={"unit": unit})
            for name, unit in units.items()
            for end in ("", "_half_width")
        ),
    ]
    cells = [
        msgspec.structs.asdict(row)
        | {name: x.value for name, x in row.parameters.items()}
        | {f"{name}_half_width": x.half for name, x in row.parameters.items()}
        for row in rows
    ]
    with atomic_write(path) as partial:
        (csv.write_csv if path.suffix == ".csv" else parquet.write_table)(
            pyarrow.Table.from_pylist(cells, schema=pyarrow.schema(fields)), partial
        )


def fleet_document(rows: Sequence[FleetRow]) -> Document:
    """Make the printed table of fits.

    It has a line per fit with the changes since the one before, and the reasons of failures.

    Parameters
    ----------
    rows : rows of `run_fleet`.

    Returns
    -------
    The report.
    """
    table = Table(
        columns=(
            *columns("start, UTC", "recording", "status", "verdict", numbers=("torque\nerror, %",)),
            *columns("changed"),
        ),
        rows=tuple(
            (
                f"{row.start:%Y-%m-%d %H:%M}" if row.start else "-",
                row.file,
                row.status,
                row.verdict or "-",
                Number(row.torque_error_percent, ".3g"),
                textwrap.shorten(row.changed, MAX_WIDTH, placeholder=" ...") or "-",
            )
            for row in rows
        ),
    )
    return Document(
        title=f"recordings: {len(rows)}, fitted: {sum(bool(row.parameters) for row in rows)}",
        sections=(
            Section(
                table=table,
                warnings=tuple(
                    f"{row.file}: {row.status}: {row.reason}" for row in rows if row.reason
                ),
            ),
        ),
    )
