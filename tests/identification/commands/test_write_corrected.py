"""Faults of a description and of a map, in recordings of an independent simulator: each is mended
to the fit without it, or refused with the line to change.

The table has motor positions in rad and currents in A. Its true description has motors that turn
against their joints, and a zero. A fault is what is wrong in robot.toml, in map.toml or in columns.
"""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from command_runs import refused, run
from independent_simulator import Imperfections, designed_pd, references, simulate
from independent_urdf import arm_of
from urdfs import SIX, six_joints

from acquisition.commands import main as acquire
from acquisition.recording import read_recording
from acquisition.robot import load_robot
from identification.trust import prior

NAMES, RATE_HZ, GAIN = [name for name, *_ in SIX], 250.0, 0.13
RATIO, ZERO_DEG = np.array([101, -101, 101, 50, -50, 50]), np.array([0, 0, 30, 0, 0, 0])
KEYS = 'drive_gain = 0.13\ndrive_gain_unit = "N m/A"'
TABLE = '[{}]\ncolumns = {}\nunit = "{}"\nside = "motor"\n'


@cache
def columns() -> dict[str, np.ndarray]:
    """Motor positions, references and currents (N, 6), by the beginnings of their names."""
    body, _ = arm_of(six_joints())
    path = references(body, [1], duration_s=8.0, rate_hz=RATE_HZ)
    cell = Imperfections(torque_noise_percent=2.0, encoder_noise=2e-5)
    runs = simulate(body, designed_pd(body, 6.0, RATE_HZ), path, cell, seed=1, substeps=1)
    at_motor = {"p": runs.q[0], "r": runs.q_ref[0]}
    moved = {name: RATIO * (q - np.deg2rad(ZERO_DEG)) for name, q in at_motor.items()}
    return {**moved, "i": runs.effort[0] / (RATIO * GAIN)}


def described() -> str:
    """The true robot.toml, with remarks."""
    head = '# my arm\nname = "six"\nurdf = "arm.urdf"\n[controller]\nbandwidth_hz = 6\n'
    return head + "".join(
        f'[[joint]]\nname = "{name}"\ntype = "revolute"\nzero_deg = {zero} # measured\n'
        f'[[motor]]\nname = "m_{name}"\nratio = {ratio} # gear\n{KEYS}\n'
        for name, ratio, zero in zip(NAMES, RATIO, ZERO_DEG, strict=True)
    )


def mapped() -> str:
    parts = (("position", "p", "rad"), ("reference", "r", "rad"), ("effort", "i", "A"))
    return f"sample_rate_hz = {RATE_HZ}\n" + "".join(
        TABLE.format(name, json.dumps([f"{column}{j}" for j in range(6)]), unit)
        for name, column, unit in parts
    )


def turned(*joints: int, of: str = "ratio", by: str = "-") -> Callable[[str], str]:
    """A change of robot.toml: another value of a key of these joints."""

    def change(text: str) -> str:
        head, *parts = re.split(r"(?=\[\[joint\]\])", text)
        for j in joints:
            parts[j] = re.sub(rf"{of} = (-?)", rf"{of} = {by}\g<1>", parts[j]).replace("--", "")
        return head + "".join(parts)

    return change


def negated(names: str, *joints: int) -> Callable[[dict], dict]:
    factor = np.where(np.isin(np.arange(6), joints), -1, 1)
    return lambda x: x | {name: x[name] * factor for name in names}


def swapped(text: str, *names: str) -> str:
    """map.toml with columns of motors 3 and 4 swapped, whose gears differ."""
    for name in names:
        text = text.replace(f'"{name}2", "{name}3"', f'"{name}3", "{name}2"')
    return text


