"""Tables of records for Python: parameters, tests, assumptions, torque errors, differences.

A table is a tuple of its records. Texts and notebooks show it by the renderers of reports.
"""

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from functools import reduce
from importlib import import_module
from io import StringIO
from typing import Any, SupportsIndex, overload

from acquisition.errors import BadInputError, Location, listed

from .document import Cell, Document, Number, Section, T, Table, known, value_form
from .renderers import print_whole, to_html


class Shown:
    """A result that a text and a notebook show by its `document`."""

    document: Any

    def __repr__(self) -> str:
        file = StringIO()
        print_whole(self.document, short=True, file=file)
        return file.getvalue().rstrip()

    def _repr_html_(self) -> str:
        return to_html(self.document)


class Records(Shown, tuple[T, ...]):
    """A table of records, each found by its position or by its name.

    `table[0]` is the first record, `table["Fv1"]` the one named `Fv1`, and `"Fv1" in table` is
    true if there is one. The columns are attributes of the records: `table["Fv1"].value`.

    Attributes:
        title: what the records are.
        columns: the columns with the formats of their numbers. The first one names the records.
            Numbers with an empty format have the decimals of their standard error. A column without
            a format is in `to_dict` and `to_dataframe` only.
    """

    title: str
    columns: Mapping[str, str | None]

    def __new__(
        cls, records: Iterable[T] = (), title: str = "", columns: Mapping[str, str | None] = {}
    ) -> "Records[T]":
        """Make a table of records."""
        table = super().__new__(cls, records)
        table.title, table.columns = title, columns
        return table

    @overload
    def __getitem__(self, key: str | SupportsIndex) -> T: ...
    @overload
    def __getitem__(self, key: slice) -> "Records[T]": ...
    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, str):
            (column, names), *_ = self.to_dict().items()
            Location(self.title).require(
                key in names, column, key, listed(get_close_matches(key, names, 6) or names)
            )
            key = names.index(key)
        found = super().__getitem__(key)
        return Records(found, self.title, self.columns) if isinstance(key, slice) else found

    def __contains__(self, key: object) -> bool:
        return super().__contains__(key) or key in next(iter(self.to_dict().values()))

    @property
    def document(self) -> Document:
        """The table as a report."""
        cells = {
            name: [
                _cell(value, self.columns[name] or value_form(getattr(record, "spread", 0.0)))
                for record, value in zip(self, values, strict=True)
            ]
            for name, values in self.to_dict().items()
            if self.columns[name] is not None
        }
        return Document(
            title=self.title,
            sections=(
                Section(
                    table=Table(
                        columns=tuple(
                            (name, any(isinstance(x, Number) for x in column))
                            for name, column in cells.items()
                        ),
                        rows=tuple(zip(*cells.values(), strict=True)),
                    )
                ),
            ),
        )

    def to_dict(self) -> dict[str, list[Any]]:
        """Return the columns by name. A value that is missing is None."""
        return {
            # of `a.value`, first the attribute `a`, which may be None
            name: [
                known(reduce(lambda x, part: x and getattr(x, part), name.split("."), record))
                for record in self
            ]
            for name in self.columns
        }

    def to_dataframe(self) -> Any:
        """Return the table as a `pandas.DataFrame`.

        Raises
        ------
        BadInputError : pandas is not installed; `to_dict` works without it.
        """
        try:
            return import_module("pandas").DataFrame(self.to_dict())
        except ImportError as error:
            raise BadInputError(
                "to_dataframe needs pandas, which is not installed",
                advice="Run `pip install pandas`, or use `to_dict`",
            ) from error


def _cell(value: Any, form: str) -> Cell:
    return (
        "yes" * value
        if isinstance(value, bool)
        else value
        if isinstance(value, str)
        else Number(value, form)
    )
