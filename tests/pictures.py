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
# Name of a picture, commands, script of the element to cut out of the last report, and pixels per
# pixel of the page. `kept` has the first figures of all reports.
PICTURES = {
    "overview.png": (
        [["study", EMPS, "--position-noise", NOISE], ["fit", TX40]],
        "const main = document.querySelector('main'); main.innerHTML = kept; main.style.cssText = "
        "'display: flex; gap: 1.5em; width: 1160px; padding: 0'; for (const one of main.children) "
        "one.style.cssText = 'flex: 1 1 0; min-width: 0; margin: 0'; return main",
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
                kept += window.run("return document.querySelector('.first').outerHTML")
            if kept:
                script = f"const kept = {json.dumps(kept)}; {element}"
                (REPLAY / "pictures" / name).write_bytes(cut_out(window, script, scale))


if __name__ == "__main__":
    write_pictures()
