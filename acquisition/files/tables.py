"""Columns of numbers from CSV and MAT files (version 7 or older), in the units of the file.

The module also formats numbers as text, and writes columns.
"""

import io
import re
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Array
from ..errors import BadInputError, Location, listed
from .whole import atomic_write, read_bytes

# Masses, lengths and inertias of robots are larger than this in SI, so smaller numbers are
# rounding.
MAX_ROUNDING = 1e-18
# A variable or a field, with optional columns or rows in MATLAB's notation: `data.q`, `q(:,2)`,
# `data.q(1:6,:)`.
_NAME = re.compile(
    r"(?P<path>[^()\s]+)(?:\(\s*(?P<rows>:|\d+(?::\d+)?)\s*,\s*(?P<columns>:|\d+(?::\d+)?)\s*\))?"
)
# If a cell has a decimal point, commas in the same table are not decimal ones.
_POINT = re.compile(r"(?:^|[;\t ])[-+]?\d*\.\d+(?:e[-+]?\d+)?(?:[;\t ]|$)", re.IGNORECASE)


def format_numbers(*values: float) -> str:
    """Format numbers with all digits, separated by blanks; rounding errors of zero become zero."""
    return " ".join(repr(float(x) if abs(x) > MAX_ROUNDING else 0.0) for x in values)


def read_columns(path: Path, columns: Sequence[str | int], count: int) -> Array:
    """Read columns of a table as numbers (N, count), in the units of the file.

    In CSV files cells are separated by comma, semicolon, tab or blanks, as in the first line; other
    commas are decimal ones. Lines that begin with # are skipped, but the last one above the numbers
    may be the header. Below the header, lines without numbers are skipped. In an export of TwinCAT
    Scope the names of the channels are the header.

    Parameters
    ----------
    path : CSV or MAT file (version 7 or older).
    columns : of a CSV file, names in the header line or numbers from 1. Of a MAT file, variables,
        or fields of structs by dotted name; `(:,k)`, `(:,k:l)`, `(k,:)` or `(k:l,:)` after a name
        selects columns or rows, and one name may give several columns.
    count : number of columns in all.

    Raises
    ------
    BadInputError : the file cannot be read, a column does not exist, or a cell is not a finite
        number. `place` is the file and the line or row.
    """
    data, place, is_mat = _read(path)
    values, labels = (_mat_columns if is_mat else _csv_columns)(data, columns, count, place)
    finite = np.isfinite(values)
    if not finite.all():
        row, column = np.argwhere(~finite)[0]
        Location(f"{path}: row {row + 1}").refuse(
            labels[column], float(values[row, column]), "a finite number"
        )
    return values


