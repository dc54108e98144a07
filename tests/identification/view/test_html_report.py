"""The report as one HTML file: its structure, its colours, the panels of both renderers, and what
Chromium does with it.
"""

import html.parser
import re
import shutil
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from browser import MISSING, browser
from conftest import REPLAY
from fits_of_records import iv_of, ls_of, picture_of, short_recording, signals_of
from pictured_fits import Written
from scipy import signal

from identification.commands import main
from identification.regression import Overrides
from identification.results import identify_ls
from identification.view import html_page, join_pictures, write_html, write_rrd
from identification.view.html_page import EDGES, STEPS
from identification.view.panels import CLASSES, Graph, Log, Plot, Rows, Scene
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
    assert not re.search(r'href="[^#]|src=|url\(|@import|https?:|\bnan\b|\binf\b|NaN', text)
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
    assert (result.count("<figure"), result.count("<table>")) == (6 + 1, 1)
    assert result.count("<tr>") == 1 + 10
    fit = iv_of(TX40)
    worst = max(fit.errors[:-1], key=lambda error: error.moving_relative_error_percent)
    assert worst.name in picture(TX40).first.title, "a notebook has the largest error alone"
    measured, model, rest = (curve.line[1] for curve in picture(TX40).first.curves)
    np.testing.assert_allclose(measured - model, rest)
    assert np.abs(rest).max() < 0.5 * np.abs(measured).max()
    assert f">{fit.trust.verdict} · All 14 tests passed</span>" in result
    assert f"{fit.errors[-1].moving_relative_error_percent:.3g} %" in result
    assert "--all" not in text, "no reader of a page has options"
    assert appendix.count("<figure") > 20


def test_rerun_has_time_series_html_the_rest(tmp_path):
    drawn = picture(SCARA)
    write_rrd(tmp_path / "fit.rrd", drawn)
    views = {origin.replace("\\", "") for origin in Written(tmp_path / "fit.rrd").views}
    panels = [panel for page in drawn.pages for group in page.groups.values() for panel in group]
    assert views == {"/report"} | {
        "/" + "/".join(panel.path)
        for panel in panels
        if not isinstance(panel, Graph) or isinstance(panel, Plot)
    }
    captions = page_of(drawn, tmp_path).all("figure")
    first = {c for panel in drawn.front.groups["torque"] for c in panel.curves}
    figures = [
        panel
        for panel in panels
        if not isinstance(panel, Scene) and not {*getattr(panel, "curves", [panel])} <= first
    ]
    assert len(figures) == len(panels) - 1 - 2, "residuals are shown already"
    assert {type(panel) for panel in figures} == {Plot, Log, Graph, Rows}
    assert len(captions) == len(figures) + 2 + 1 > 20  # joints, and parameters beside their table
    _, text = (tmp_path / "report.html").read_text(encoding="utf-8").split("<details>")
    places = [text.index(f"<figcaption>{panel.title}") for panel in figures]
    assert places == sorted(places), "in the order of the pages"


def test_contents_link_every_section(tmp_path):
    page = page_of(picture(SCARA), tmp_path)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    result, _ = text.split("<details>")
    contents = re.search(r"<nav.*?</nav>", result)[0]
    links = dict(re.findall(r'<a href="#(s\d+)">(.*?)</a>', contents))
    assert contents.count("<a ") == len(page.all("a")) == len(links) == len({*links.values()})
    headed = dict(re.findall(r'<h2 id="(s\d+)">(.*?)</h2>', text))
    assert len(headed) == text.count(' id="') == text.count("<h2") - 1, "that of versions has none"
    assert {key: headed[key].split(". ")[0] for key in links} == links
    assert {*links.values()} == {title.split(". ")[0] for title in headed.values()}
    before, after = contents.split("<span>In the whole report:</span>")
    assert [f' id="{key}"' in result for key in links] == [f'"#{key}"' in before for key in links]
    assert {"overview", "Settings"} <= {*re.findall(r">(\w+)</a>", after)}
    places = [result.index(part) for part in ("</span>", contents, "<h2 ", "<figure")]
    assert places == sorted(places), "badge, contents, verdict"


