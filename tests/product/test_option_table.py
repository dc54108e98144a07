"""Options of robot-identify together, on seconds of two joints: a row is a command and what it must
show.

Every row ends with its exit status, without a traceback, and with one line on standard error where
it is refused. Every option of a row has an effect or a word: without it what is printed or written
is another. What is fitted with the verdict `trust` has the torque of the arm at a motion that
nobody recorded. The recordings are made by another simulator.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from conftest import ACQUIRE, IDENTIFY
from pinocchio_arm import Arm, Torque, arm_of, mujoco_torque
from urdfs import six_joints

import identification
from acquisition.robot import Payload, load_robot
from identification.data import signals_from_arrays
from identification.study import write_signals

JOINTS = ("lift", "elbow")
SECONDS, RATE_HZ = 4.0, 200.0
BOX = Payload(3.0, (0.05, 0.02, 0.3))
OFF = np.array([1.1, 0.9])  # the described drive gains of drives in A, over the true ones
MU = np.array([0.15, 0.15])
MOST_PERCENT = 1.5
MAP = """[time]
column = "time"
unit = "s"
[position]
columns = ["joint_q_1", "joint_q_2"]
unit = "rad"
[velocity]
columns = ["joint_qd_1", "joint_qd_2"]
unit = "rad/s"
[effort]
columns = ["joint_tau_1", "joint_tau_2"]
unit = "N m"
"""


@dataclass(frozen=True, kw_only=True)
class Row:
    command: str
    shows: str  # a regular expression, of what is printed or of JSON
    status: int = 0
    same: tuple[str, ...] = ()  # options that change nothing, as they should
    of: str = "arm"  # whose parameters a trusted fit finds; empty: part of a payload is theirs


def row(command: str, shows: str, status: int = 0, **more):
    return pytest.param(Row(command=command, shows=shows, status=status, **more), id=command)


# Fits that other rows read, and the commands that write them.
FITS = {
    "fit.json": "fit log.mcap",
    "wls.json": "fit log.mcap --method wls",
    "essential.json": "fit log.mcap --essential",
    "consistent.json": "fit log.mcap --consistent",
    "several.json": "fit log.mcap other.mcap",
    "carried.json": "fit loaded.mcap",
    "own.json": "fit log.mcap other.mcap --robot own.toml",
    "rub.json": "fit rub.mcap --robot load.toml",
    "rubless.json": "fit log.mcap --robot load.toml",
    "gains.json": "fit free.mcap box.mcap --gains",
    "amperes.json": "fit blank.mcap",
    "open.json": "fit open.mcap",
}

FIT = [
    row("fit log.mcap", "(?s)[(]IV[)], converged after .*Verdict: trust"),
    row("fit log.mcap --method iv", "[(]IV[)], converged"),
    row("fit log.mcap --method wls", "[(]WLS[)]"),
    row("fit log.mcap --method ols", "[(]OLS[)]"),
    row("fit noref.mcap", "[(]WLS[)]"),
    row("fit noref.mcap --method iv", r"surrogate reference: none recorded"),
    row("fit log.mcap --essential", '"essential": true'),
    row("fit log.mcap --method wls --essential", "WLS"),
    row("fit noref.mcap --method iv --essential", "surrogate reference"),
    row("fit log.mcap --consistent", "chi² increases by"),
    row("fit log.mcap --essential --consistent", "chi² increases by"),
    row("fit log.mcap --method wls --essential --consistent", "chi² increases by"),
    row("fit log.mcap --consistent --prior arm.urdf", "arm.urdf"),
    row("fit log.mcap --prior arm.urdf", "requires --consistent", 1),
    row("fit log.mcap --start regular", '"start": "regular"'),
    row("fit log.mcap --start wls.json", "wls.json"),
    row("fit log.mcap --method wls --start ls", "requires --method iv", 1),
    row("fit noref.mcap --start ls", "only instrumental variables iterate. Use iv", 1),
    row("fit log.mcap --cutoff-hz 12", '"cutoff_hz": 12.0'),
    row("fit noref.mcap --cutoff-hz 12 --torque-lag-s 0.001", '"torque_lag_s": 0.001'),
    row("fit log.mcap --torque-lag-s none", "Verdict: caution"),
    row("fit noref.mcap --torque-lag-s 0.001", '"torque_lag_s": 0.001'),
    row("fit log.mcap --require trust", "Verdict: trust", same=("--require",)),
    row("fit noref.mcap --require trust", "not to be trusted: ", 3),
    row("fit fast.mcap", "Warning: .*velocity"),
]
FILES_OF_FITS = [
    row("fit noref.mcap --report out.md", "Report: out.md"),
    row("fit noref.mcap --report out.html", "Report: out.html"),
    row("fit noref.mcap next.mcap --rrd out.rrd", "out_noref.rrd out_next.rrd"),
    row("fit log.mcap --report out.pdf", "expected .md or .html", 1),
    row("fit log.mcap --report log.mcap", "expected .md or .html", 1),
]
PAYLOAD = [
    row("fit loaded.mcap", "Assumed +payload, drive", of=""),
    row("fit loaded.mcap --payload loaded=none", "trust", of="loaded"),
    row("fit loaded.mcap --payload loaded=unknown", "unknown", of="loaded"),
    row("fit log.mcap --payload loaded=none", "expected NAME=KG", 1),
    row("fit log.mcap loaded.mcap", "3 kg"),
    row("fit log.mcap loaded.mcap --consistent", "chi² increases by"),
    row(
        "validate fit.json log.mcap loaded.mcap --payload log=1@0,0,0.1 --payload loaded=none",
        "Torque error  ",
    ),
    row("fit loaded.mcap --consistent", "chi² increases by", of=""),
    row("fit loaded.mcap --payload loaded=unknown --consistent", "chi² increases by", of="loaded"),
    row("fit loaded.mcap --essential", "3 kg", of=""),
    row("fit loaded.mcap --essential --consistent", "3 kg", of=""),
    row("fit log.mcap loaded.mcap --essential", "3 kg"),
]
SEVERAL = [
    row("fit log.mcap other.mcap", r"other\.mcap"),
    row("fit log.mcap other.mcap --workers 2", r"other\.mcap", same=("--workers",)),
    row("fit log.mcap noref.mcap", "WLS"),
    row("fit log.mcap other.mcap --consistent", "chi² increases by"),
    row("fit log.mcap other.mcap --robot own.toml", "Off1"),
    row("fit log.mcap other.mcap --robot own.toml --consistent", "chi² increases by"),
    row("fit log.mcap --robot own.toml", "Off1"),
    row("fit log.mcap log.mcap", "Pass each recording once", 1),
]
LOAD = [
    row("fit rub.mcap --robot load.toml", '"mu1"', of="rub"),
    row("fit rub.mcap --robot load.toml --essential", '"mu1"', of="rub"),
    row("fit rub.mcap --robot load.toml --consistent", "chi² increases by", of="rub"),
    row("fit log.mcap --robot load.toml", r"load-dependent friction of joint \w+ is left out"),
    row(
        "fit log.mcap --robot load.toml --consistent",
        r"load-dependent friction of joint \w+ is left out",
    ),
    row("friction rub.mcap", "load"),
    row("friction rub.mcap --cutoff-hz 12", "load"),
    row("friction rub.mcap --write", "requires --robot", 1),
]
GAINS = [
    row("fit free.mcap box.mcap", "drive gains"),
    row("fit free.mcap box.mcap --gains", r"motor_1 0\.09\d* ± .*motor_2 0\.11\d* ±"),
    row("fit free.mcap box.mcap --gains motor_2", "motor_2"),
    row("fit free.mcap box.mcap --gains motor_9", "expected one of motor_1, motor_2", 1),
    row("fit free.mcap box.mcap --gains --method wls", "Use iv, or do not estimate gains", 1),
    row("fit free.mcap box.mcap --gains --consistent", "chi² increases by"),
    row("fit free.mcap box.mcap --gains --essential", "motor_1"),
    row("fit free.mcap --gains", "all recordings have the same payload", 1),
    row("fit log.mcap loaded.mcap --gains", r"motor_1 1\.00\d* ±"),
    row("fit blank.mcap", "drive gains are not known", 3),
    row("fit blank.mcap --consistent", "expected a drive gain for every motor", 1),
    row("friction free.mcap --gains", "Use one recording without and one with", 1),
]
VALIDATE = [
    row("validate fit.json other.mcap", "% in motion"),
    row("validate fit.json other.mcap noref.mcap", r"noref\.mcap"),
    row("validate fit.json other.mcap --torque-lag-s 0.002", "% in motion"),
    row("validate fit.json loaded.mcap", "% in motion"),
    row("validate fit.json loaded.mcap --payload loaded=none", "% in motion"),
    row("validate fit.json loaded.mcap --payload loaded=unknown", "Give its mass in kg", 1),
    row("validate fit.json other.mcap --max-error-percent 0.01", "expected at most 0.01 %", 3),
    row(
        "validate fit.json other.mcap --max-error-percent 20",
        "Torque error",
        same=("--max-error-percent",),
    ),
    row("validate consistent.json other.mcap --consistent", "Physically consistent  "),
    row("validate fit.json other.mcap --consistent", "expected `fit --consistent`", 1),
    row("validate essential.json other.mcap", "% in motion"),
    row("validate carried.json log.mcap", "% in motion"),
    row("validate own.json log.mcap", "% in motion"),
    row("validate rub.json log.mcap", "% in motion"),
    row("validate gains.json free.mcap", "% in motion"),
    row("validate fit.json free.mcap", "Torque error   9"),
    row("validate fit.json blank.mcap", "expected A, as recorded", 1),
    row("validate other.mcap fit.json", "the fit first", 1),
    row("validate fit.json other.mcap --report out.html", "% in motion"),
    row(
        "validate fit.json rub.mcap --robot load.toml",
        "mu1",
    ),
]
COMPARE = [
    row("compare fit.json wls.json", "YY1R"),
    row("compare fit.json wls.json --all", "YY1R"),
    row("compare fit.json essential.json", "Fc1"),
    row("compare fit.json arm.urdf", r"MZ1R .* 1 *\n"),
    row("compare fit.json heavy.toml", r"MZ1R .* 0\.5"),
    row("compare fit.json rub.json", "Only in rub: mu1, mu2"),
    row("compare fit.json gains.json", "Fc1"),
    row("compare fit.json amperes.json", "expected kg m², as in fit", 1),
    row("compare fit.json wls.json --report out.html", "Fc1"),
]
EXPORT = [
    *(
        row(f"export {fit}.json --{kind} out.{ending}", rf"out\.{ending}", of=of)
        for fit, of in (
            *(
                (name, "arm")
                for name in ("fit", "wls", "essential", "consistent", "several", "own")
            ),
            *((name, "") for name in ("carried", "rub")),  # MuJoCo has no load friction
        )
        for kind, ending in (("urdf", "urdf"), ("mjcf", "xml"), ("toml", "toml"))
    ),
    row("export gains.json --urdf out.urdf --mjcf out.xml --toml out.toml", "out.toml: .*complete"),
    row(
        "export amperes.json --mjcf out.xml",
        "Export a trusted fit, or allow others .--allow-untrusted",
        1,
    ),
    row("export amperes.json --mjcf out.xml --allow-untrusted", "expected a drive gain", 1),
    row("export fit.json", "Add --urdf, --mjcf or --toml with a file", 1),
    row("export fit.json --mjcf log.mcap", "is a recording. Choose another name", 1),
    row(
        "export rubless.json --mjcf out.xml",
        "out.xml",
    ),
    *(row(f"export open.json --{kind}", "out") for kind in ("mjcf out.xml", "toml out.toml")),
    *(
        row(f"export {fit}.json --mjcf out.xml --draws 2", "2 draws: out_1.xml to out_2.xml", of="")
        for fit in ("essential", "consistent", "own", "gains", "carried")
    ),
    row("export rub.json --urdf out.urdf --draws 10 --seed 2", "out_01.urdf to out_10.urdf", of=""),
    row("export fit.json --mjcf out.xml --seed 2", "--seed = 2: requires --draws", 1),
    row("export fit.json --mjcf robot.toml", "robot.toml", 1),
    row("fit log.mcap --rrd robot.toml", "robot.toml", 1),
]
VIEWED = "view log.mcap -o out.html"
VIEW = [
    row("view log.mcap -o out.rrd", "rerun --bind"),
    row(VIEWED, "in a browser"),
    row("view log.mcap --cutoff-hz 12 -o out.html", "in a browser"),
    row("view log.mcap --fit fit.json", "requires --follow", 1),
    row("view log.mcap other.mcap -o out.rrd", "one file cannot show 2 recordings", 1),
]
ROWS = [*FIT, *FILES_OF_FITS, *PAYLOAD, *SEVERAL, *LOAD, *GAINS]
ROWS += [*VALIDATE, *COMPARE, *EXPORT, *VIEW]


@dataclass(frozen=True, kw_only=True)
class Result:
    status: int
    out: str
    err: str
    files: dict[str, bytes]  # that were written

    @property
    def text(self) -> str:
        return self.out + self.err + self.files.get("out.json", b"").decode()

    @property
    def told(self) -> object:
        """What options change; a picture is there or not."""
        kept = {name: x if not name.endswith(".rrd") else b"" for name, x in self.files.items()}
        return self.status, self.out, self.err, kept


class Desk:
    """A folder of recordings and descriptions, and what commands did there."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.found, self.arms = folder, dict[str, Result](), made(folder)

    def run(self, command: str, capsys: pytest.CaptureFixture[str]) -> Result:
        """The result of a command, made once; the folder is then as before."""
        if command not in self.found:
            for name in FITS.keys() & set(command.split()):
                if not (self.folder / name).exists():
                    (self.folder / name).write_bytes(self.run(FITS[name], capsys).files["out.json"])
            self.found[command] = self._run(command.split(), capsys)
        return self.found[command]

    def _run(self, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> Result:
        if arguments[0] in ("fit", "validate", "compare", "friction"):
            arguments += ["--json", "out.json"]
        if arguments[0] == "fit" and "--workers" not in arguments:
            arguments += ["--workers", "1"]
        before = self._files()
        capsys.readouterr()
        try:
            status = IDENTIFY.main(arguments)
        finally:
            written = {name: x for name, x in self._files().items() if before.get(name) != x}
            for name in written:
                (self.folder / name).unlink()
            for name in written.keys() & before.keys():
                (self.folder / name).write_bytes(before[name])
        out, err = capsys.readouterr()
        return Result(status=status, out=out, err=err, files=written)

    def _files(self) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in self.folder.iterdir()}