def write_columns(path: Path, names: Sequence[str], parts: Iterable[Array]) -> None:
    """Write a CSV file atomically; `read_columns` reads the same bits.

    Parameters
    ----------
    path : file to write.
    names : names of the columns.
    parts : consecutive rows, (k, columns) each.
    """
    with atomic_write(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.write(",".join(names) + "\n")
        for values in parts:
            np.savetxt(file, values, delimiter=",", fmt="%.17g")


@dataclass(frozen=True, kw_only=True)
class TableColumn:
    """A column of a table.

    Attributes:
        key: name or number for `read_columns`.
        name: name in the header; empty without one.
        x: first numbers; nan for text.
        texts: distinct texts of a column of texts.
    """

    key: str | int
    name: str
    x: Array
    texts: tuple[str, ...] = ()


def scan_table(path: Path, rows: int) -> list[TableColumn]:
    """Scan the columns of a CSV or MAT file, with their first `rows` numbers.

    Raises
    ------
    BadInputError : the file cannot be read.
    """
    data, place, is_mat = _read(path)
    if is_mat:
        return _scan_mat(data, rows, place)
    names, has_header, separator, lines = _parse_csv(data, place)
    cells = [[_number(cell) for cell in line.split(separator)] for _, line in lines[:rows]]
    return [
        TableColumn(
            key=name if has_header and name and names.count(name) == 1 else k + 1,
            name=name if has_header else "",
            x=x,
            texts=tuple(dict.fromkeys(line.split(separator)[k].strip() for _, line in lines))
            if None in (row[k] for row in cells)
            else (),
        )
        for k, (name, x) in enumerate(zip(names, np.array(cells, np.float64).T, strict=True))
    ]


def _read(path: Path) -> tuple[bytes, Location, bool]:
    """Return the bytes of a table, its place in errors, and whether it is a MAT file."""
    place = Location(str(path))
    data = read_bytes(path)
    place.require(
        not data.startswith((b"MATLAB 7.3", b"\x89HDF")),
        text="this MAT file has the version 7.3 (HDF5)",
        advice="Save it with -v7",
    )
    return data, place, data.startswith(b"MATLAB") or path.suffix.lower() == ".mat"


def _parse_csv(
    data: bytes, place: Location
) -> tuple[list[str], bool, str | None, list[tuple[int, str]]]:
    """Split a CSV file into names and rows.

    Returns the names, whether there is a header, the separator (None: blanks), and the rows with
    their line numbers. Decimal commas become points.
    """
    # UTF-16 files have a byte order mark.
    text = data.decode(
        "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig", errors="replace"
    )
    if "\N{REPLACEMENT CHARACTER}" in text:
        # Windows in western Europe writes this encoding.
        text = data.decode("cp1252", errors="replace")
    text = text.replace('"', "")
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip()]
    place.require(lines, text="the file is empty")
    while len(lines) > 1 and lines[0][1].startswith("#") and not _has_numbers(lines[1][1]):
        # The first line is a remark above the header.
        del lines[0]
    scope = [
        i for i, (_, line) in enumerate(lines) if line.startswith(("Name\t", "Name;", "Name,"))
    ]
    # An export of TwinCAT Scope begins with names of the project and of the channels, and other
    # texts about them.
    if len(scope) == 2:
        k, names_of_channels = lines[scope[1]]
        lines = [
            (k, re.sub(r"(?:^|(?<=[\t;,]))Name(?=[\t;,])", "Time [ms]", names_of_channels)),
            *((k, line) for k, line in lines[scope[1] :] if not line[0].isalpha()),
        ]
    first = lines[0][1].lstrip("# \t")
    separator = next((mark for mark in ";\t," if mark in first), None)
    rows = [lines[0], *((k, line) for k, line in lines[1:] if not line.startswith("#"))]
    if separator != "," and "," in text and not any(_POINT.search(line) for _, line in rows[1:]):
        rows = [(k, line.replace(",", ".")) for k, line in rows]
    # A text above a number belongs to a header; a text above a text may be the name of a joint.
    below = next((line for _, line in rows[1:] if _has_numbers(line)), "").split(separator)
    above = rows[0][1].lstrip("# \t").split(separator)
    has_header = any(
        _number(x) is None and _number(under) is not None
        for x, under in zip(above, below + ["0"] * len(above), strict=False)
    )
    names = [
        cell.strip() if has_header else f"column {k}"
        for k, cell in enumerate(first.split(separator), 1)
    ]
    rows = rows[has_header or first != lines[0][1] :]
    while has_header and len(rows) > 1 and not _has_numbers(rows[0][1]):
        # This row below the header has units or types.
        del rows[0]
    for k, line in rows:
        found = len(line.split()) if separator is None else line.count(separator) + 1
        # This runs for each of many lines, so the message is only made for a wrong one.
        if found != len(names):
            Location(f"{place}: line {k}").refuse(
                text=f"it has {found} cells, but line {lines[0][0]}, the column names, has "
                f"{len(names)}",
                advice="Delete lines above the column names",
            )
    place.require(rows, text="the table has no numbers below its header")
    return names, has_header, separator, rows


def _csv_columns(
    data: bytes, columns: Sequence[str | int], _count: int, place: Location
) -> tuple[Array, list[str]]:
    names, has_header, separator, rows = _parse_csv(data, place)
    chosen = [_index(column, names, has_header, place) for column in columns]
    labels = [names[k] for k in chosen]
    try:
        values = np.loadtxt(
            [line for _, line in rows], delimiter=separator, usecols=chosen, ndmin=2, comments=None
        )
    except (ValueError, OverflowError, IndexError) as error:
        # This loop is slow, but it only runs for an error, to name the cell.
        for k, line in rows:
            cells = line.split(separator)
            for column, label in zip(chosen, labels, strict=True):
                Location(f"{place}: line {k}").given(
                    _number(cells[column]), label, cells[column].strip()[:40], "a number"
                )
        place.refuse(text=str(error))
    return values, labels