def test_every_joint_has_torque_above_residual(tmp_path):
    write_html(tmp_path / "report.html", picture(TX40))
    result, _ = (tmp_path / "report.html").read_text(encoding="utf-8").split("<details>")
    one = iv_of(TX40).recordings[0]
    figures = re.findall(r"<figure.*?</figure>", result)[:6]
    for j, (figure, error) in enumerate(zip(figures, iv_of(TX40).errors, strict=False)):
        percent = f"{error.moving_relative_error_percent:.3g} %"
        assert f"torque {error.name} [N m]: error {percent} in motion<" in figure
        assert f'middle" x="264" y="{EDGES[1][0] + 32:g}">time [s]<' in figure
        drawn = re.findall(
            r'"l (measured|model|vermillion)" stroke-width="([\d.]+)" d="M([^"]*)"', figure
        )
        assert [name for name, *_ in drawn] == ["measured", "model", "vermillion"], "model in front"
        assert float(drawn[0][1]) > 4 * float(drawn[1][1])
        steps = [np.array(re.findall(r"-?\d+", d), dtype=int).reshape(-1, 2) for *_, d in drawn]
        *torques, rest = (np.cumsum(x, axis=0) / STEPS for x in steps)
        for line, edges in zip((*torques, rest), (EDGES[0], EDGES[0], EDGES[1]), strict=True):
            assert EDGES[1][0] >= edges[0] > line[:, 1].max() > line[:, 1].min() > edges[1]
        # The residual's ticks and its extremes lie on one line.
        ticks = [
            (float(y) - 4, float(text))
            for y, text in re.findall(r'end" x="50" y="([\d.]+)">([-\d.]+)<', figure)
        ]
        (y0, x0), *_, (y1, x1) = [tick for tick in ticks if tick[0] > EDGES[1][1]]
        residual = (one.tau - one.tau_predicted)[:, j]
        expected = [y0 + (x - x0) * (y1 - y0) / (x1 - x0) for x in (residual.max(), residual.min())]
        assert [rest[:, 1].min(), rest[:, 1].max()] == pytest.approx(expected, abs=0.6)
        assert rest[[0, -1], 0] == pytest.approx(torques[0][[0, -1], 0]), "over the same time"


def test_axes_of_curves_have_units(tmp_path):
    write_html(tmp_path / "report.html", picture(SCARA))
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    plots = re.findall(r'<figure class="plot".*?<figcaption>(.*?)<.*?<svg(.*?)</svg>', text)
    plots = [(title, drawn) for title, drawn in plots if "scale(" in drawn]
    assert len(plots) == 2 + 2 + 2 + 2 + 2 + 6
    for title, drawn in plots:
        assert re.search(r">(time \[s\]|speed \[rad/s\]|frequency \[Hz\])</text>$", drawn), title
        assert re.search(r" \[\S.*\]", title), title


def test_failed_fit_begins_with_cause(tmp_path):
    signals = signals_of(SCARA)
    swapped = replace(signals, effort=signals.effort[:, ::-1])
    fit = identify_ls(swapped, Overrides())
    page_of(picture_of(fit), tmp_path)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    order = (
        ">do not use · ",
        '<h2 id="s0">Verdict: do not use',
        '<p class="fact"><b>signs and order</b>',
        "the efforts of motor_1 and motor_2 are swapped",
        "→ Check this: swap both in columns of [effort] in map.toml",
        "<nav ",
        "</b>torque error in motion<",
        "<figure",
        "<table>",
    )
    places = [text.index(part) for part in order]
    assert places == sorted(places)
    assert '<p class="fact">' not in text[: places[2]], "the worst finding is the first"


def luminance(color):
    """The relative luminance by WCAG 2."""
    parts = [int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("mode", [0, 1], ids=["light", "dark"])
def test_colors_have_contrast(mode):
    style = (Path(html_page.__file__).parent / "report.css").read_text(encoding="utf-8")
    colors = dict(re.findall(r"--(\w+): (#\w{6})", style.split(":root {")[1 + mode]))
    assert {"ground", "text", *CLASSES.values()} <= {*colors}

    def contrast(one, other):
        low, high = sorted(luminance(colors[name]) + 0.05 for name in (one, other))
        return high / low

    assert contrast("measured", "model") >= 3
    assert contrast("measured", "ground") >= 3
    for name in {*CLASSES.values()} - {"measured"}:
        assert contrast(name, "ground") >= 4.5, name


def test_several_recordings_have_own_signals(tmp_path):
    drawn = picture(SCARA)
    both = join_pictures([drawn, picture_of(ls_of(SCARA))])
    names = [page.name for page in both.pages]
    assert names[: len(drawn.pages)] == [page.name for page in drawn.pages]
    more = {name.split(":")[0] for name in names[len(drawn.pages) :]}
    assert more == {"Torque and residual", "overview", "signal", "motion"}


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
    assert len(page.all("h1")) == 1 + len(page.all("details"))
    if name in ("fit", "validate", "study"):
        assert bool(page.all("details")) == (name == "fit"), "the others have no more"
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
            edges = window.run(
                "return [...document.querySelectorAll('.first figure')].flatMap(f => "
                "[f.getBoundingClientRect()].flatMap(b => [b.left, b.right]))"
            )
            assert len({*edges[::2]}) == (2 if width == 1280 else 1), "columns"
            assert max(edges) > 0.95 * width
            link = "document.querySelector('nav a[href=\"#s9\"]').click(); return "
            opened = window.run(link + "[location.hash, document.querySelector('details').open]")
            assert opened == ["#s9", True], "a link into the whole report opens it"
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
        beside = (
            "return getComputedStyle(document.querySelector('.beside table').closest('.beside'))"
        )
        assert window.run(f"{beside}.breakInside") == "avoid", "the table stays on one page"
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
