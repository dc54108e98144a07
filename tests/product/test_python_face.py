"""The packages from Python: light to import, typed, a fit of arrays, results
that say what they are.
"""

import doctest
import html.parser
import re
import shutil
import subprocess
import sys
import textwrap
import warnings
from dataclasses import replace
from pathlib import Path
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
        robot, q_ref, 1000.0, noise=Noise(encoder_step=1e-5, effort_percent=2.0), seed=3
    )


@pytest.fixture(scope="module")
def by_iv(signals):
    with warnings.catch_warnings(action="error"):
        return identification.fit(signals.q, signals.effort, 1000.0, SCARA, signals.q_ref)


def test_import_loads_no_library():
    code = (
        "import sys, acquisition, identification; dir(identification); "
        "identification.RobotIdimError\n"
        "rooms = [m for m in sys.modules if m.startswith(('acquisition.', 'identification.'))]\n"
        "print({'numpy', 'scipy', 'msgspec', 'pinocchio'} & set(sys.modules) or sorted(rooms))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == "['acquisition.errors', 'acquisition.lazy', 'identification.errors']\n"


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_exist(package):
    module = PACKAGES[package]
    assert dir(module) == sorted(module.__all__)
    assert {getattr(module, name).__name__ for name in module.__all__} == set(module.__all__)
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        module.nothing  # noqa: B018


def test_array_fit_finds_true_parameters(signals, by_iv):
    from identification.study import study_truth

    base, true = study_truth(signals.robot)
    assert (by_iv.status, by_iv.base.names, by_iv.file.reference) == (
        "converged",
        base.names,
        "recorded",
    )
    assert np.linalg.norm(by_iv.beta - true) < 0.01 * np.linalg.norm(true)
    without = identification.fit(signals.q, signals.effort, 1000.0, signals.robot)
    assert (by_iv.file.method, without.file.method) == ("iv", "wls")
    asked = identification.fit(signals.q, signals.effort, 1000.0, signals.robot, method="iv")
    assert asked.file.reference == "surrogate"


def test_arrays_are_copied_and_distinguished(signals):
    from identification.data import signals_from_arrays

    def made(*others, **columns):
        return signals_from_arrays(
            q, signals.effort.tolist(), 1000.0, signals.robot, *others, **columns
        )

    q, ahead = np.array(signals.q), np.array(signals.effort)
    one = made(q, feedforward=ahead)
    digests = [
        made(*others, **columns).sha256
        for others, columns in (((), {}), ((q,), {}), ((), {"feedforward": q}))
    ]
    digests.append(made(known_torque=q).sha256)
    assert len({*digests}) == 4, "the same numbers under another name are another recording"
    q[:] = ahead[:] = 0.0
    np.testing.assert_array_equal(one.q, signals.q)
    np.testing.assert_array_equal(one.q_ref, signals.q)
    np.testing.assert_array_equal(one.effort, signals.effort)
    np.testing.assert_array_equal(one.feedforward, signals.effort)
    np.testing.assert_allclose(one.t_s, np.arange(len(q)) / 1000.0)


RATE = "one rate in Hz, greater than 0"


@pytest.mark.parametrize(
    ("change", "place", "key", "value", "expected"),
    [
        ({"q": np.zeros(50)}, "arrays", "q.shape", (50,), "(N, 2), one row per sample"),
        ({"q": [["a", "b"]] * 50}, "arrays", "q", None, "numbers of shape (N, 2)"),
        ({"tau": np.zeros((49, 2))}, "arrays", "effort.shape", (49, 2), "(50, 2), as for q"),
        (
            {"tau": np.full((50, 2), np.inf)},
            "arrays",
            "effort[0]",
            [np.inf, np.inf],
            "finite numbers",
        ),
        ({"sample_rate_hz": 0.0}, "arrays", "sample_rate_hz", 0.0, RATE),
        ({"sample_rate_hz": "100"}, "arrays", "sample_rate_hz", "100", RATE),
        ({"sample_rate_hz": [100.0]}, "arrays", "sample_rate_hz", [100.0], RATE),
        ({"sample_rate_hz": None}, "arrays", "sample_rate_hz", None, RATE),
        ({"sample_rate_hz": float("nan")}, "arrays", "sample_rate_hz", ANY, RATE),
        ({"method": "ls"}, "", "method", "ls", "'iv', 'wls' or 'ols'"),
        ({"velocity": np.zeros((49, 2))}, "arrays", "velocity.shape", (49, 2), "(50, 2), as for q"),
        (
            {"known_torque": np.zeros((50, 1))},
            "arrays",
            "known_torque.shape",
            (50, 1),
            "(N, 2), one row per sample",
        ),
        ({"feedforward": [[0, np.nan]] * 50}, "arrays", "feedforward[0]", ANY, "finite numbers"),
        ({"cutoff_hz": -1.0}, "", "cutoff_hz", -1.0, "0 or greater"),
        ({"sample_rate_hz": 0.008}, "arrays", "sample_rate_hz", 0.008, "1 or greater"),
        (
            {"bandwidth_hz": 5.0, "robot": robot_named("scara")},
            "",
            "bandwidth_hz",
            5.0,
            "",
        ),
        ({"bandwidth_hz": 5.0}, "", "bandwidth_hz", None, ""),
    ],
)
def test_invalid_input_is_refused(change, place, key, value, expected):
    given = {
        "q": np.zeros((50, 2)),
        "tau": np.zeros((50, 2)),
        "sample_rate_hz": 100.0,
        "robot": SCARA,
    }
    with pytest.raises(identification.BadInputError) as caught:
        identification.fit(**{**given, **change})
    error = caught.value
    assert (error.place, error.key, error.value, error.expected) == (place, key, value, expected)


STAMPS = 0.25 + np.arange(50) / 125.0


@pytest.mark.parametrize(
    ("stamps", "doubt"),
    [
        (STAMPS, "125 Hz"),
        (STAMPS.tolist(), "125 Hz"),
        (STAMPS[:, None], "125 Hz"),
        (STAMPS + 2.0 * (np.arange(50) > 30), "125 Hz"),  # with a gap
        ((8e6 * np.arange(50)).astype("datetime64[ns]"), "125 Hz"),
        (np.zeros(50), ""),
        (STAMPS[::-1], ""),
        ([STAMPS, STAMPS], "125 Hz"),  # of two recordings
    ],
)
def test_timestamps_as_sample_rate_are_refused(stamps, doubt):
    q: object = np.zeros((50, 2))
    if len(stamps) == 2:
        q = [q, q]
    with pytest.raises(identification.BadInputError) as caught:
        identification.fit(q, q, stamps, SCARA)
    text = f"timestamps in s have the rate {doubt}: " if doubt else ""
    assert str(caught.value) == f"arrays: sample_rate_hz = 50 values: {text}expected {RATE}"


def test_missing_positions_are_reported():
    with pytest.raises(identification.BadInputError) as caught:
        identification.fit(None, np.zeros((50, 2)), 125.0, SCARA)
    assert (caught.value.key, caught.value.value) == ("q.shape", ())


def test_velocity_is_compared_with_derivative(signals):
    arrays, speed = (signals.q, signals.effort, 1000.0, SCARA), np.gradient(signals.q, 1e-3, axis=0)
    fit = identification.fit(*arrays, method="wls", velocity=0.8 * speed)
    np.testing.assert_array_equal(fit.evidence.problem.signals.velocity, 0.8 * speed)
    assert [text.split(", ")[0] for text in fit.warnings if "velocity" in text] == [
        f"recording: the velocity of joint {name} is 0.8 times the derivative of its position"
        for name in ("shoulder", "elbow")
    ]
    with pytest.raises(
        acquisition.BadInputError, match="arrays: the velocity of joint shoulder is -1 times the"
    ):
        identification.fit(*arrays, velocity=-speed)


def test_results_have_one_line_repr(signals, by_iv):
    error, essential = by_iv.errors[-1].relative_error_percent, len(by_iv.evidence.essential_names)
    assert (
        repr(by_iv)
        == f"Fit(SCARA, arrays, iv, converged, verdict trust: 8 parameters, {essential} "
        f"essential, torque error {error:.3g} %)"
    )
    assert repr(signals).endswith(": SCARA, 4001 samples of 2 joints at 1000 Hz, with reference)")
    assert repr(acquisition.load_robot(str(SCARA))) == "Robot(SCARA: 2 joints, 2 drives)"
    recording = acquisition.read_recording(str(REPLAY / "scara" / "session.mcap"))
    assert repr(recording) == (
        f"Recording(SCARA: {len(recording.samples)} samples at 1000 Hz, "
        f"{sum(map(len, recording.frames.values()))} CAN frames)"
    )


class Page(html.parser.HTMLParser):
    """The texts of a page by their tags, those of table cells row by row;
    every tag must be closed.
    """

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


def test_notebook_shows_fit_report(signals):
    from identification.results import fit_document

    robot = replace(signals.robot, name="<b>SCARA & Co")
    fit = identification.identify_ls(replace(signals, robot=robot), identification.Overrides())
    assert fit._repr_html_().count("<iframe") == 1
    page, report = Page(fit._repr_html_()), fit_document(fit.file).short
    assert page.open == []
    assert page.texts[:2] == [report.title, report.badge]
    assert {text for figure in report.figures for text in figure} <= {*page.texts}
    assert "<b>SCARA & Co" in report.title
    tables = [section.table for section in report.sections if section.table]
    shown = [
        row for table in tables for row in ([heading for heading, _ in table.columns], *table.rows)
    ]
    assert page.rows == [
        [" ".join((x if isinstance(x, str) else x.text).split()) for x in row if x != ""]
        for row in shown
    ]
    for section in report.sections:
        lines = (*section.lines, *(f"Warning: {text}" for text in section.warnings))
        texts = [text for x in lines for text in ([x] if isinstance(x, str) else x)]
        assert {" ".join(text.split()) for text in texts} <= {*page.texts}


def test_fit_validates_on_other_recording(signals, by_iv, tmp_path):
    at_iv = by_iv.errors[-1].relative_error_percent
    assert identification.validate(by_iv, signals).relative_error_percent == pytest.approx(
        at_iv, rel=0.05
    )
    study = identification.Study(seed=9, duration_s=5.0)
    other = identification.simulate_recording(SCARA, tmp_path / "other.mcap", study)
    with pytest.raises(acquisition.BadInputError, match=r"other\.mcap: "):
        identification.simulate_recording(SCARA, tmp_path / "other.mcap")
    by_iv.save(tmp_path / "fit.json")
    pairs = (
        (by_iv, other),
        (identification.load(tmp_path / "fit.json"), str(tmp_path / "other.mcap")),
    )
    found = [
        identification.validate(*pair, identification.Overrides(torque_lag_s=0.002))
        for pair in pairs
    ]
    assert found[0].torque_lag_s == 0.002
    for name in ("shoulder", "elbow", "all"):
        assert f"{found[0].errors[name].relative_error_percent:.4f}" in str(found[0])
    warned = msgspec.structs.replace(found[0], warnings=["a <b>"])
    assert str(warned).endswith("Warning: a <b>")
    assert "Warning: a &lt;b&gt;</p>" in warned._repr_html_()
    assert found[0].joints == found[1].joints
    assert found[0].provenance.recording == "other.mcap"


def test_fit_has_verdict_and_parameters(by_iv, tmp_path):
    assert by_iv.verdict == by_iv.evidence.trust.verdict == "trust"
    assert by_iv.assumed == by_iv.evidence.trust.assumed != ()
    by_iv.save(tmp_path / "fit.json")
    for fit in (by_iv, identification.load(tmp_path / "fit.json")):
        columns = fit.parameters.to_dict()
        assert [*columns] == [
            "name",
            "meaning",
            "value",
            "half_width",
            "low",
            "high",
            "unit",
            "expression",
            "essential",
        ]
        assert columns["name"] == list(by_iv.base.names)
        assert columns["value"] == pytest.approx(by_iv.beta)
        assert columns["half_width"] == pytest.approx(by_iv.evidence.intervals.half)
        assert columns["unit"] == list(by_iv.base.units)
    rho, tau = (x[by_iv.evidence.counts] for x in (by_iv.residuals(), by_iv.evidence.tau))
    whole = 100 * np.linalg.norm(rho) / np.linalg.norm(tau)
    assert whole == pytest.approx(by_iv.errors[-1].relative_error_percent)


def figures_of(fit, *log):
    """Captions of what `plot` shows, and the number of lines of each of its graphs."""
    plot = fit.plot(*log)
    assert plot._repr_html_() == "".join(plot)
    content = html.unescape(plot.split('srcdoc="')[1].split('"')[0])
    figures = content.split("<figure")[1:]
    assert repr(plot).startswith(f"{len(figures)} figure")
    assert str(plot) == repr(plot)
    assert Page(content).open == []
    return {
        re.search("<figcaption>([^<]*?)(: error [^<]*)?<", one)[1]: one.count('<path class="l ')
        for one in figures
    }


def test_plot_shows_torques_and_parameters(signals, by_iv, tmp_path):
    torques = {f"torque {joint} [N m]": 2 + 3 for joint in ("shoulder", "elbow")}  # two grids
    shown = figures_of(by_iv)
    assert [*shown] == [*torques, "Parameters of IV: ZZ1R to Fc2"]
    assert torques.items() <= shown.items()
    assert "write_report" in repr(by_iv.plot())
    by_iv.save(tmp_path / "fit.json")
    stored = identification.load(tmp_path / "fit.json")
    assert [*figures_of(stored)] == [*shown][2:]
    study = identification.Study(duration_s=4.0)
    identification.simulate_recording(SCARA, tmp_path / "log.mcap", study)
    assert [*figures_of(stored, tmp_path / "log.mcap")] == [*shown]
    known = identification.load(REPLAY / "scara" / "truth.json")
    for shown in (known.plot, lambda: known.document):
        with pytest.raises(identification.BadInputError, match="known parameters, but no fit of a"):
            shown()
    assert known._repr_html_() == known.parameters._repr_html_()


def test_earlier_names_work(by_iv, tmp_path):
    by_iv.to_json(tmp_path / "a.json")
    by_iv.save(tmp_path / "b.json")
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    again = identification.read_fit(tmp_path / "b.json")
    assert ("Fc2" in again, "Fc9" in again) == (True, False)
    assert again.parameters == identification.load(tmp_path / "b.json").parameters
    assert again.parameters == by_iv.parameters
    assert (by_iv["Fc2"].half, by_iv["Fc2"].meaning) == (
        by_iv["Fc2"].half_width,
        "Coulomb friction of elbow",
    )


@pytest.mark.filterwarnings("ignore::identification.DoNotUseWarning")
def test_settings_are_keywords(signals):
    def fitted(**given):
        return identification.fit(signals.q, signals.effort, 1000.0, SCARA, method="wls", **given)

    settings = fitted(
        cutoff_hz=37.0, decimation=7, low_speed_percent=3.0, torque_lag_s=0.002
    ).evidence.settings
    assert (settings.cutoff_hz, settings.decimation, settings.torque_lag_s) == (37.0, 7, 0.002)
    assert settings.low_speed.ls == 3.0
    assert fitted(cutoff_hz=0.0).evidence.settings.cutoff_hz is None
    noise = np.random.default_rng(1).normal(scale=20.0, size=signals.effort.shape)
    noisy = replace(signals, effort=signals.effort + noise)
    few = identification.fit(noisy.q, noisy.effort, 1000.0, SCARA, method="wls", essential=True)
    assert len(few.parameters) < 8 == len(few.beta)


@pytest.mark.parametrize("by", ["arrays", "recording"])
def test_do_not_use_warns_at_caller(signals, by):
    wrong = replace(signals, effort=-signals.effort)
    ways = {
        "arrays": lambda: identification.fit(wrong.q, wrong.effort, 1000.0, SCARA),
        "recording": lambda: identification.identify_ls(wrong, identification.Overrides()),
    }
    first_words = "^do not use Fit.SCARA, .*, verdict do not use: .*: "
    with pytest.warns(identification.DoNotUseWarning, match=first_words) as told:
        fit = ways[by]()
    assert [warning.filename for warning in told] == [__file__]
    with pytest.raises(
        identification.BadInputError,
        match=r"^the fit is not exported: (arrays|simulated): verdict do not use\. ",
    ):
        fit.export(mjcf="never.xml")


def test_two_fits_are_compared(signals, by_iv):
    by_ls = identification.fit(signals.q, signals.effort, 1000.0, SCARA, method="wls")
    found = by_iv.compare(by_ls)
    assert [row.name for row in found] == list(by_iv.base.names)
    np.testing.assert_allclose([row.off for row in found], by_iv.beta - by_ls.beta)
    text = signals.robot.files["robot.toml"].replace(b"d_m = 0.5", b"d_m = 0.6")
    moved = replace(signals.robot, files={"robot.toml": text})
    other = identification.fit(signals.q, signals.effort, 1000.0, moved, method="wls")
    with pytest.warns(
        UserWarning, match="^the link frames differ: two different DH rows; "
    ) as told:
        by_iv.compare(other)
    assert [warning.filename for warning in told] == [__file__]


def test_robot_may_be_urdf(by_iv, tmp_path):
    urdf = tmp_path / "arm.urdf"
    by_iv.consistent().export(urdf=urdf)
    limits = {"position": 2.0, "speed": 3, "acceleration": [20.0, 30.0]}
    robot = identification.read_robot(
        urdf, joints=["shoulder", "elbow"], bandwidth_hz=8.0, **limits
    )
    assert robot.bandwidth_hz == 8.0
    assert [np.deg2rad(joint.acceleration_deg_s2) for joint in robot.joints] == pytest.approx(
        [20.0, 30.0]
    )
    with pytest.raises(
        acquisition.RobotIdimError, match=r"robot SCARA: controller\.bandwidth_hz is missing"
    ):
        identification.simulate_recording(urdf, tmp_path / "log.mcap")
    log = identification.simulate_recording(robot, tmp_path / "log.mcap")
    fits = [
        identification.fit(log.q, log.effort, log.sample_rate_hz, given, log.q_ref, **others)
        for given, others in ((str(urdf), {"bandwidth_hz": 8.0}), (robot, {}))
    ]
    np.testing.assert_array_equal(fits[0].beta, fits[1].beta)
    assert fits[0].verdict == "trust"


def test_references_and_studies_in_python(tmp_path):
    settings = identification.ExcitationSettings(periods=1, period_s=5.0, harmonics=3)
    identification.design_reference(SCARA, settings, noise=[0.1]).write(tmp_path / "ref.csv")
    table = np.loadtxt(tmp_path / "ref.csv", delimiter=",", skiprows=1)
    assert (table[-1, 0], table.shape[1]) == (5.0, 3)
    runs = identification.run_study(SCARA, identification.Study(runs=1, duration_s=3.0))
    assert [run.number for run in runs] == [0]


def test_readme_lines_and_examples_run(tmp_path, monkeypatch, capsys):
    import mujoco

    shutil.copy(SCARA, tmp_path / "robot.toml")
    monkeypatch.chdir(tmp_path)
    blocks = [identification.__doc__.split("\n\n")[1]]
    assert blocks[0].count("\n") == 5, "help begins with six lines"
    for page in ("identification/docs/howto/python.md", "README.md"):
        section = (ROOT / page).read_text().split("## From Python\n")[1].split("\n## ")[0]
        blocks += re.findall(r"(?:^ {4}.*\n|^\n(?= {4}))+", section, flags=re.MULTILINE)
    begins = "trust", "Fit(SCARA, arrays, iv, converged, verdict trust: ", "trust Parameters with "
    for block, begin in zip(blocks, begins, strict=True):
        exec(compile(textwrap.dedent(block), "README", "exec"), {})
        told = capsys.readouterr().out
        assert told.startswith(begin)
        assert "ZZ1R" in told
    assert doctest.testmod(acquisition) == (0, 2)
    for name in ("log.mcap", "report.html", "robot.xml"):
        Path(name).unlink()
    exec(compile(Path(__file__).with_name("user_script.py").read_text(), "user_script", "exec"), {})
    assert capsys.readouterr().out.startswith("trust ['drive gains', ")
    assert "SCARA" in (tmp_path / "report.html").read_text()
    assert mujoco.MjModel.from_xml_path("robot.xml").nv == 2


STORED = REPLAY / "tx40" / "fit.json"


def test_stored_fit_has_short_repr():
    stored = identification.load(STORED)
    expected = (
        "(TX40, session.mcap, iv, converged, verdict trust: 60 parameters, 37 essential, "
        "torque error 0.688 %)"
    )
    assert (repr(stored), repr(stored.file)) == (f"Fit{expected}", f"FitFile{expected}")
    shown = stored._repr_html_()
    assert (len(shown) < 25_000, shown.count("<iframe")) == (True, 1)
    frame, page = Page(html.unescape(shown.split('srcdoc="')[1].split('"')[0])), Page(shown)
    assert (page.open, frame.open) == ([], [])
    assert any("Parameters of " in text for text in frame.texts)
    assert {
        "0.688 %",
        "cross-validated",
        "median 95 % half-width of 37 well-determined parameters",
        "largest 95 % half-width (ZZ6)",
        "86 %",
    } <= {*page.texts}
    assert page.texts[:2] == [stored.document.title, stored.document.badge]
    assert page.rows[0][:3] == ["parameter", "meaning", "value"]
    assert len(page.rows) == 11
    assert (stored.verdict, stored.assumed[0].what) == (
        stored.file.verdict,
        stored.file.assumed[0].what,
    )
    known = msgspec.structs.replace(stored.file, verdict=msgspec.UNSET)
    assert repr(known) == "FitFile(60 parameters)"


def test_fit_predicts_torque(by_iv, tmp_path):
    """Of the nearest physically possible links, where there are some."""
    from identification.model import InverseModel

    fit = by_iv.consistent()
    fit.save(tmp_path / "fit.json")
    q, dq, ddq = np.random.default_rng(0).normal(size=(3, 20, 2))
    expected = (
        InverseModel(robot_named("scara")).regressor(q, dq, ddq)[:, :, fit.base.columns] @ fit.beta
    )
    for one in (fit, identification.load(tmp_path / "fit.json")):
        np.testing.assert_allclose(one.predict(q, dq, ddq), expected, rtol=1e-9, atol=1e-9)
    with pytest.raises(identification.BadInputError, match=r"expected \(rows, 2\) of q"):
        fit.predict(q, dq[:, :1], ddq)
    bare = msgspec.structs.replace(fit.file, description={})
    (tmp_path / "bare.json").write_bytes(msgspec.json.encode(bare))
    with pytest.raises(identification.BadInputError) as told:
        identification.load(tmp_path / "bare.json").predict(q, dq, ddq)
    assert (told.value.place, told.value.key) == (str(tmp_path / "bare.json"), "description")


def test_several_recordings_are_lists_of_arrays(signals, tmp_path):
    both = slice(0, 2000), slice(2000, 4001)
    q, tau, q_ref = ([x[part] for part in both] for x in (signals.q, signals.effort, signals.q_ref))
    fit = identification.fit(q, tau, 1000.0, SCARA, q_ref)
    assert [one.problem.signals.recording for one in fit.evidence.recordings] == [
        "arrays 1",
        "arrays 2",
    ]
    for one, k in zip(fit.evidence.recordings, range(2), strict=True):
        np.testing.assert_array_equal(one.problem.signals.q, q[k])
        np.testing.assert_array_equal(one.problem.signals.q_ref, q_ref[k])
    fit.write_rrd(tmp_path / "fit.rrd")
    assert {path.name for path in tmp_path.iterdir()} == {"fit_1.rrd", "fit_2.rrd"}
    slow = [q[0], q[1][::2]], [tau[0], tau[1][::2]], [1000.0, 500.0]
    rates = identification.fit(*slow, SCARA, method="wls", payload=[None, "2"]).evidence.recordings
    assert [one.problem.signals.sample_rate_hz for one in rates] == [1000.0, 500.0]
    assert [
        one.problem.signals.payload and one.problem.signals.payload.mass_kg for one in rates
    ] == [None, 2.0]
    for change, key in (({"tau": tau[:1]}, "len(effort)"), ({"payload": ["1"]}, "len(payload)")):
        with pytest.raises(identification.BadInputError) as caught:
            identification.fit(
                **{"q": q, "tau": tau, "sample_rate_hz": 1000.0, "robot": SCARA, **change}
            )
        assert (caught.value.key, caught.value.value, caught.value.expected) == (
            key,
            1,
            "2, one for each array of q",
        )


def test_errors_name_arguments_and_their_options():
    error = identification.RobotIdimError("a", key="span_s", value=0, arguments=["seed"])
    assert str(error) == "span_s = 0: a. (seed)."
    assert error.message({"span_s": "--span", "seed": "--seed"}) == "--span = 0: a. (--seed)."


def test_error_names_option_or_keyword(tmp_path, capsys):
    from identification.commands import main

    settings = identification.ExcitationSettings(period_s=1.0, harmonics=30)
    with pytest.raises(identification.BadInputError) as caught:
        identification.design_reference(SCARA, settings, noise=[0.1])
    assert "--" not in str(caught.value)
    assert "period_s" in str(caught.value)
    words = f"excite {SCARA} -o {tmp_path / 'r.csv'} --harmonics 30 --period 1 --noise 0.1"
    assert main(words.split()) == 1
    line = capsys.readouterr().err
    assert "(--period)" in line
    assert line.replace("(--period)", "(period_s)").endswith(f"{caught.value}\n")