def _has_numbers(line: str) -> bool:
    return any(_number(cell) is not None for cell in re.split(r"[;,\s]+", line.lstrip("# \t")))


def _number(cell: str) -> float | None:
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None


def _index(column: str | int, names: Sequence[str], has_header: bool, place: Location) -> int:
    if isinstance(column, int):
        place.require(
            1 <= column <= len(names),
            text=f"column {column} does not exist",
            expected=f"1 to {len(names)}",
        )
        return column - 1
    place.require(
        has_header,
        text=f"column {column!r} does not exist: the file has no header line",
        advice=f"Give numbers of columns, 1 to {len(names)}",
    )
    found = "does not exist" if column not in names else f"exists {names.count(column)} times"
    place.require(
        names.count(column) == 1,
        text=f"column {column!r} {found}",
        expected=f"one of {listed(names)}",
    )
    return names.index(column)


def _mat_columns(
    data: bytes, names: Sequence[str | int], count: int, place: Location
) -> tuple[Array, list[str]]:
    """Return the named parts of a MAT file as columns (N, count), and a label for each column."""
    # Matrices may be samples by joints or joints by samples. The number of samples is the one for
    # which all parts have the same length and `count` columns in all.
    matches = [_NAME.fullmatch(str(name)) for name in names]
    variables = _load(data, place, [match["path"].split(".")[0] for match in matches if match])
    parts = []
    for name, match in zip(names, matches, strict=True):
        found = None if match is None else _walk(variables, match["path"], place)
        if found is None or match is None:
            place.refuse(
                text=f"variable {name!r} does not exist", expected=f"one of {_present(data, place)}"
            )
        parts.append(_part(found, match, place))
    rows, rest = divmod(sum(part.size for part, _ in parts), count)
    fits = [rows in (part.shape[:1] if upright else part.shape) for part, upright in parts]
    sizes = [f"{name} {_size(part)}" for name, (part, _) in zip(names, parts, strict=True)]
    place.require(
        rows >= 2 and not rest and all(fits),
        text=f"the variables do not fit together: {', '.join(sizes)}",
        expected=f"variables of one length, {count} columns in all",
    )
    for name, (part, upright), shown in zip(names, parts, sizes, strict=True):
        Location(f"{place}: {shown}").require(
            part.shape != (rows, rows) or upright,
            text="its samples may be rows or columns",
            advice=f"Write '{name}(:,1:{rows})' if rows are samples, '{name}(1:{rows},:)' if "
            "columns are",
        )
    turned = [part if len(part) == rows else part.T for part, _ in parts]
    return np.hstack(turned), [
        str(name) if part.shape[1] == 1 else f"{name}(:,{k})"
        for name, part in zip(names, turned, strict=True)
        for k in range(1, part.shape[1] + 1)
    ]


def _load(data: bytes, place: Location, names: Sequence[str] | None = None) -> dict[str, Any]:
    """Load the variables with these names (default: all).

    Others are not read, because objects of MATLAB's classes cannot be read.
    """
    import scipy.io

    try:
        with warnings.catch_warnings():
            # scipy warns about variables that are not read.
            warnings.simplefilter("ignore")
            return dict(
                scipy.io.loadmat(io.BytesIO(data), variable_names=names and [*dict.fromkeys(names)])
            )
    # For a damaged file, scipy raises errors of any kind.
    except Exception as error:
        place.refuse(text=f"the MAT file cannot be read: {error or type(error).__name__}")


def _walk(variables: dict[str, Any], path: str, place: Location) -> Any:
    """Return the value of a dotted name; None if it does not exist."""
    top, *fields = path.split(".")
    value, at = variables.get(top), top
    for field in fields:
        if not isinstance(value, np.ndarray) or field not in (value.dtype.names or ()):
            return None
        place.require(
            value.size == 1,
            text=f"variable {at!r} is an array of {value.size} structs",
            expected="one struct",
        )
        value, at = value[field].flat[0], f"{at}.{field}"
    return value


