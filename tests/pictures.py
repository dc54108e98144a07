"""Figures of the guides, cut out of reports in Chromium.

`python tests/pictures.py` writes replay_data/pictures again.

The real record of the EMPS is not here (see replay_data/README.md). Without it, its figure is not
written again.
"""

import base64
import json
import os
import sys
import tempfile
from pathlib import Path

from conftest import DATA, REPLAY, imported

from identification.commands import main

sys.path.append(str(Path(__file__).with_name("identification") / "view"))
from browser import Browser, browser

EMPS, TX40 = (REPLAY / robot / "session.mcap" for robot in ("emps", "tx40"))
NOISE = ",".join(f"{k}e-6" for k in range(2, 21, 2))  # m rms
MARGIN = 4  # pixels around a figure
# The only figure of a study; of a fit that of the third joint, or of the only one.
FIRST = "const x = document.querySelectorAll('.first figure'); return (x[2] || x[0]).outerHTML"
# Name of a picture, commands, script of the element to cut out of the last report, and pixels per
# pixel of the page. `kept` has the first figures of all reports.
PICTURES = {
    "overview.png": (
        [["study", EMPS, "--position-noise", NOISE], ["fit", TX40]],
        # Widths for which both figures have one height, with texts of one size.
        "const main = document.querySelector('main'); main.innerHTML = kept; main.style.cssText = "
        "'display: flex; gap: 1.5em; width: 1100px; padding: 0'; for (const one of main.children) "
        "{ const wide = one.querySelector('svg').viewBox.baseVal.height < 300 ? 1.42 : 1; "
        "one.style.cssText = `flex: ${wide} 1 0; min-width: 0; margin: 0`; for (const text of "
        "one.querySelectorAll('text')) text.style.fontSize = `${14 / wide}px` } return main",
        2,
    ),
    "report.png": (
        [["fit", TX40]],
        "document.querySelector('footer').remove(); return document.querySelector('main')",
        1,
    ),
    "sensitivity.png": (
        [["study", "emps.mcap"]],
        "document.querySelector('details').open = true; return document.querySelector('details "
        "section')",
        1,
    ),
}


def cut_out(window: Browser, element: str, scale: int) -> bytes:
    """Return the element that a script returns as a PNG."""
    place = (
        f"const b = (() => {{ {element} }})().getBoundingClientRect(); return [b.x, b.y + "
        "scrollY, b.width, b.height]"
    )
    x, y, width, height = window.run(place)
    found = window.cdp(
        "Page.captureScreenshot",
        captureBeyondViewport=True,
        clip={
            "x": max(0, x - MARGIN),
            "y": max(0, y - MARGIN),
            "width": width + 2 * MARGIN,
            "height": height + 2 * MARGIN,
            "scale": scale,
        },
    )
    return base64.b64decode(found["data"])


def write_pictures() -> None:
    """Run the commands and write the pictures."""
    with tempfile.TemporaryDirectory() as folder, browser() as window:
        os.chdir(folder)
        if (DATA / "emps").exists():
            imported("emps", Path("emps.mcap"))
        for name, (commands, element, scale) in PICTURES.items():
            kept = ""
            for command, log, *options in [one for one in commands if Path(one[1]).exists()]:
                assert main([command, str(log), *options, "--report", "report.html"]) in (0, 3)
                window.open(Path("report.html"))
                kept += window.run(FIRST)
            if kept:
                script = f"const kept = {json.dumps(kept)}; {element}"
                (REPLAY / "pictures" / name).write_bytes(cut_out(window, script, scale))


if __name__ == "__main__":
    write_pictures()