def made(folder: Path) -> dict[str, Arm]:
    """Descriptions and recordings, written; the arm by what it carries."""
    (folder / "arm.urdf").write_text(six_joints())
    torques, amperes = ["--effort", "N m"], ["--effort", "A", "--ratio", "100"]
    for name, given in (
        ("open", torques),
        ("robot", [*torques, "--bandwidth-hz", "8"]),
        ("blank", [*amperes, "--bandwidth-hz", "8"]),
        ("amps", [*amperes, "--bandwidth-hz", "8", "--drive-gain", "0.1"]),
    ):
        files = [str(folder / "arm.urdf"), "-o", str(folder / f"{name}.toml")]
        assert IDENTIFY.main(["init", *files, "--joints", ",".join(JOINTS), *given]) == 0
    plain = (folder / "robot.toml").read_text()
    joint, terms = 'type = "revolute"\n', '["viscous", "coulomb", "{}"]'
    for name, old, new in (
        ("load", joint, f"{joint}friction = {terms.format('load')}\n"),
        ("own", joint, f"{joint}friction = {terms.format('offset')}\n"),
        ("own", "[parameters]", '[identification]\nown = ["Off"]\n[parameters]'),
        ("heavy", "M2 = ", "M2 = 1"),
    ):
        path = folder / f"{name}.toml"
        text = path.read_text() if path.exists() else plain
        path.write_text(text.replace(old, new))
    arm = arm_of(six_joints(), JOINTS)
    model = arm.model.copy()
    model.inertias[2] += pin.Inertia(BOX.mass_kg, np.array(BOX.center_of_mass_m), np.zeros((3, 3)))
    carrying, rubbing = replace(arm, model=model), replace(arm, mu=MU)
    for seed, (name, body, robot, scale) in enumerate(
        (
            ("log", arm, "robot", 1.0),
            ("other", arm, "robot", 1.0),
            ("noref", arm, "robot", 1.0),
            ("next", arm, "robot", 1.0),
            ("open", arm, "open", 1.0),
            ("loaded", carrying, "robot", 1.0),
            ("rub", rubbing, "robot", 1.0),
            ("free", arm, "amps", OFF),
            ("box", carrying, "amps", OFF),
            ("blank", arm, "blank", 0.1),
        )
    ):
        described = load_robot(folder / f"{robot}.toml")
        q, torque, q_ref = body.driven(seed, SECONDS, RATE_HZ)
        q_ref = None if name in ("noref", "next") else q_ref
        signals = signals_from_arrays(q, scale * torque, RATE_HZ, described, q_ref)
        write_signals(
            folder / f"{name}.mcap",
            replace(signals, payload=BOX if body is carrying else None),
            source="",
        )
    q, torque, _ = arm.driven(0, SECONDS, RATE_HZ)
    columns = [np.arange(len(q)) / RATE_HZ, q, torque, 1.3 * np.gradient(q, 1 / RATE_HZ, axis=0)]
    np.savetxt(
        folder / "fast.csv", np.column_stack(columns), delimiter=",", comments="",
        header="time,joint_q_1,joint_q_2,joint_tau_1,joint_tau_2,joint_qd_1,joint_qd_2",
    )  # fmt: skip
    (folder / "map.toml").write_text(MAP)
    robot, by, fast = (str(folder / name) for name in ("robot.toml", "map.toml", "fast"))
    given = ["--robot", robot, "--map", by, "-o", f"{fast}.mcap"]
    assert ACQUIRE.main(["import", f"{fast}.csv", *given]) == 0
    return {"arm": arm, "loaded": carrying, "rub": rubbing}


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Desk:
    return Desk(tmp_path_factory.mktemp("desk"))


