"""Columns of numbers from CSV and MAT files, without units or meaning."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import Place, listed
from .atomic import atomic_write
from .mat import read_variables


def read_columns(path: Path, columns: Sequence[str | int], count: int) -> Array:
    """Columns of a table, side by side.

    Parameters
    ----------
    path : CSV or MAT file (version 7 or older). CSV cells are separated by comma, semicolon, tab or blanks, as in the first
        line; lines that begin with # are skipped, except a header: the last such line above numbers.
    columns : names in the header line of a CSV file, or its columns by number from 1; or variables of a MAT file,
        or fields of structs by dotted name; `(:,k)`, `(:,k:l)`, `(k,:)` or `(k:l,:)` behind a name takes some of its columns
        or rows, and one name may give several columns.
    count : columns expected in all.

    Returns
    -------
    (N, columns) numbers, in the units of the file.

    Raises
    ------
    AcquisitionError
        With the file and the line or row as `place`: it cannot be read, a column does not exist, or a cell is not a finite
        number.
    """
    place = Place(str(path))
    try:
        data = path.read_bytes()
    except OSError as error:
        place.refuse(text=f"cannot be read: {error.strerror}")
    if data.startswith((b"MATLAB 7.3", b"\x89HDF")):
        place.refuse(text="a MAT file of version 7.3 (HDF5)", expected="version 7; save it with -v7")
    if data.startswith(b"MATLAB") or path.suffix.lower() == ".mat":
        values, labels = read_variables(data, columns, count, place)
    else:
        values, labels = _csv(data, columns, place)
    finite = np.isfinite(values)
    if not finite.all():
        row, column = np.argwhere(~finite)[0]
        Place(f"{path}: row {row + 1}").refuse(labels[column], float(values[row, column]), "a finite number")
    return values


def write_columns(path: Path, names: Sequence[str], parts: Iterable[Array]) -> None:
    """Write a CSV file of named columns, whole or not at all; `read_columns` reads the same numbers back, bit by bit.

    Parameters
    ----------
    path : of the file.
    names : (columns,) for its header.
    parts : rows, (k, columns) each.

    Raises
    ------
    AcquisitionError
        The file cannot be written.
    """
    with atomic_write(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.write(",".join(names) + "\n")
        for values in parts:
            np.savetxt(file, values, delimiter=",", fmt="%.17g")


def _csv(data: bytes, columns: Sequence[str | int], place: Place) -> tuple[Array, list[str]]:
    text = data.decode("utf-8-sig", errors="replace").replace('"', "")
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip()]
    if not lines:
        place.refuse(text="holds no lines", expected="a table")
    while len(lines) > 1 and lines[0][1].startswith("#") and not _has_numbers(lines[1][1]):
        del lines[0]  # a remark above the header
    first = lines[0][1].lstrip("# \t")
    separator = next((mark for mark in ";\t," if mark in first), None)
    names = [cell.strip() for cell in first.split(separator)]
    has_header = any(_number(cell) is None for cell in names)
    rows = [(k, line) for k, line in lines[has_header:] if not line.startswith("#")]
    if not has_header:
        names = [f"column {k}" for k in range(1, len(names) + 1)]
    chosen = [_index(column, names, has_header, place) for column in columns]
    count = _cells(first, separator)
    for k, line in rows:
        if _cells(line, separator) != count:
            Place(f"{place}: line {k}").refuse(text=f"{_cells(line, separator)} cells", expected=str(count))
    if not rows:
        place.refuse(text="holds no rows", expected="numbers below the header")
    labels = [names[k] for k in chosen]
    try:
        values = np.loadtxt([line for _, line in rows], delimiter=separator, usecols=chosen, ndmin=2, comments=None)
    except (ValueError, OverflowError, IndexError) as error:
        for k, line in rows:  # slow, but only on the way to an error that names the cell
            cells = line.split(separator)
            for column, label in zip(chosen, labels, strict=True):
                if _number(cells[column]) is None:
                    Place(f"{place}: line {k}").refuse(label, cells[column].strip()[:40], "a number")
        place.refuse(text=str(error))
    return values, labels


def _has_numbers(line: str) -> bool:
    return any(_number(cell) is not None for cell in re.split(r"[;,\s]+", line.lstrip("# \t")))


def _cells(line: str, separator: str | None) -> int:
    return len(line.split()) if separator is None else line.count(separator) + 1


def _number(cell: str) -> float | None:
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None


def _index(column: str | int, names: Sequence[str], has_header: bool, place: Place) -> int:
    if isinstance(column, int):
        if not 1 <= column <= len(names):
            place.refuse(text=f"column {column}", expected=f"a number from 1 to {len(names)}")
        return column - 1
    if not has_header:
        problem = f"column {column!r}: no header line names it; expected numbers from 1 to {len(names)}"
        place.refuse(text=problem)
    if names.count(column) != 1:
        found = "is not there" if column not in names else f"is there {names.count(column)} times"
        place.refuse(text=f"column {column!r} {found}", expected=f"one of {listed(names)}")
    return names.index(column)
