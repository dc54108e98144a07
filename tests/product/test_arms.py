"""The page of arms with numbers: it is up to date, its models have the parameters of the fits, and
fits whose records are here come out again.
"""

import json
import re
import runpy
import shutil

import mujoco
import numpy as np
import pytest
from command_runs import run
from conftest import REPLAY
from fits_of_records import iv_of, ls_of, signals_of
from published import EARLIER
from scipy.signal import butter, filtfilt

from identification import Fit, fit, read_fit
from identification.data import signals_from_arrays
from identification.export import model_of_fit
from identification.model import InverseModel
from identification.report import OF_LINKS
from identification.results import consistent_fit, stored_robot, stored_torque

FOLDER, PAGE = REPLAY / "arms", REPLAY / "arms.md"
SCRIPT = runpy.run_path(str(REPLAY / "arms.py"))
FITS = {path.stem: read_fit(path) for path in sorted(FOLDER.glob("*.json"))}
NUMBER = r"-?\d+(?:\.\d+)?(?:e[+-]\d+)?"


@pytest.fixture(scope="module")
def again(tmp_path_factory):
    """The page as it is made now, and the folder of its models."""
    out = tmp_path_factory.mktemp("models")
    return SCRIPT["page"](FOLDER, out), out


def test_page_is_up_to_date(again):
    assert PAGE.read_text(encoding="utf-8") == again[0], "run `python replay_data/arms.py`"
    assert {"emps", "kr300", "panda", "rokae_xmate", "tx40", "ur10e"} <= set(FITS)
    files = {f"{name}.{kind}" for name in FITS for kind in ("json", "toml", "xml")}
    assert {path.name for path in FOLDER.iterdir()} == files


CHANGES = {
    "moving_relative_error_percent": (lambda x: 1.1 * x, {"| 6 | weighted LS |"}),
    "held_out_error_percent": (lambda x: 1.1 * x, {"| 6 | weighted LS |", "**Cross-validation**"}),
    "verdict": (lambda x: "trust", {"| 6 | weighted LS |", "Verdict: trust"}),
    "trust": (lambda x: x[1:], {"2 of 14 tests"}),
    "parameters": (
        lambda x: [{**one, "value": 1.1 * one["value"], "high": one["high"] + 1} for one in x],
        {"| ZZ1R, kg m² | 1.24 | 1.372 ± 0.54 |", "| ZZ1R | 1.3716 | 0.5414 |"},
    ),
}


@pytest.mark.parametrize("key", CHANGES)
def test_numbers_are_those_of_fit(key, tmp_path):
    """A fit that changes is another page, in the lines of what changed."""
    change, shown = CHANGES[key]
    shutil.copy(FOLDER / "tx40.toml", tmp_path)
    content = json.loads((FOLDER / "tx40.json").read_text())
    content[key] = change(content[key])
    (tmp_path / "tx40.json").write_text(json.dumps(content))
    known = PAGE.read_text(encoding="utf-8").splitlines()
    made = SCRIPT["page"](tmp_path, tmp_path).splitlines()
    lines = "\n".join(line for line in made if line not in known)
    assert all(line in lines for line in shown), lines


def test_refused_model_is_explained(tmp_path):
    """Anyone adds an arm by two files; a fit that is not to be used has no model."""
    shutil.copy(FOLDER / "emps.toml", tmp_path / "mine.toml")
    content = json.loads((FOLDER / "emps.json").read_text()) | {"verdict": "do not use"}
    (tmp_path / "mine.json").write_text(json.dumps(content))
    text = SCRIPT["page"](tmp_path, tmp_path)
    assert "There is no model for MuJoCo: the fit is not exported: mine.json: verdict do" in text
    assert not (tmp_path / "mine.xml").exists()