@dataclass(frozen=True, kw_only=True)
class Fault:
    """Changes of robot.toml, map.toml and columns; what the refusal says, empty if mended.

    links: largest error of the masses and inertias in the URDF.
    """

    toml: Callable[[str], str] = str
    map: Callable[[str], str] = str
    table: Callable[[dict], dict] = dict
    says: str = ""
    unconfirmed: tuple[str, ...] = ()
    links: float = 0.2
    options: tuple[str, ...] = ("--method", "wls")


def of_torque(text: str) -> str:
    """With torques in place of currents."""
    return text.replace(KEYS, 'effort_unit = "N m"')


FAULTS = {
    "joint 2 counts backwards": Fault(
        toml=turned(1), unconfirmed=("lift",), options=("--method", "wls", "--brief")
    ),
    "joints 2 and 5 count backwards": Fault(
        toml=turned(1, 4), unconfirmed=("lift", "wrist_2"), options=()
    ),
    "the same with links 30 % off": Fault(
        toml=turned(1, 4), unconfirmed=("lift", "wrist_2"), links=0.3
    ),
    "all count backwards": Fault(toml=turned(*range(6)), unconfirmed=tuple(NAMES)),
    "zero of joint 3 off by 90": Fault(
        toml=lambda x: x.replace("= 30 #", "= 120 #"), unconfirmed=("elbow",)
    ),
    "zero of joint 3 off by -90": Fault(
        toml=lambda x: x.replace("= 30 #", "= -60 #"), unconfirmed=("elbow",)
    ),
    "zero of joint 4 off by 180": Fault(
        toml=turned(3, of="zero_deg", by="18"), unconfirmed=("wrist_1",)
    ),
    "joint 2 backwards, zero of joint 3": Fault(
        toml=lambda x: turned(1)(x).replace("= 30 #", "= 120 #"), unconfirmed=("lift", "elbow")
    ),
    "gravity points up": Fault(
        toml=lambda x: "gravity_m_s2 = [0, 0, 9.81]\n" + x, unconfirmed=tuple(NAMES)
    ),
    "mA taken as A": Fault(
        table=lambda x: x | {"i": 1e3 * x["i"]}, unconfirmed=tuple(NAMES), links=0.3
    ),
    "sign of the position of joint 3": Fault(
        table=negated("pr", 2),
        says="the position of m_elbow has the wrong sign, which no robot.toml corrects. Check "
        "this: set signs = [1, 1, -1, 1, 1, 1] in [position] and [reference] of map.toml, or sign "
        "and effort_sign in [[bus.drive]], and import again",
    ),
    "sign of the effort of joint 4": Fault(
        table=negated("i", 3),
        says="the effort of m_wrist_1 has the wrong sign, which no robot.toml corrects. Check "
        "this: set signs = [1, 1, 1, -1, 1, 1] in [effort] of map.toml, or effort_sign in "
        "[[bus.drive]], and import again",
    ),
    "sign of all efforts": Fault(
        table=negated("i", *range(6)),
        says="the effort of all joints has the wrong sign, which no robot.toml corrects. Check "
        "this: set signs = [-1, -1, -1, -1, -1, -1] in [effort] of map.toml, or effort_sign in "
        "[[bus.drive]], and import again",
    ),
    "positions swapped": Fault(
        map=lambda x: swapped(x, "p", "r"),
        says="the positions of m_elbow and m_wrist_1 are swapped, which no robot.toml corrects. "
        "Check this: swap both in columns of [position] and [reference] in map.toml, and import "
        "again",
    ),
    "efforts swapped": Fault(
        map=lambda x: swapped(x, "i"),
        says="the efforts of m_elbow and m_wrist_1 are swapped, which no robot.toml corrects. "
        "Check this: swap both in columns of [effort] in map.toml, and import again",
    ),
    "channels swapped": Fault(
        map=lambda x: swapped(x, "p", "r", "i"),
        says="the channels of m_elbow and m_wrist_1 are swapped, which no robot.toml corrects. "
        "Check this: swap both in all columns of map.toml, or node of both in [[bus.drive]], and "
        "import again",
    ),
    "rad taken as deg": Fault(
        map=lambda x: x.replace('"rad"', '"deg"'),
        says="the position of all joints is in rad, declared as degrees, which no robot.toml "
        'corrects. Check this: set unit = "rad" in [position] and [reference] of map.toml, and '
        "import again",
    ),
    "N m at the motor taken as at the joint": Fault(
        toml=of_torque,
        table=lambda x: x | {"i": x["i"] * GAIN},
        map=lambda x: x.replace('"A"\nside = "motor"', '"N m"\nside = "joint"'),
        says="the efforts are those of the motors, which no robot.toml corrects. Check this: set "
        'side = "motor" in [effort] of map.toml, and import again',
    ),
    "no ratio": Fault(
        toml=lambda x: of_torque(re.sub("ratio = .*", "", x)),
        table=lambda x: (
            {k: v / RATIO for k, v in x.items()} | {"i": x["i"] * GAIN * np.sign(RATIO)}
        ),
        map=lambda x: x.replace('"A"', '"N m"'),
        says="no test names a sign, zero or gain to be corrected, so nothing is written",
    ),
    "none": Fault(says="no test names a sign, zero or gain to be corrected, so nothing is written"),
}


