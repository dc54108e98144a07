"""Columns of numbers from CSV and MAT files, without units or meaning."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import AcquisitionError, listed
from .mat import read_variables

Array = Array


def read_columns(path: Path, columns: Sequence[str | int], count: int) -> Array:
    """The asked columns of a table, side by side: (N, number of columns), in the units of the file.

    A string names a column of a CSV file's header line, or a variable of a MAT file (see `mat`): there one name may give
    several of the `count` columns that are expected. A number is a place in a CSV file, from 1. CSV cells are parted by
    comma, semicolon, tab or blanks, as found in the first line; lines beginning with # are skipped, except a header.

    Raises `AcquisitionError` when the file cannot be read, a column is not there, or a cell is not a finite number.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise AcquisitionError(f"{path}: cannot be read: {error.strerror}") from error
    if data.startswith((b"MATLAB 7.3", b"\x89HDF")):
        raise AcquisitionError(f"{path}: a MAT file of version 7.3 (HDF5): expected version 7; save it with -v7")
    if data.startswith(b"MATLAB") or path.suffix.lower() == ".mat":
        values, labels = read_variables(data, columns, count, str(path))
    else:
        values, labels = _csv(data, columns, str(path))
    finite = np.isfinite(values)
    if not finite.all():
        row, column = np.argwhere(~finite)[0]
        raise AcquisitionError(
            f"{path}: row {row + 1}: {labels[column]} = {values[row, column]}: expected a finite number"
        )
    return values


def _csv(data: bytes, columns: Sequence[str | int], place: str) -> tuple[Array, list[str]]:
    text = data.decode("utf-8-sig", errors="replace").replace('"', "")
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip()]
    if not lines:
        raise AcquisitionError(f"{place}: holds no lines: expected a table")
    first = lines[0][1].lstrip("# \t")
    separator = next((mark for mark in ";\t," if mark in first), None)
    names = [cell.strip() for cell in first.split(separator)]
    has_header = any(_number(cell) is None for cell in names)
    rows = [(k, line) for k, line in lines[has_header:] if not line.startswith("#")]
    places = [_place(column, names if has_header else None, len(names), place) for column in columns]
    count = _cells(first, separator)
    for k, line in rows:
        if _cells(line, separator) != count:
            raise AcquisitionError(f"{place}: line {k}: {_cells(line, separator)} cells: expected {count}")
    if not rows:
        raise AcquisitionError(f"{place}: holds no rows: expected numbers below the header")
    labels = [names[p] if has_header else f"column {p + 1}" for p in places]
    try:
        values = np.loadtxt([line for _, line in rows], delimiter=separator, usecols=places, ndmin=2, comments=None)
    except (ValueError, OverflowError, IndexError) as error:
        for k, line in rows:  # slow, but only on the way to an error that names the cell
            cells = line.split(separator)
            for p, label in zip(places, labels, strict=True):
                if _number(cells[p]) is None:
                    raise AcquisitionError(
                        f"{place}: line {k}: {label} = {cells[p].strip()[:40]!r}: expected a number"
                    ) from error
        raise AcquisitionError(f"{place}: {error}") from error
    return values, labels


def _cells(line: str, separator: str | None) -> int:
    return len(line.split()) if separator is None else line.count(separator) + 1


def _number(cell: str) -> float | None:
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None


def _place(column: str | int, names: Sequence[str] | None, count: int, place: str) -> int:
    if isinstance(column, int):
        if not 1 <= column <= count:
            raise AcquisitionError(f"{place}: column {column}: expected a number from 1 to {count}")
        return column - 1
    if names is None:
        raise AcquisitionError(
            f"{place}: column {column!r}: no header line names it; expected numbers from 1 to {count}"
        )
    if names.count(column) != 1:
        found = "is not there" if column not in names else f"is there {names.count(column)} times"
        raise AcquisitionError(f"{place}: column {column!r} {found}: expected one of {listed(names)}")
    return names.index(column)