@pytest.mark.parametrize("name", FITS)
def test_model_is_that_of_fit(name, again):
    """Base parameters found from torques of MuJoCo, without friction, are those of the fit."""
    texts = [(folder / f"{name}.xml").read_text() for folder in (FOLDER, again[1])]
    stored, made = (np.array(re.findall(NUMBER, text), dtype=float) for text in texts)
    np.testing.assert_allclose(stored, made, rtol=1e-5, atol=1e-9)
    assert len({re.sub(NUMBER, "", text) for text in texts}) == 1
    model = mujoco.MjModel.from_xml_string(texts[0])
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.dof_damping[:] = model.tendon_damping[:] = 0
    data, motion = mujoco.MjData(model), np.random.default_rng(0).uniform(-2, 2, (3, 200, model.nv))
    torque = np.empty(motion.shape[1:])
    for k in range(len(torque)):
        data.qpos, data.qvel, data.qacc = motion[:, k]
        mujoco.mj_inverse(model, data)
        torque[k] = data.qfrc_inverse
    file, base = FITS[name].file, FITS[name].base
    inertial = [x.startswith(("Ia", *OF_LINKS)) for x in base.names]
    W = InverseModel(stored_robot(file, name)).regressor(*motion).reshape(torque.size, -1)
    found, *_ = np.linalg.lstsq((W @ np.linalg.pinv(base.K))[:, inertial], torque.ravel())
    consistent = base.K @ model_of_fit(file, name)[0].chi
    np.testing.assert_allclose(found, consistent[inertial], rtol=1e-5, atol=1e-9)
    half = np.array([p.half for p in FITS[name].parameters])
    assert np.abs((found - FITS[name].beta[inertial]) / half[inertial]).max() < 2.0


@pytest.mark.parametrize("name", [k for k, x in FITS.items() if not x.file.error_cutoff_hz])
def test_earlier_fits_are_usable(name, tmp_path, capsys):
    """By `validate`, on their own torque along sines, and by commands."""
    one, robot = FITS[name], stored_robot(FITS[name].file, name)
    rate_hz, w = one.file.sample_rate_hz, 2 * np.pi * (0.25 + 0.07 * np.arange(robot.n))
    t = np.arange(0, 8, 1 / rate_hz)[:, None]
    q, dq, ddq = 0.6 * np.sin(w * t), 0.6 * w * np.cos(w * t), -0.6 * w**2 * np.sin(w * t)
    log = signals_from_arrays(q, one.predict(q, dq, ddq), rate_hz, robot)
    assert one.validate(log).moving_relative_error_percent < 0.1
    path, drawn = FOLDER / f"{name}.json", tmp_path / "x.html"
    assert run(capsys, "compare", path, path)[0] == 0
    assert run(capsys, "view", path, "-o", drawn)[0] == 0
    assert drawn.exists()
    assert one.compare(one)[0].off == 0.0


@pytest.mark.parametrize(("name", "method"), [("emps", iv_of), ("tx40", ls_of)])
def test_fits_of_records_come_out_again(name, method, request):
    stored, made = FITS[name], Fit.of(method(request.getfixturevalue(name)))
    assert (made.verdict, made.file.method) == (stored.verdict, stored.file.method)
    half = np.array([p.half for p in stored.parameters])
    np.testing.assert_array_less(np.abs(made.beta - stored.beta), 0.01 * half)
    np.testing.assert_allclose([p.half for p in made.parameters], half, rtol=0.02)
    names = made.file.essential.names
    assert names == tuple(p.name for p in stored.parameters if p.essential)
    if name == "emps":  # its README too
        M, Fv, Fc = made.parameters[:3]
        text = f"M {M.value:.2f} ± {M.half:.2f} kg, Fv {Fv.value:.0f} ± {Fv.half:.0f} N s/m, "
        assert (
            f"{text}Fc {Fc.value:.1f} ± {Fc.half:.1f} N" in (REPLAY / "emps/README.md").read_text()
        )


def test_figures_beside_those_of_figaroh(tx40):
    """Its protocol: fits of the first 24 750 samples, 240 of those from 29 250 on predicted."""
    signals, robot = signals_of(tx40), REPLAY / "tx40" / "robot.toml"
    low_pass = butter(4, 100.0, fs=5000.0)
    q = filtfilt(*low_pass, signals.q[29250:], axis=0)
    dq = np.gradient(q, 1 / 5000.0, axis=0)
    ddq = np.gradient(dq, 1 / 5000.0, axis=0)
    rows = np.linspace(40, len(q) - 41, 240, dtype=int)
    found = []
    for low_speed_percent in (None, 0.0):
        made = fit(
            signals.q[:24750],
            signals.effort[:24750],
            5000.0,
            robot,
            low_speed_percent=low_speed_percent,
        ).consistent()
        for file in (made.file, consistent_fit(made.file, "tx40")):
            error = signals.effort[29250:][rows] - stored_torque(
                file, "", q[rows], dq[rows], ddq[rows]
            )
            found.append(np.sqrt(np.mean(error**2)))
    figaroh, earlier = SCRIPT["read_arms"](FOLDER)[sorted(FITS).index("tx40")].origin.published
    ours = [float(x) for _, told in figaroh.figures.values() for x in re.findall(r"\d\.\d+", told)]
    np.testing.assert_allclose(ours, np.array(found)[[0, 2, 1, 3]], atol=0.0051)
    assert earlier.values == EARLIER