def record(folder: Path, fault: Fault) -> Path:
    """Write the table of a fault and import it, as log.mcap."""
    factors = np.random.default_rng(0).uniform(1 - fault.links, 1 + fault.links, 6)
    (folder / "arm.urdf").write_text(six_joints(factors))
    parts = fault.table(columns())
    header = ",".join(f"{name}{j}" for name in parts for j in range(6))
    rows = np.column_stack([*parts.values()])
    np.savetxt(folder / "log.csv", rows, "%.12g", ",", header=header, comments="")
    (folder / "robot.toml").write_text(fault.toml(described()))
    (folder / "map.toml").write_text(fault.map(mapped()))
    return again(folder, "robot.toml", "log.mcap")


def again(folder: Path, robot: str, out: str) -> Path:
    paths = [str(folder / name) for name in ("log.csv", robot, "map.toml", out)]
    assert (
        acquire(["import", paths[0], "--robot", paths[1], "--map", paths[2], "-o", paths[3]]) == 0
    )
    return folder / out


def values(path: Path) -> dict[str, dict]:
    return {one["name"]: one for one in json.loads(path.read_text())["parameters"]}


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """By the options of a fit the parameters without a fault, and their recording."""
    folder, found = tmp_path_factory.mktemp("clean"), {}
    log = record(folder, Fault())

    def by(capsys, options: tuple[str, ...]) -> dict[str, dict]:
        if options not in found:
            assert run(capsys, "fit", log, *options, "--json", folder / "fit.json")[0] == 0
            found[options] = values(folder / "fit.json")
        return found[options]

    return by, log


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_fault_is_mended_or_refused(tmp_path, capsys, clean, fault):
    log, new, stored = (record(tmp_path, fault), tmp_path / "robot2.toml", tmp_path / "fit.json")
    command = "fit", log, *fault.options, "--json", stored, "--write-corrected", new
    if fault.says:
        assert fault.says in refused(capsys, *command)
        assert not new.exists()
        assert not stored.exists()
        return
    status, out, err = run(capsys, *command)
    assert status in (0, 3), err
    fit, robot, true = (
        json.loads(stored.read_text()),
        load_robot(new),
        clean[0](capsys, fault.options),
    )
    assert robot.unconfirmed == fault.unconfirmed
    assert fit["corrected"]
    if "--brief" in fault.options:
        assert "\nVerdict: " in out
        shown = out.split("Corrected")[1]
    else:
        shown = out.split("Check its joints before motion:")[1].split("Verdict: ")[0]
    assert " ".join(shown.split()).startswith(fit["corrected"][0])
    for name in fault.unconfirmed:
        warning = f"joint {name} was corrected from a recording, and nobody has checked it yet"
        assert warning in fit["warnings"]
    found = values(stored)
    assert found.keys() == true.keys()
    for name, one in true.items():
        assert abs(found[name]["value"] - one["value"]) <= one["high"] - one["low"], name
    # Signs and zeros are those of the true description, and all remarks are there.
    text = new.read_text()
    assert text.count("# gear") == text.count("# measured") == 6
    assert "# my arm\n" in text
    np.testing.assert_array_equal(np.diag(robot.R), RATIO)
    off = (np.rad2deg(robot.zero) - ZERO_DEG) % 360
    np.testing.assert_allclose(np.minimum(off, 360 - off), 0, atol=1e-6)
    # Imported with it, the table gives the recording without the fault.
    other = again(tmp_path, "robot2.toml", "again.mcap")
    recorded, wanted = (read_recording(path).samples for path in (other, clean[1]))
    np.testing.assert_allclose(recorded["effort"], wanted["effort"], atol=1e-6)
    if not fault.options:
        assert run(capsys, "validate", stored, other)[0] == 0
        assert run(capsys, "export", stored, "--toml", tmp_path / "model.toml")[0] == 0
        assert load_robot(tmp_path / "model.toml").unconfirmed == fault.unconfirmed
        assert "the file already exists. Choose a new name" in refused(capsys, *command)


