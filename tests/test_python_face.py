"""The packages from Python: light to import, typed, a fit of arrays, results that say what they are."""

import ast
import html.parser
import re
import shutil
import subprocess
import sys
import textwrap
from dataclasses import replace
from unittest.mock import ANY

import msgspec
import numpy as np
import pytest
from conftest import REPLAY, ROOT, robot_named

import acquisition
import identification

SCARA = REPLAY / "scara" / "robot.toml"
PACKAGES = {"acquisition": acquisition, "identification": identification}


@pytest.fixture(scope="module")
def signals():
    """Simulated, so without a recording."""
    from identification.study import Noise, closed_loop, random_reference

    robot = robot_named("scara")
    q_ref = random_reference(robot, duration_s=4.0, sample_rate_hz=1000.0, seed=3)
    return closed_loop(
        robot, q_ref, 1000.0, noise=Noise(encoder_step=1e-5, effort_percent=2.0, recorded="tick"), seed=3
    )


@pytest.fixture(scope="module")
def by_iv(signals):
    return identification.fit(signals.q, signals.effort, 1000.0, SCARA, signals.q_ref)


def test_importing_loads_no_library():
    code = (
        "import sys, acquisition, identification; dir(identification); identification.IdentificationError\n"
        "rooms = [m for m in sys.modules if m.startswith(('acquisition.', 'identification.'))]\n"
        "print({'numpy', 'scipy', 'msgspec', 'pinocchio'} & set(sys.modules) or sorted(rooms))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "['acquisition.errors', 'acquisition.lazy', 'identification.errors']\n"


@pytest.mark.parametrize("package", PACKAGES)
def test_what_is_named_is_there_and_typed(package):
    module = PACKAGES[package]
    assert dir(module) == sorted(module.__all__)
    assert {getattr(module, name).__name__ for name in module.__all__} == set(module.__all__)
    tree = ast.parse((ROOT / package / "__init__.py").read_text())
    (typed,) = (n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING")
    stubs = {a.name for n in typed.body if isinstance(n, ast.ImportFrom) and n.level == 1 for a in n.names}
    own = {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}
    assert stubs | own == set(module.__all__)
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        module.nothing  # noqa: B018


@pytest.mark.parametrize("method", ["wls", "ols"])
def test_a_fit_of_arrays_is_that_of_the_same_signals(signals, method):
    fit = identification.fit(signals.q, signals.effort, 1000.0, str(SCARA), method=method)
    same = identification.identify_ls(
        replace(signals, q_ref=None, effort_timing="unknown"), identification.Overrides(), method=method
    )
    np.testing.assert_array_equal(fit.beta, same.beta)
    assert fit.method == method


def test_a_fit_of_arrays_finds_the_true_parameters(signals, by_iv):
    from identification.study import study_truth

    base, true = study_truth(signals.robot)
    assert (by_iv.status, by_iv.base.names, by_iv.iv.reference) == ("converged", base.names, "recorded")
    assert np.linalg.norm(by_iv.beta - true) < 0.01 * np.linalg.norm(true)
    without = identification.fit(signals.q, signals.effort, 1000.0, signals.robot)
    assert (by_iv.method, without.method) == ("iv", "wls")
    asked = identification.fit(signals.q, signals.effort, 1000.0, signals.robot, method="iv")
    assert asked.iv.reference == "surrogate"


def test_arrays_stay_what_they_are(signals):
    from identification.data import signals_from_arrays

    q, tau = np.array(signals.q), signals.effort.tolist()
    made = signals_from_arrays(q, tau, 1000.0, signals.robot, q)
    q[:] = 0.0
    np.testing.assert_array_equal(made.q, signals.q)
    np.testing.assert_array_equal(made.effort, signals.effort)
    np.testing.assert_allclose(made.t_s, np.arange(len(q)) / 1000.0)
    other = signals_from_arrays(signals.q, signals.effort, 1000.0, signals.robot)
    assert made.sha256 != other.sha256, "the reference is part of what was fitted"


@pytest.mark.parametrize(
    ("change", "place", "key", "value", "expected"),
    [
        ({"q": np.zeros(50)}, "arrays", "q.shape", (50,), "(N, 2), time first"),
        ({"q": np.zeros((2, 50))}, "arrays", "q.shape", (2, 50), "(N, 2), time first"),
        ({"q": [["a", "b"]] * 50}, "arrays", "q", None, "numbers of shape (N, 2)"),
        ({"tau": np.zeros((49, 2))}, "arrays", "effort.shape", (49, 2), "(50, 2), as q has"),
        ({"q_ref": np.zeros((51, 2))}, "arrays", "q_ref.shape", (51, 2), "(50, 2), as q has"),
        ({"tau": np.full((50, 2), np.inf)}, "arrays", "effort[0]", [np.inf, np.inf], "finite numbers"),
        ({"sample_rate_hz": 0.0}, "arrays", "sample_rate_hz", 0.0, "a number above 0"),
        ({"sample_rate_hz": -np.inf}, "arrays", "sample_rate_hz", -np.inf, "a number above 0"),
        ({"method": "ls"}, "", "method", "ls", "'iv', 'wls' or 'ols'"),
        ({"velocity": np.zeros((49, 2))}, "arrays", "velocity.shape", (49, 2), "(50, 2), as q has"),
        ({"known_torque": np.zeros((50, 1))}, "arrays", "known_torque.shape", (50, 1), "(N, 2), time first"),
        ({"feedforward": [[0, np.nan]] * 50}, "arrays", "feedforward[0]", ANY, "finite numbers"),
        ({"torque": np.zeros((50, 2))}, "arrays", "torque", None, "columns velocity, known_torque, feedforward"),
    ],
)
def test_what_cannot_be_fitted_is_refused(change, place, key, value, expected):
    given = {"q": np.zeros((50, 2)), "tau": np.zeros((50, 2)), "sample_rate_hz": 100.0, "robot": SCARA}
    with pytest.raises(identification.IdentificationError) as caught:
        identification.fit(**{**given, **change})
    error = caught.value
    assert (error.place, error.key, error.value, error.expected) == (place, key, value, expected)
    assert str(error).startswith(f"{place}: {key}" if place else key)
    assert str(error).endswith(f": expected {expected}")


def test_a_known_torque_is_explained_with_that_of_the_drives(signals):
    """One is taken off the drives' torque: the fit is the same if it is told, another if it is not."""
    known = np.sin(signals.t_s)[:, None] * [3.0, 1.0]
    unshifted = msgspec.structs.replace(
        signals.robot.identification, torque_lag_s="none"
    )  # of the drives' torque alone
    robot = replace(signals.robot, identification=unshifted)
    plain, told, untold = (
        identification.fit(signals.q, tau, 1000.0, robot, method="wls", known_torque=k).beta
        for tau, k in ((signals.effort, None), (signals.effort - known, known), (signals.effort - known, None))
    )
    np.testing.assert_allclose(told, plain, rtol=1e-9)
    assert np.abs(untold / plain - 1).max() > 0.1


def test_columns_beside_position_and_effort_are_copied_and_checked(signals):
    from identification.data import signals_from_arrays

    speed, ahead = np.gradient(signals.q, 1e-3, axis=0), np.array(signals.effort)
    fit = identification.fit(
        signals.q, signals.effort, 1000.0, SCARA, method="wls", velocity=0.8 * speed, feedforward=ahead
    )
    kept, before = fit.problem.signals, ahead.copy()
    ahead[:] = 0.0
    np.testing.assert_array_equal(kept.feedforward, before)
    np.testing.assert_array_equal(kept.velocity, 0.8 * speed)
    assert kept.known_torque is None
    warnings = [text for text in fit.warnings if "velocity" in text]
    assert [text.split(", ")[0] for text in warnings] == [
        f"recording: velocity of joint {name} = 0.8 x the derivative of its position" for name in ("shoulder", "elbow")
    ]
    right = signals_from_arrays(signals.q, signals.effort, 1000.0, signals.robot, velocity=speed)
    assert right.events == ()
    with pytest.raises(acquisition.AcquisitionError, match="arrays: velocity of joint shoulder = -1 x the derivative"):
        signals_from_arrays(signals.q, signals.effort, 1000.0, signals.robot, velocity=-speed)
    made = [
        signals_from_arrays(signals.q, signals.effort, 1000.0, signals.robot, **{name: before})
        for name in ("known_torque", "feedforward")
    ]
    assert made[0].sha256 != made[1].sha256, "the same numbers under another name are another recording"


def test_results_say_in_a_line_what_they_are(signals, by_iv):
    error, essential = by_iv.errors[-1].moving_relative_error_percent, len(by_iv.essential_names)
    assert (
        repr(by_iv)
        == f"Fit(SCARA, arrays, iv, converged: 8 parameters, {essential} essential, moving error {error:.3g} %)"
    )
    assert repr(signals).endswith(": SCARA, 4001 samples of 2 joints at 1000 Hz, with reference)")
    assert repr(acquisition.load_robot(str(SCARA))) == "Robot(SCARA: 2 joints, 2 drives)"
    recording = acquisition.read_recording(str(REPLAY / "scara" / "session.mcap"))
    assert repr(recording) == (
        f"Recording(SCARA: {len(recording.samples)} samples at 1000 Hz, {sum(map(len, recording.frames.values()))} CAN frames)"
    )
    loaded = identification.load_signals(str(REPLAY / "scara" / "session.mcap"))
    assert repr(loaded).startswith("Signals(session.mcap: SCARA, ")


class Page(html.parser.HTMLParser):
    """The texts of a page by their tags, those of table cells row by row; every tag must be closed."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.texts, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1].append(data)
        elif self.open:
            self.texts.append(data)


def test_a_notebook_shows_the_report_of_a_fit(signals):
    from identification.methods import fit_document

    robot = replace(signals.robot, name="<b>SCARA & Co")
    fit = identification.identify_ls(replace(signals, robot=robot), identification.Overrides())
    page, report = Page(fit._repr_html_()), fit_document(fit.problem.signals, fit)
    assert page.open == []
    assert page.texts[0] == report.title
    assert "<b>SCARA & Co" in report.title
    tables = [section.table for section in report.sections if section.table]
    shown = [row for table in tables for row in ([heading for heading, _ in table.columns], *table.rows)]
    assert page.rows == [
        [" ".join((x if isinstance(x, str) else x.text).split()) for x in row if x != ""] for row in shown
    ]
    for section in report.sections:
        lines = (*section.lines, *(f"warning: {text}" for text in section.warnings))
        assert {" ".join(text.split()) for text in lines} <= {*page.texts}


@pytest.mark.slow
def test_the_lines_of_the_readme_run(tmp_path, monkeypatch, capsys):
    section = (ROOT / "identification" / "README.md").read_text().split("## From Python\n")[1].split("\n## ")[0]
    lines = re.findall(r"(?:^ {4}.*\n|^\n(?= {4}))+", section, flags=re.MULTILINE)
    (block,) = (textwrap.dedent(part).strip() for part in lines if part.strip())
    assert len([line for line in block.splitlines() if line]) <= 5
    shutil.copy(REPLAY / "scara" / "session.mcap", tmp_path / "log.mcap")
    shutil.copy(SCARA, tmp_path / "robot.toml")
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "README", "exec"), {})
    told = capsys.readouterr().out
    assert told.startswith("Fit(SCARA, arrays, iv, converged: 8 parameters, ")
    assert "'ZZ1R': " in told


def test_a_fit_is_validated_from_python(signals, by_iv):
    settings, errors = identification.validate(signals, identification.Overrides(), lambda base: by_iv.beta)
    assert settings.decimation == by_iv.settings.decimation
    assert errors[-1].relative_error_percent == pytest.approx(by_iv.errors[-1].relative_error_percent, rel=0.05)
