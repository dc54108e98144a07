"""The report as one HTML file: its structure, its colours, the panels of both renderers, and what
Chromium does with it.
"""

import html.parser
import re
import shutil
import time
from functools import cache

import numpy as np
import pytest
from browser import MISSING, browser
from conftest import REPLAY
from fits_of_records import iv_of, ls_of, picture_of, short_recording, signals_of
from pictured_fits import Written
from scipy import signal

from identification.commands import main
from identification.view import join_pictures, write_html, write_rrd
from identification.view.panels import Graph, Log, Plot, Rows, Scene
from identification.view.recording_panels import _welch

SCARA, TX40 = (REPLAY / robot / "session.mcap" for robot in ("scara", "tx40"))
VOID = {"meta", "link", "br", "img"}
needs_chromium = pytest.mark.skipif(MISSING is not None, reason=str(MISSING))


class Page(html.parser.HTMLParser):
    """Tags with their attributes, and texts; every tag is closed."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.texts, self._open = [], [], []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        if self._open and self._open[-1] != "style":
            self.texts.append(data)

    def all(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


@cache
def picture(record):
    return picture_of(iv_of(record))


def page_of(picture, tmp_path):
    write_html(tmp_path / "report.html", picture)
    return Page((tmp_path / "report.html").read_text(encoding="utf-8"))


def test_file_is_small_and_self_contained(tmp_path):
    signals, fit = signals_of(TX40), iv_of(TX40)
    start = time.process_time()
    page = page_of(picture(TX40), tmp_path)
    assert time.process_time() - start < 1.0, "0.2 s on a machine with nothing else to do"
    assert (tmp_path / "report.html").stat().st_size < 1_000_000
    names = {name for name, _ in page.tags}
    assert not names & {"script", "img", "link", "iframe", "object", "image", "use"}
    (policy,) = (
        meta["content"]
        for meta in page.all("meta")
        if meta.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy == "default-src 'none'; style-src 'unsafe-inline'"
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"(href|src)=|url\(|@import|https?:|\bnan\b|\binf\b|NaN", text)
    assert not [key for _, attrs in page.tags for key in attrs if key.startswith("on")]
    for svg in page.all("svg"):
        assert min(float(x) for x in svg["viewbox"].split()[2:]) > 0
        assert svg["aria-label"]
    said = " ".join(page.texts)
    for part in (
        f"Verdict: {fit.trust.verdict}",
        "no test confirms them",
        "drive gains, efforts",
        signals.sha256,
        f"numpy {np.__version__}",
    ):
        assert part in said


def test_result_precedes_appendix(tmp_path):
    write_html(tmp_path / "report.html", picture(TX40))
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    result, appendix = text.split("<details>")
    assert result.count("<figure") == result.count("<table>") == 1
    assert result.count("<tr>") == 1 + 10
    fit = iv_of(TX40)
    worst = max(fit.errors[:-1], key=lambda error: error.moving_relative_error_percent)
    assert f"Torque of {worst.name} (largest relative error), N m over time in s" in result
    measured, model, rest = (curve.line[1] for curve in picture(TX40).first.curves)
    np.testing.assert_allclose(measured - model, rest)
    assert np.abs(rest).max() < 0.5 * np.abs(measured).max()
    assert (
        result.split("border-radius")[1]
        .split("</span>")[0]
        .endswith(f">{fit.trust.verdict} · All 14 tests passed")
    )
    assert f"{fit.errors[-1].moving_relative_error_percent:.3g} %" in result
    assert "--all" not in text, "no reader of a page has options"
    assert appendix.count("<figure") > 20


def test_rerun_has_time_series_html_the_rest(tmp_path):
    drawn = picture(SCARA)
    write_rrd(tmp_path / "fit.rrd", drawn)
    views = {origin.replace("\\", "") for origin in Written(tmp_path / "fit.rrd").views}
    panels = [panel for page in drawn.pages for group in page.groups.values() for panel in group]
    assert views == {"/report"} | {
        "/" + "/".join(panel.path) for panel in panels if isinstance(panel, Plot | Log | Scene)
    }
    captions = page_of(drawn, tmp_path).all("figure")
    figures = [panel for panel in panels if not isinstance(panel, Scene)]
    assert {type(panel) for panel in figures} == {Plot, Log, Graph, Rows}
    assert len(captions) == len(figures) + 1 > 20  # the first one again, with its title
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    places = [text.index(f"<figcaption>{panel.title}") for panel in figures]
    assert places == sorted(places), "in the order of the pages"


def test_several_recordings_have_own_signals(tmp_path):
    drawn = picture(SCARA)
    both = join_pictures([drawn, picture_of(ls_of(SCARA))])
    names = [page.name for page in both.pages]
    assert names[: len(drawn.pages)] == [page.name for page in drawn.pages]
    more = {name.split(":")[0] for name in names[len(drawn.pages) :]}
    assert more == {"overview", "residual", "signal", "motion"}


@pytest.mark.parametrize("length", [400, 401])
def test_spectrum_matches_welch(length):
    x = np.random.default_rng(1).standard_normal(1700).cumsum()
    expected = signal.welch(x, 250.0, nperseg=length, detrend="linear")[1]
    np.testing.assert_allclose(
        _welch(x, length, 250.0), expected, rtol=1e-9, atol=1e-12 * expected.max()
    )


RUNS = {
    "fit": "fit log.mcap",
    "validate": "validate fit.json log.mcap",
    "compare": "compare fit.json truth.json",
    "friction": "friction log.mcap",
    "sensitivity": "study log.mcap --position-noise 1e-4",
    "study": "study robot.toml --runs 2 --duration-s 3 --workers 1",
    "excite": "excite robot.toml -o ref.csv --harmonics=2 --periods=1 --period=3",
}


@pytest.mark.parametrize("name", RUNS)
def test_commands_write_report(name, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    short_recording(tmp_path / "log.mcap", SCARA)
    for file in ("robot.toml", "fit.json", "truth.json"):
        shutil.copy(REPLAY / "scara" / file, tmp_path / file)
    assert main([*RUNS[name].split(), "--report", "a.pdf"]) == 1
    assert "expected .md or .html" in capsys.readouterr().err
    assert not (tmp_path / "a.pdf").exists()
    assert main([*RUNS[name].split(), "--report", "a.html"]) == 0
    text, lines = (tmp_path / "a.html").read_text(), capsys.readouterr().out.splitlines()
    page = Page(text)
    assert page.all("svg")
    assert page.all("h1")
    if name == "sensitivity":
        said = lines[0].startswith("log.mcap: LS changes by up to "), "ZZ1R, 95 % interval" in text
        assert (*said, len(lines) <= 40) == (True, True, True)


@needs_chromium
def test_chromium_shows_without_requests_or_scroll(tmp_path):
    file = tmp_path / "report.html"
    write_html(file, picture(TX40))
    with browser() as window:
        for width, scheme in ((1280, "light"), (400, "dark")):
            window.requests()
            window.open(file, width=width, scheme=scheme)
            assert (window.requests(), window.console()) == ([file.as_uri()], [])
            assert window.run("return [innerWidth, document.documentElement.scrollWidth]") == [
                width,
                width,
            ]
            assert window.run(
                "return [...document.querySelectorAll('path.l')].filter(p => p.getBBox().width <= "
                "1 && p.getBBox().height <= 1 || parseFloat(getComputedStyle(p).strokeWidth) < "
                ".5).length"
            ) == 0  # fmt: skip
            ground = "return getComputedStyle(document.body).backgroundColor"
            assert (
                window.run(ground)
                == {"light": "rgb(255, 255, 255)", "dark": "rgb(18, 18, 18)"}[scheme]
            )
            assert "NaN" not in window.run("return document.documentElement.outerHTML")
        pages = len(re.findall(rb"/Type\s*/Page\b[^s]", window.pdf()))
        assert 4 <= pages <= 22, (
            "at most two of the result, then the appendix, which is opened in print"
        )
        window.cdp("Emulation.setEmulatedMedia", media="print")
        inside = (
            "return [...document.querySelectorAll('figure')].map(f => "
            "getComputedStyle(f).breakInside)"
        )
        assert set(window.run(inside)) == {"avoid"}
        # Less than the 186 mm that a page of A4 across has within its margins: no
        # figure has to be cut.
        window.cdp(
            "Emulation.setDeviceMetricsOverride",
            width=1032,
            height=703,
            deviceScaleFactor=1,
            mobile=False,
        )
        assert (
            max(
                window.run(
                    "return [...document.querySelectorAll('figure')].map(f => f.offsetHeight)"
                )
            )
            < 700
        )