def test_advice_names_option_and_line(tmp_path, capsys):
    for fault, advice in (
        (FAULTS["joint 2 counts backwards"], "`fit --write-corrected ROBOT.toml` writes a"),
        (FAULTS["sign of the effort of joint 4"], "set signs = [1, 1, 1, -1, 1, 1] in [effort]"),
    ):
        log = record(tmp_path, fault)
        command = "fit", log, "--method", "wls", "--json", tmp_path / "fit.json"
        _, out, _ = run(capsys, *command)
        (line,) = (
            x
            for x in json.loads((tmp_path / "fit.json").read_text())["trust"]
            if x["test"] == "a priori links"
        )
        assert advice in line["advice"]
        assert "→ Check this" in out
        assert "corrected" not in json.loads((tmp_path / "fit.json").read_text())
        for name in ("log.mcap", "fit.json"):
            (tmp_path / name).unlink()


def test_undecided_mistake_is_refused(tmp_path, capsys, monkeypatch):
    """The links hardly tell these two apart; here least squares does not either."""
    monkeypatch.setattr(prior, "errors_of", lambda _, tried: [1.0] * len(tried))
    log, new = record(tmp_path, FAULTS["joints 2 and 5 count backwards"]), tmp_path / "new.toml"
    said = refused(capsys, "fit", log, "--method", "wls", "--write-corrected", new)
    assert (
        "position and effort of m_wrist_2 have the wrong sign, or position and effort of " in said
    )
    assert "the zero of wrist_2 is wrong by 180 deg. With this corrected" in said
    assert "Check which it is, and correct the description" in said
    assert not new.exists()


@pytest.mark.parametrize("name", ["sign of the position of joint 3", "sign of all efforts"])
def test_line_of_refusal_mends_the_import(tmp_path, capsys, clean, name):
    record(tmp_path, FAULTS[name])
    signs, tables = re.search(
        r"(signs = \S+(?: \S+)*?\]) in (.*?) of map", FAULTS[name].says
    ).groups()
    text = (tmp_path / "map.toml").read_text()
    for table in re.findall(r"\[\w+\]", tables):
        text = text.replace(f"{table}\n", f"{table}\n{signs}\n")
    (tmp_path / "map.toml").write_text(text)
    mended, wanted = (
        read_recording(path).samples
        for path in (again(tmp_path, "robot.toml", "mended.mcap"), clean[1])
    )
    for part in ("position", "reference", "effort"):
        np.testing.assert_allclose(mended[part], wanted[part], atol=1e-9)
