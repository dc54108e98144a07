"""Published digits and ours, side by side.

`python tests/published.py` writes replay_data/published.md again.

The real records are not here (see replay_data/README.md); without them the page cannot be made.
"""

import re
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from conftest import DATA, RECORDS, REPLAY, imported, robot_named

from acquisition.robot import load_robot
from identification.data import Signals, load_signals
from identification.methods import Iteration
from identification.regression import Overrides
from identification.results import Evidence, identify_iv, identify_ls

PAGE = REPLAY / "published.md"
EMPS = "robot-identify fit emps.mcap --method wls --robot replay_data/emps/robot_published.toml"
ASYMMETRIC = EMPS.replace("published.toml", "published_asymmetric.toml")
TX40_LS = "robot-identify fit tx40.mcap --method wls --robot replay_data/tx40/robot_published.toml"
TX40_IV = "robot-identify fit tx40.mcap --method iv"
SCARA = "robot-identify fit replay_data/scara/session.mcap --method iv"
CROSS = (
    "robot-identify validate emps.json pulses.mcap --robot replay_data/emps/robot_published.toml"
)
HEAD = """# Published digits, and ours

Made by `tests/published.py`, and compared by a test where the real records are there; do not edit.
The records are imported as the READMEs of [EMPS](emps/README.md) and [TX40](tx40/README.md) say.
The time is that of one fit in a running process on two shared cores, with all its tests.

| what | published | ours | command |
|---|---|---|---|
"""
TAIL = """
Sources: EMPS by the authors of the record (A. Janot, M. Gautier, M. Brunot, 2019). TX40: number of
parameters, passes, time by Janot, Vandanjon, Gautier (2014), whose record may be another one;
single values by the earlier identification that came with the record. The cross-test needs
`DATA_EMPS_PULSES.mat` of the benchmark's authors, imported as `pulses.mcap` with its pulses as
`[feedforward]`; it was not at hand. The record of the SCARA is simulated, with values that have the
orders of magnitude of the paper's section 4.
"""
# The earlier identification of this arm, in the source's configuration (figaroh-examples,
# examples/staubli_TX40).
EARLIER = {
    "ZZ1R": 1.24,
    **{f"Fv{j}": v for j, v in enumerate([8.05, 5.53, 1.97, 1.11, 1.86, 0.65], 1)},
    **{f"Fc{j}": v for j, v in enumerate([7.14, 8.26, 6.34, 2.48, 3.03, 0.282], 1)},
    **{f"Ia{j}": v for j, v in enumerate([0.0988, 0.0313, 0.0468, 0.0105], 3)},
    "Fvm6": 0.616,
    "Fcm6": 1.95,
}
Row = tuple[str, str, str, str]


def values(fit: Evidence) -> dict[str, float]:
    return dict(zip(fit.base.names, fit.beta, strict=True))


def error(fit: Evidence) -> float:
    """Of all rows of the fit, behind its own filters."""
    tau = fit.data.observed.tau
    return 100 * np.linalg.norm(tau - fit.data.predicted) / np.linalg.norm(tau)


def emps_rows(recording: Path) -> Iterator[Row]:
    def signals(name: str) -> Signals:
        return load_signals(recording, load_robot(REPLAY / "emps" / name))

    fit = identify_ls(signals("robot_published.toml"), Overrides())
    sigma = dict(zip(fit.base.names, fit.estimate.sigma, strict=True))
    published = {
        "M1": ("kg", "95.1089", "0.1085"),
        "Fv1": ("N s/m", "203.5034", "1.1460"),
        "Fc1": ("N", "20.3935", "0.1012"),
        "Off1": ("N", "-3.1648", "0.0444"),
    }
    for name, (unit, value, deviation) in published.items():
        ours = f"{values(fit)[name]:.4f}, sigma {sigma[name]:.4f}"
        yield f"EMPS, least squares: {name}, {unit}", f"{value}, sigma {deviation}", ours, EMPS
    yield "EMPS, least squares: relative error, %", "4.0834", f"{error(fit):.4f}", EMPS
    yield "EMPS, least squares: cond(W)", "25.9883", f"{fit.estimate.condition_number:.4f}", EMPS
    asymmetric = identify_ls(signals("robot_published_asymmetric.toml"), Overrides())
    published_digits = "95.1540, 166.7061, 20.1440, 240.4236, 20.6277"
    ours = ", ".join(f"{value:.4f}" for value in asymmetric.estimate.beta)
    names = ", ".join(asymmetric.base.names)
    yield f"EMPS, asymmetric friction: {names}", published_digits, ours, ASYMMETRIC
    yield (
        "EMPS, asymmetric friction: relative error, %",
        "3.1117",
        f"{error(asymmetric):.4f}",
        ASYMMETRIC,
    )
    yield "EMPS, cross-test on the record with pulses", "see the benchmark", "not made", CROSS


def tx40_rows(recording: Path) -> Iterator[Row]:
    signals = load_signals(recording)
    ls = identify_ls(
        load_signals(recording, load_robot(REPLAY / "tx40" / "robot_published.toml")), Overrides()
    )
    begin = time.perf_counter()
    iv = identify_iv(signals, Overrides(), Iteration())
    seconds = time.perf_counter() - begin
    yield "TX40: base parameters", "60", str(len(iv.beta)), TX40_IV
    yield "TX40: passes of iv", "3", f"{len(iv.passes)}, {iv.status}", TX40_IV
    yield "TX40: time of iv, s", "11", f"{seconds:.0f} s", TX40_IV
    yield "TX40, least squares: relative error, %", "not stated", f"{error(ls):.2f}", TX40_LS
    for name in ("ZZ1R", "Fv1", "Fc1", "Ia3", "Ia4", "Fvm6", "Fcm6"):
        yield (
            f"TX40, least squares: {name}",
            f"{EARLIER[name]:.3g}",
            f"{values(ls)[name]:.3g}",
            TX40_LS,
        )


def scara_rows() -> Iterator[Row]:
    fit = identify_iv(load_signals(REPLAY / "scara" / "session.mcap"), Overrides(), Iteration())
    robot = robot_named("scara")
    for k, (name, value) in enumerate(zip(fit.base.names, fit.beta, strict=True)):
        if name in robot.parameters:
            half = fit.intervals.half[k]
            yield (
                f"SCARA: {name}",
                f"{robot.parameters[name]:g} (simulated)",
                f"{value:.4f} ± {half:.4f}",
                SCARA,
            )
    yield "SCARA: passes of iv", "not stated", f"{len(fit.passes)}, {fit.status}", SCARA


def page(emps: Path, tx40: Path) -> str:
    """Of the real records as recordings."""
    rows = [*emps_rows(emps), *tx40_rows(tx40), *scara_rows()]
    return HEAD + "".join(f"| {' | '.join(row[:3])} | `{row[3]}` |\n" for row in rows) + TAIL


def without_seconds(text: str) -> str:
    """Times differ from run to run and from machine to machine."""
    return re.sub(r"\| [0-9]+ s \|", "| seconds |", text)


if __name__ == "__main__":
    if not all((DATA / name).exists() for name in RECORDS):
        sys.exit("the real records are not here: see replay_data/README.md")
    with tempfile.TemporaryDirectory() as folder:
        PAGE.write_text(page(*(imported(name, Path(folder) / f"{name}.mcap") for name in RECORDS)))
