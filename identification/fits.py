"""Fits from Python: one that was made, or one that was read, by the content of its JSON file."""

import os
import warnings
from collections.abc import Sequence
from pathlib import Path

from msgspec import UnsetType, structs
from numpy.typing import ArrayLike

from acquisition.errors import Location
from acquisition.files import write_text

from . import export, report, results, view
from .arrays import Array
from .data import Signals, load_signals
from .model import BaseParameters, InverseModel, base_parameters
from .options import Overrides

File = str | os.PathLike[str]
Out = File | None


class Fit:
    """A fit: base parameters of a robot, the results of the tests, and methods that use it.

    `fit["Fv1"]` is a parameter. `parameters`, `trust`, `assumed`, `errors` and `compare` are tables
    of records, which are found by position and by name: `fit.trust["delay"]`. A table has
    `to_dict()` and `to_dataframe()`. A notebook shows a fit as its short report.

    Attributes:
        file: content of the JSON file.
        place: name of the fit in errors and in exported files.
        evidence: the data of the fit, with iterations, rows and simulated robot; None if the fit
            was read from a file.
    """

    def __init__(
        self, file: report.FitFile, place: str, evidence: results.Evidence | None = None
    ) -> None:
        self.file, self.place, self.evidence = file, place, evidence

    @classmethod
    def of(cls, evidence: results.Evidence) -> "Fit":
        """Return a `Fit` of a solution with its tests, as `results.identify` returns it."""
        return cls(results.fit_file(evidence), evidence.problem.signals.recording, evidence)

    def __repr__(self) -> str:
        return f"Fit({self.file.summary})"

    def __getitem__(self, name: str) -> report.Parameter:
        return self.parameters[name]

    def __contains__(self, name: object) -> bool:
        return name in self.parameters

    @property
    def verdict(self) -> report.Verdict | UnsetType:
        """Worst level of all tests: `trust`, `caution` or `do not use`.

        It is unset in a file of an earlier version.
        """
        return self.file.verdict

    @property
    def assumed(self) -> report.Records[report.Assumed]:
        """Assumptions that no test confirms, each with `what`, `value` and `why`."""
        return report.Records(
            self.file.assumed or (),
            "Assumptions that no test confirms",
            {"what": "", "value": "", "why": ""},
        )

    @property
    def trust(self) -> report.Records[report.TrustResult]:
        """Results of the tests, worst first, each with `test`, `level`, `value` and `text`."""
        return report.Records(
            self.file.trust or (),
            "Tests",
            {"test": "", "level": "", "value": None, "expected": None, "text": "", "advice": ""},
        )

    @property
    def status(self) -> str:
        """Status of the method.

        It is `solved` after least squares, and `converged`, `not_confirmed`, `max_iterations` or
        `diverged` after IV.
        """
        return self.file.status or ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the recordings and the settings."""
        return tuple(self.file.warnings)

    @property
    def errors(self) -> report.Records[report.TorqueResidual]:
        """Torque errors of each joint and, last, of all joints, percent of the torque."""
        return self.file.errors

    @property
    def parameters(self) -> report.Records[report.Parameter]:
        """Fitted parameters.

        Each has a `name`, `meaning`, `value`, `unit`, 95 % interval `low` to `high`, its
        `half_width`, `expression` and `essential`.
        """
        joints = [joint.name for joint in self.file.joints]
        return report.Records(
            (
                structs.replace(p, meaning=report.meaning_of(p.name, joints))
                for p in self.file.parameters
            ),
            "Parameters with 95 % intervals",
            {
                "name": "",
                "meaning": "",
                "value": "",
                "half_width": "",
                "low": None,
                "high": None,
                "unit": "",
                "expression": None,
                "essential": "",
            },
        )

    @property
    def base(self) -> BaseParameters:
        """Base parameters of the robot with `names`, `units` and `expressions`, fitted or not."""
        return (
            base_parameters(InverseModel(results.stored_robot(self.file, self.place)))
            if self.evidence is None
            else self.evidence.base
        )

    @property
    def beta(self) -> Array:
        """Values of all base parameters, shape (b,), in the order and units of `base`.

        The value is 0 for parameters that were not fitted. Per-recording parameters have the values
        of the first recording, or their means in a fit that was read.
        """
        return (
            results.stored_beta(self.file, self.base, self.place)
            if self.evidence is None
            else self.evidence.beta
        )

    @property
    def t_s(self) -> Array:
        """Times of the rows of all recordings, shape (rows,), s.

        Each recording begins at 0; the recordings are in the order given.
        """
        return self._made().t_s

    def residuals(self) -> Array:
        """Return the measured minus the predicted torque in the decimated rows.

        Returns
        -------
        Residuals, shape (rows, n), N m or N, at the times `t_s`, with rows of zero weight too.

        Raises
        ------
        BadInputError : the fit was read from a file, which has no rows.
        """
        return self._made().tau - self._made().tau_predicted

    def predict(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike) -> Array:
        """Return the torque of the model without payload along a motion.

        Parameters
        ----------
        q : joint positions, shape (rows, n), rad or m.
        dq : joint speeds, shape (rows, n), rad/s or m/s.
        ddq : joint accelerations, shape (rows, n), rad/s² or m/s².

        Returns
        -------
        Joint torques, shape (rows, n), N m, or forces, N.

        Raises
        ------
        BadInputError : the arrays have other shapes.
        """
        return results.stored_torque(self.file, self.place, q, dq, ddq)

    def compare(self, other: "Fit") -> report.Records[report.Difference]:
        """Compare the parameters with those of another fit; warn if the link frames differ.

        Parameters
        ----------
        other : the other fit.

        Returns
        -------
        One difference per parameter: `name`, `unit`, the parameters `a` and `b` of both fits, `off`
            = a - b, `off_percent` in percent of b, and `off_sigma` in standard errors of the
            difference.

        Raises
        ------
        BadInputError : the fits have no parameter in common, or have other units.
        """
        for line in report.frame_lines(self.file, other.file, ("this fit", "the other")):
            warnings.warn(line, stacklevel=2)
        return report.Records(
            report.differences(
                report.ParameterSet.of_file(self.file, "this fit"),
                report.ParameterSet.of_file(other.file, "the other"),
            ),
            "Differences of this fit (a) from the other (b)",
            {
                "name": "",
                "unit": "",
                "a.value": "",
                "a.half_width": "",
                "b.value": "",
                "b.half_width": "",
                "off": "",
                "off_percent": "+.1f",
                "off_sigma": "+.2f",
            },
        )

    def validate(
        self, recording: Signals | File, overrides: Overrides | None = None
    ) -> report.ValidationFile:
        """Compute the torque errors on a recording that the fit was not fitted to.

        Parameters, values and errors are those of `identification.validate`.
        """
        pair = (
            (recording, Path())
            if isinstance(recording, Signals)
            else (load_signals(recording), Path(recording))
        )
        each, errors, lines = results.predict_recordings(
            self.file, "the fit", [pair], overrides or Overrides(), chosen=pair[1] == Path()
        )
        return results.validation_file(each, "the fit", errors, lines)

    def export(
        self,
        *,
        urdf: Out = None,
        mjcf: Out = None,
        toml: Out = None,
        allow_untrusted: bool = False,
        draws: int = 0,
        seed: int = 1,
    ) -> str:
        """Write the fit as a URDF, a MuJoCo model and a robot.toml.

        After `consistent` the files contain the physically consistent parameters.

        Parameters
        ----------
        urdf : URDF to write.
        mjcf : MuJoCo model to write.
        toml : robot.toml to write, with the fitted `[parameters]` and drive gains.
        allow_untrusted : True to export a fit with the verdict `do not use`.
        draws : number of physically consistent models, drawn from the intervals of the fit, to
            write beside each file: `robot_01.xml` and so on beside `robot.xml`.
        seed : seed of the draws; the same one gives the same files.

        Returns
        -------
        A report in Markdown that says what each format cannot represent, and where the spread of
        the draws is narrower than the intervals.

        Raises
        ------
        BadInputError : the verdict is `do not use`, the fit is in A or V, or no physically
            consistent parameters exist.
        """
        return report.to_markdown(
            export.export_fit(
                self.file,
                self.place,
                untrusted=allow_untrusted,
                drawn=(draws, seed),
                urdf=Path(urdf) if urdf else None,
                mjcf=Path(mjcf) if mjcf else None,
                toml=Path(toml) if toml else None,
            )
        )

    def consistent(self, prior: File | None = None) -> "Fit":
        """Return the fit with the nearest physically consistent parameters of all links.

        The estimate itself does not change.

        Parameters
        ----------
        prior : robot.toml or URDF with a priori link parameters. Default: the description of the
            fit.

        Raises
        ------
        BadInputError : a drive gain is not known, the prior is of another robot, no physically
            consistent parameters are found, or the fit was read from a file.
        """
        found = (
            None
            if prior is None
            else results.read_prior(Path(prior), self._made().problem.signals.robot)
        )
        return Fit.of(results.with_consistent(self._made(), found))

    @property
    def document(self) -> report.Document:
        """Report of the fit; known parameters have none and raise `BadInputError`."""
        return results.fit_document(self.file)

    def save(self, path: File) -> None:
        """Write the JSON file of `robot-identify fit --json`, which `load` reads."""
        report.write_json(Path(path), self.file)

    to_json = save  # its earlier name

    def plot(self, log: File | None = None) -> view.Figures:
        """Draw the torque of each joint, and the 95 % intervals of the parameters.

        The torque is the measured one, that of the model, and their difference, in the first
        recording. A notebook shows the figures; `write_report` writes them, and more, as a page.

        Parameters
        ----------
        log : recording for the torques; a fit that was read has no others.

        Raises
        ------
        BadInputError : the fit has known parameters, or the recording is of another robot.
        """
        return view.notebook_figures(*self._picture(log).figures)

    def write_report(self, path: File, log: File | None = None) -> None:
        """Write the report: tables as .md, tables and plots as .html.

        Parameters
        ----------
        path : file to write.
        log : recording for the curves; a fit that was read has no others.

        Raises
        ------
        BadInputError : the ending is neither .md nor .html, or the fit has no report.
        """
        path = Path(path)
        Location(str(path)).require(
            path.suffix in (".md", ".html"), "ending", path.suffix, ".md or .html"
        )
        if path.suffix == ".md":
            write_text(path, report.to_markdown(self.document))
        else:
            view.write_html(path, self._picture(log))

    def write_rrd(self, path: File, log: File | None = None) -> None:
        """Write trajectories and fit as a Rerun file, or one file per recording, numbered from 1.

        Parameters
        ----------
        path : file to write.
        log : recording for the curves; required for a fit that was read.

        Raises
        ------
        BadInputError : the fit was read from a file and `log` is missing.
        """
        path, recordings = Path(path), self._recordings(log)
        for number, one in enumerate(recordings, start=1):
            view.write_rrd(
                path.with_stem(f"{path.stem}_{number}") if len(recordings) > 1 else path,
                view.draw_fit(self.file, one),
            )

    def _picture(self, log: File | None = None) -> view.Picture:
        """Draw the fit on its recordings, or on a `log`; without any, its tests and parameters."""
        recordings = self._recordings(log) if log is not None or self.evidence else (None,)
        return view.join_pictures([view.draw_fit(self.file, one) for one in recordings])

    def _recordings(self, log: File | None = None) -> Sequence[results.FitOnRecording]:
        """Return the recordings of the fit, or the fit on a `log`."""
        return (
            self._made().recordings
            if log is None
            else results.predict_recordings(
                self.file, self.place, [(load_signals(log), Path(log))], Overrides(), ahead=False
            )[0]
        )

    def _made(self) -> results.Evidence:
        return Location(self.place).given(
            self.evidence,
            text="was read from a file, which has no samples",
            advice="Pass its recording, or repeat the fit",
            arguments=("log",),
        )

    def _repr_html_(self) -> str:
        if not self.file.provenance:  # known parameters
            return self.parameters._repr_html_()
        picture = self._picture()
        return report.to_html(
            picture.document.short,
            figures={"": view.notebook_figures(picture.first or picture.figures[0])},
        )


def load(path: File) -> Fit:
    """Read a fit, or known values of parameters, from a JSON file.

    Parameters
    ----------
    path : file that `Fit.save` or `robot-identify fit --json` wrote.

    Returns
    -------
    The fit, without its rows and curves.

    Raises
    ------
    BadInputError : the file cannot be read, or is not a fit of this format.
    """
    return Fit(report.read_fit(path), str(path))
