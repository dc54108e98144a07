"""Columns of numbers out of MAT files of version 7 or older: variables, fields of structs, parts of matrices."""

import io
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Array
from ..errors import Place, listed

# `data.q`, `q(:,2)`, `data.q(1:6,:)`: a variable or a field, and perhaps some of its columns or rows as MATLAB writes it.
_NAME = re.compile(r"(?P<path>[^()\s]+)(?:\(\s*(?P<rows>:|\d+(?::\d+)?)\s*,\s*(?P<columns>:|\d+(?::\d+)?)\s*\))?")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    """The values of a name; `upright`: the name itself says that samples are the rows."""

    name: str
    values: Array
    upright: bool

    @property
    def label(self) -> str:
        return f"{self.name} {_size(self.values)}"


def read_variables(data: bytes, names: Sequence[str | int], count: int, place: Place) -> tuple[Array, list[str]]:
    """The named parts of a MAT file, side by side (N, count), and a label of each column."""
    # Matrices may be samples by joints or joints by samples: the number of samples is the one with which all parts have the
    # same length and `count` columns in all.
    asked = [_NAME.fullmatch(str(name)) for name in names]
    variables = _load(data, [match["path"].split(".")[0] for match in asked if match], place)
    parts = []
    for name, match in zip(names, asked, strict=True):
        found = None if isinstance(name, int) or match is None else _walk(variables, match["path"], place)
        if found is None or match is None:
            place.refuse(text=f"variable {name!r} is not there", expected=f"one of {_present(data)}")
        parts.append(_part(found, match, place))
    rows = sum(part.values.size for part in parts) // count
    fits = [rows in (part.values.shape[:1] if part.upright else part.values.shape) for part in parts]
    if rows < 2 or not all(fits) or sum(part.values.size for part in parts) != rows * count:
        label = ", ".join(part.label for part in parts)
        place.refuse(text=label, expected=f"variables of one length, {count} columns in all")
    for part in parts:
        if part.values.shape == (rows, rows) and not part.upright:
            expected = f"'{part.name}(:,1:{rows})' where rows are samples, '{part.name}(1:{rows},:)' where columns are"
            Place(f"{place}: {part.label}").refuse(text="rows and columns cannot be told apart", expected=expected)
    turned = [part.values if len(part.values) == rows else part.values.T for part in parts]
    labels = [
        part.name if columns.shape[1] == 1 else f"{part.name}(:,{k + 1})"
        for part, columns in zip(parts, turned, strict=True)
        for k in range(columns.shape[1])
    ]
    return np.hstack(turned), labels


def _load(data: bytes, names: Sequence[str], place: Place) -> dict[str, Any]:
    """The variables with these names. No others are read: objects of MATLAB's classes cannot be."""
    import scipy.io

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about variables that are not read
            return dict(scipy.io.loadmat(io.BytesIO(data), variable_names=list(dict.fromkeys(names))))
    except Exception as error:  # on a damaged file scipy's reader raises errors of any kind
        place.refuse(text=f"not a MAT file that can be read: {error or type(error).__name__}")


def _walk(variables: dict[str, Any], path: str, place: Place) -> Any:
    """The value of a dotted name; None where it does not exist."""
    top, *fields = path.split(".")
    value, at = variables.get(top), top
    for field in fields:
        if not isinstance(value, np.ndarray) or field not in (value.dtype.names or ()):
            return None
        if value.size != 1:
            place.refuse(text=f"variable {at!r} is an array of {value.size} structs", expected="one struct")
        value, at = value[field].flat[0], f"{at}.{field}"
    return value


def _part(value: Any, match: re.Match[str], place: Place) -> _Part:
    """The matrix that a name means. Dimensions of one, as of a signal of 6 x 1 x N, are left out."""
    name = match.string
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu" or np.squeeze(value).ndim > 2:
        kind = f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
        if isinstance(value, np.ndarray) and value.dtype.names:
            kind = f"a struct or object with the fields {listed(value.dtype.names)}"
        place.refuse(text=f"variable {name!r} is {kind}", expected="a vector or matrix of real numbers")
    matrix = (value if value.ndim == 2 else np.squeeze(value)).astype(np.float64)
    matrix = matrix if matrix.ndim == 2 else matrix.reshape(-1, 1)
    if match["rows"] is None:
        return _Part(name=name, values=matrix, upright=False)
    by_column = match["rows"] == ":"
    if by_column == (match["columns"] == ":"):
        place.refuse(text=f"variable {name!r}", expected="(:,k) for columns or (k,:) for rows")
    first, _, last = match["columns" if by_column else "rows"].partition(":")
    low, high, most = int(first), int(last or first), matrix.shape[1 if by_column else 0]
    if not 1 <= low <= high <= most:
        place.refuse(text=f"variable {name!r}: the matrix is {_size(matrix)}", expected=f"1 to {most}")
    part = matrix[:, low - 1 : high] if by_column else matrix[low - 1 : high].T
    return _Part(name=name, values=part, upright=True)


def _size(part: Array) -> str:
    return " x ".join(str(size) for size in part.shape)


def _present(data: bytes) -> str:
    """Names of a file's variables of numbers and of structs' fields, for an error."""
    import scipy.io

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            variables = scipy.io.loadmat(io.BytesIO(data))
    except Exception:  # scipy cannot skip objects of MATLAB classes
        return "the file's variables (they cannot be listed, because one of them is an object)"
    names: list[str] = []
    waiting = [(k, v) for k, v in variables.items() if not k.startswith("__") and k != "None"]  # objects have no name
    while waiting:
        name, value = waiting.pop(0)
        if isinstance(value, np.ndarray) and value.dtype.names and value.size == 1:
            waiting = [(f"{name}.{field}", value[field].flat[0]) for field in value.dtype.names] + waiting
        else:
            names.append(name)
    return listed(names)