def _part(value: Any, match: re.Match[str], place: Location) -> tuple[Array, bool]:
    """Return the matrix that a name selects.

    Also return whether the name shows that the rows of the matrix are samples.
    """
    name = match.string
    if (
        not isinstance(value, np.ndarray)
        or value.dtype.kind not in "fiu"
        or np.squeeze(value).ndim > 2
    ):
        kind = (
            type(value).__name__
            if not isinstance(value, np.ndarray)
            else f"a struct or object with the fields {listed(value.dtype.names)}"
            if value.dtype.names
            else f"{value.dtype} of shape {value.shape}"
        )
        place.refuse(
            text=f"variable {name!r} is {kind}", expected="a vector or matrix of real numbers"
        )
    # Dimensions of size one are removed, such as the second of 6 x 1 x N.
    matrix = (value if value.ndim == 2 else np.squeeze(value)).astype(np.float64)
    matrix = matrix if matrix.ndim == 2 else matrix.reshape(-1, 1)
    if match["rows"] is None:
        return matrix, False
    by_column = match["rows"] == ":"
    place.require(
        by_column != (match["columns"] == ":"),
        text=f"variable {name!r} selects neither columns nor rows",
        expected="(:,k) for columns, or (k,:) for rows",
    )
    first, _, last = match["columns" if by_column else "rows"].partition(":")
    low, high, size = int(first), int(last or first), matrix.shape[1 if by_column else 0]
    place.require(
        1 <= low <= high <= size,
        text=f"variable {name!r} exceeds the matrix, which is {_size(matrix)}",
        expected=f"1 to {size}",
    )
    return matrix[:, low - 1 : high] if by_column else matrix[low - 1 : high].T, True


def _size(part: Array) -> str:
    return " x ".join(str(size) for size in part.shape)


def _present(data: bytes, place: Location) -> str:
    """Return the names of a file's variables and of the fields of its structs, for an error."""
    try:
        return listed([*_leaves(_load(data, place))])
    # scipy cannot skip objects of MATLAB's classes.
    except BadInputError:
        return "the variables of the file (not listed, because one of them is an object)"


def _leaves(variables: dict[str, Any]) -> dict[str, Any]:
    """Return the variables, and for structs their fields by dotted name."""
    structs = {
        name: {f"{name}.{field}": value[field].flat[0] for field in value.dtype.names}
        for name, value in variables.items()
        if isinstance(value, np.ndarray) and value.dtype.names and value.size == 1
    }
    return {
        path: leaf
        for name, value in variables.items()
        if not name.startswith("__") and name != "None"  # objects have no name
        for path, leaf in (_leaves(structs[name]) if name in structs else {name: value}).items()
    }


def _scan_mat(data: bytes, rows: int, place: Location) -> list[TableColumn]:
    """Return vectors and columns of matrices that have the usual length, and texts.

    The usual length is the one that most variables have.
    """
    leaves = {name: np.squeeze(value) for name, value in _leaves(_load(data, place)).items()}
    numbers = {name: np.atleast_2d(x) for name, x in leaves.items() if x.dtype.kind in "fiu"}
    lengths = [max(x.shape) for x in numbers.values() if x.ndim == 2]
    length = max(lengths, key=lambda length: (lengths.count(length), length), default=0)
    # The name of the only variable does not describe its columns.
    only = len({name.partition(".")[0] for name in leaves}) == 1
    sides = {
        name: x.shape.index(length)
        for name, x in numbers.items()
        if x.shape.count(length) == 1 and x.ndim == 2
    }
    return [
        TableColumn(
            key=key, name=key.partition(".")[2] if only else key, x=column[:rows].astype(np.float64)
        )
        for name, side in sides.items()
        for k, column in enumerate(np.moveaxis(numbers[name], side, 1), 1)
        for key in [
            name if 1 in numbers[name].shape else f"{name}({k},:)" if side else f"{name}(:,{k})"
        ]
    ] + [
        TableColumn(key=key, name=f"{key}_{k}", x=np.array([np.nan]), texts=(str(text).strip(),))
        for key, x in leaves.items()
        if x.dtype.kind in "OU"
        for k, cell in enumerate(x.flat, 1)
        for text in np.ravel(cell)[:1]
    ]
