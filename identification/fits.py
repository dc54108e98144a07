"""Fits from Python: what a fit in memory and a stored one have in common, by the
content of the JSON file.
"""

import os
import warnings
from functools import cached_property
from pathlib import Path
from typing import Any

from msgspec import UnsetType
from numpy.typing import ArrayLike

from . import export, report, results
from .arrays import Array
from .report import Assumed, Difference, FitFile, Number, Parameter, Verdict

File = str | os.PathLike[str]
Out = File | None


class Parameters(tuple[Parameter, ...]):
    """The parameters of a fit, in its order."""

    def to_dict(self) -> dict[str, list[Any]]:
        """Columns by name, as pandas takes them; `half_width` of the 95 % interval."""
        names = ("name", "value", "half_width", "low", "high", "unit", "expression", "essential")
        return {
            name: [getattr(p, "half" if name == "half_width" else name) for p in self]
            for name in names
        }


class AnyFit:
    """A fit: `file` has all keys of its JSON file, `place` is its name in errors
    and in what is exported.
    """

    file: cached_property[FitFile]
    place: cached_property[str]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.file.summary})"

    @property
    def verdict(self) -> Verdict | UnsetType:
        """`trust`, `caution` or `do not use`: the worst test; unset in a file
        of an earlier version.
        """
        return self.file.verdict

    @property
    def assumed(self) -> tuple[Assumed, ...]:
        """What no test covers: `what`, `value`, `why`."""
        return tuple(self.file.assumed or ())

    @property
    def parameters(self) -> Parameters:
        """The fitted parameters: `name`, `value`, 95 % interval `low` to `high`, `unit`,
        `expression`, `essential`.
        """
        return Parameters(self.file.parameters)

    def predict(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike) -> Array:
        """(rows, n) torque, N m or N, of the model without payload along q, dq, ddq
        (rows, n), rad or m and s.
        """
        return results.stored_torque(self.file, self.place, q, dq, ddq)

    def compare(self, other: "AnyFit") -> tuple[Difference, ...]:
        """The differences of the parameters from those of another fit: `name`, `off`,
        `off_percent`, `off_sigma`.

        Warns where the link frames differ. Raises `BadInputError`: nothing in
        common, or other units.
        """
        for line in report.frame_lines(self.file, other.file, ("this fit", "the other")):
            warnings.warn(line, stacklevel=2)
        return tuple(
            report.differences(
                report.ParameterSet.of_file(self.file, "this fit"),
                report.ParameterSet.of_file(other.file, "the other"),
            )
        )

    def export(
        self, *, urdf: Out = None, mjcf: Out = None, toml: Out = None, allow_untrusted: bool = False
    ) -> str:
        """Write the fit as a URDF, a MuJoCo model and a robot.toml; those of
        `consistent` if it was called.

        Returns what each format cannot represent, as Markdown. Raises `BadInputError`: the verdict
        is `do not use` and not `allow_untrusted`; a fit in A or V; impossible parameters.
        """
        outputs = {"urdf": urdf, "mjcf": mjcf, "toml": toml}
        paths = {kind: Path(path) for kind, path in outputs.items() if path is not None}
        return report.to_markdown(
            export.export_fit(self.file, self.place, untrusted=allow_untrusted, **paths)
        )


class StoredFit(AnyFit):
    """A fit read from its JSON file `place`."""

    def __init__(self, path: File) -> None:
        self.file, self.place = report.read_fit(path), str(path)

    def _repr_html_(self) -> str:
        from .view import deviation_charts, notebook_figure

        best = sorted(self.parameters, key=lambda p: p.half / (abs(p.value) or 1.0))[:10]
        rows = [
            (p.name, p.unit, Number(p.value, report.value_form(p.spread)), Number(p.half, ".2g"))
            for p in best
        ]
        doubts = tuple(
            line.text for line in self.file.trust or () if line.level in ("do not use", "caution")
        )
        shown = report.Section(
            title=f"the {len(rows)} best known parameters",
            warnings=doubts,
            table=report.Table(
                columns=report.columns("name", "unit", numbers=("value", "±95%")),
                rows=tuple(rows),
            ),
        )
        document = report.Document(
            title=f"{self.place}: {self.file.summary}",
            badge=self.verdict or "",
            figures=results.main_figures(
                self.file.moving_relative_error_percent,  # in files of earlier versions too
                self.file.held_out_error_percent or None,
                {},
                results.half_width_percents(self.parameters),
            ),
            sections=(shown,),
        )
        (chart,) = deviation_charts(
            report.ParameterSet(label=self.place, parameters={p.name: p for p in best}), ()
        )
        return report.to_html(document) + notebook_figure(chart)