def options_of(command: str) -> list[tuple[str, str]]:
    """Each option with its values, and the command without it."""
    head, *options = re.split(r" (?=--|-o )", command)
    return [
        (one, " ".join([head, *options[:k], *options[k + 1 :]])) for k, one in enumerate(options)
    ]


@pytest.mark.parametrize("row", ROWS)
def test_options(row, desk, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(desk.folder)
    result = desk.run(row.command, capsys)
    assert result.status == row.status, result.err
    assert re.search(row.shows, result.text), result.text
    if row.status == 0:
        assert result.err == ""
    else:
        assert result.err.startswith("robot-identify: ")
        assert result.err.count("\n") == 1
    for option, without in options_of(row.command):
        changed = desk.run(without, capsys).told != result.told
        assert changed != (option.split()[0] in row.same), f"{option} has no effect"
    if row.of:
        found = torques_of(result, tmp_path)
        assert all(desk.arms[row.of].errors_percent(one).max() < MOST_PERCENT for one in found)


def torques_of(result: Result, folder: Path) -> Iterator[Torque]:
    """Of a trusted fit, and of a model for MuJoCo."""
    for name in {"out.json", "out.xml"} & result.files.keys():
        (folder / name).write_bytes(result.files[name])
    if re.search(r"^ \"verdict\": \"trust\"", result.text, re.MULTILINE):
        yield identification.load(folder / "out.json").predict
    if "out.xml" in result.files:
        yield mujoco_torque(str(folder / "out.xml"))


def test_same_command_writes_same_output(desk, monkeypatch, capsys):
    """Else no difference would be an option's."""
    monkeypatch.chdir(desk.folder)
    for command in ("fit noref.mcap --consistent", "validate fit.json other.mcap", VIEWED):
        first = desk.run(command, capsys)
        assert desk._run(command.split(), capsys).told == first.told
