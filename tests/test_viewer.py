"""The Rerun file of a fit: its layout shows only what is there, and what is there is what was measured and modelled."""

import re
import resource
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conftest import robot_named
from rerun.chunk import RrdReader

from acquisition.errors import AcquisitionError
from acquisition.robot import robot_from_files
from identification.data import Signals
from identification.methods import Iteration, identify_iv, identify_ls
from identification.model import InverseModel, base_parameters
from identification.regression import Decimation, FilteredMotion, Motion, Overrides, differentiate, predicted_torque
from identification.study import Noise, closed_loop, random_reference
from identification.view import curves, draw_fit, rerun_panels, write_rrd
from identification.view.curves import extremes, readable_unit

FS = 1000.0


def robot_with(types, unit):
    text = 'name = "made up"\n'
    for j, kind in enumerate(types):
        dh = f"{{ alpha_deg = {(0, -90, 90)[j % 3]}, d_m = {0.2 * (j > 0)}, theta_deg = 0, r_m = {0.1 * j} }}"
        text += f'[[joint]]\nname = "joint {j + 1}.x"\ntype = "{kind}"\ndh = {dh}\noffset = true\n'
        text += f'rotor_inertia = {"true" if j else "false"}\n[[motor]]\nname = "m{j}"\neffort_unit = "{unit}"\n'
    return robot_from_files({"robot.toml": (text + "[controller]\nbandwidth_hz = 10.0\n").encode()}, "made up")


@cache
def made_up(types=("revolute", "prismatic"), unit="N m", samples=4000, reference=False, noise=1e-6):
    """A robot that obeys its model, with noise on position and torque."""
    rng = np.random.default_rng(5)
    robot, t = robot_with(types, unit), np.arange(samples) / FS
    f = np.array([0.3, 0.7, 1.1, 1.9, 2.3])[:, None, None] * 4000 / samples + 0.5
    phase, size = rng.uniform(0, 6, (5, 1, robot.n)), rng.uniform(0.1, 0.3, (5, 1, robot.n))
    q = (size * np.sin(2 * np.pi * f * t[:, None] + phase)).sum(axis=0)
    dq = differentiate(q, FS)
    motion = Motion(t_s=t, q=q, dq=dq, ddq=differentiate(dq, FS), tau=np.zeros_like(q))
    idm = InverseModel(robot)
    base = base_parameters(idm)
    tau = predicted_torque(motion, idm, base, rng.uniform(0.5, 2, base.b))
    return Signals(
        t_s=t,
        q=q + noise * rng.standard_normal(q.shape),
        q_ref=q + 0.01 if reference else None,
        effort=tau + 0.05 * tau.std() * rng.standard_normal(tau.shape),
        sample_rate_hz=FS,
        track=None,
        robot=robot,
        recording="made_up.mcap",
        sha256="0" * 64,
    )


@cache
def fitted(signals, cutoff_hz=None, essential=False):
    return identify_ls(signals, Overrides(cutoff_hz=cutoff_hz), essential=essential)


@cache
def fitted_iv(signals):
    return identify_iv(signals, Overrides(), Iteration())


@cache
def scara():
    """A robot that can be simulated, tracking a reference."""
    robot = robot_named("scara")
    q_ref = random_reference(robot, duration_s=6.0, sample_rate_hz=FS, seed=1)
    return closed_loop(robot, q_ref, FS, noise=Noise(effort_percent=1.0), seed=1)


class Written:
    """A file read back: `curves` as (t_ns, values) and `static` columns by entity path; the layout's views."""

    def __init__(self, path):
        reader = RrdReader(path)
        (recording,), (blueprint,) = reader.recordings(), reader.blueprints()
        self.application = recording.application_id
        self.curves, self.static, self.views, self.moving = {}, {}, {}, {}
        for chunk in reader.stream(store=recording).to_chunks():
            batch = chunk.to_record_batch()
            columns = {name: batch.column(name) for name in batch.schema.names}
            if chunk.is_static:
                self.static.setdefault(chunk.entity_path, {}).update({k: v.to_pylist()[0] for k, v in columns.items()})
            else:
                (timeline,) = chunk.timeline_names
                assert timeline == "time"
                if "Scalars:scalars" not in columns:
                    assert chunk.entity_path not in self.moving, "in one piece"
                    self.moving[chunk.entity_path] = {name: c.to_pylist() for name, c in columns.items()}
                    continue
                t = columns["time"].to_numpy(zero_copy_only=False).astype(np.int64)
                x = np.array([row[0] for row in columns["Scalars:scalars"].to_pylist()])
                assert chunk.entity_path not in self.curves, "in one piece"
                self.curves[chunk.entity_path] = (t, x)
        for chunk in reader.stream(store=blueprint).to_chunks():
            batch = chunk.to_record_batch()
            if "ViewBlueprint:space_origin" in batch.schema.names:
                kind, title, origin = (
                    batch.column(f"ViewBlueprint:{name}").to_pylist()[0][0]
                    for name in ("class_identifier", "display_name", "space_origin")
                )
                self.views["/" + origin.lstrip("/")] = (kind, title)

    def curve(self, *path):
        t, x = self.curves["/" + "/".join(part.replace(" ", "\\ ") for part in path)]
        return np.rint(t * 1e-9 * FS).astype(int), x

    def holds(self, origin, kind):
        """Whether there is something below `origin` that a view of this kind shows."""
        below = {path: columns for path, columns in self.static.items() if f"{path}/".startswith(f"{origin}/")}
        if kind == "TimeSeries":
            lines = [p for p in self.curves if p.startswith(f"{origin}/") and len(self.curves[p][0]) > 1]
            return len(lines) > 0
        if kind == "TextLog":
            return any("TextLog:text" in c for p, c in self.moving.items() if f"{p}/".startswith(f"{origin}/"))
        if kind == "3D":
            solids = [
                columns for columns in below.values() if any(name.endswith(("sizes", "radii")) for name in columns)
            ]
            moved = [p for p, c in self.moving.items() if p.startswith(f"{origin}/") and "Transform3D:translation" in c]
            return len(solids) > 0 and len(moved) > 0
        return any(columns.get("TextDocument:text") for columns in below.values())

    def is_complete(self):
        """No view of the layout is empty, and nothing in the file is without a view."""
        for origin, (kind, title) in self.views.items():
            assert self.holds(origin, kind), f"{title} is empty"
        for path in [*self.curves, *self.static, *self.moving]:
            assert path.startswith("/__") or any(f"{path}/".startswith(f"{origin}/") for origin in self.views), path
        return True


@pytest.fixture
def written(tmp_path):
    def write(signals, fit=None, name="fit.rrd", **others):
        write_rrd(tmp_path / name, draw_fit(signals, fit or fitted(signals), **others))
        return Written(tmp_path / name)

    return write


CASES = {
    "two joints": {},
    "one sliding joint, with reference": {"types": ("prismatic",), "reference": True},
    "one joint in A": {"types": ("revolute",), "unit": "A"},
    "seven joints": {"types": ("revolute",) * 7},
    "hardly any noise": {"noise": 0.0},
    "long": {"types": ("revolute",), "samples": 25_000},
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_every_panel_of_the_layout_has_data_and_all_data_a_panel(case, written):
    signals = made_up(**case)
    file = written(signals)
    n, errors = signals.robot.n, signals.robot.n * (signals.q_ref is not None)
    assert sorted(kind for kind, _ in file.views.values()) == ["3D", "TextDocument"] + ["TimeSeries"] * (5 * n + errors)
    assert file.is_complete()
    assert "## verdict: " in file.static["/report"]["TextDocument:text"][0]


def error_scale(title, name, unit):
    """What an error of 1 rad or 1 m is drawn as, by its plot's title."""
    return {f"position error {name} [{p}{unit}]": factor for p, factor in (("", 1.0), ("m", 1e3), ("µ", 1e6))}[title]


IV_CASES = {
    "two joints": scara,
    "one sliding joint, with reference": lambda: made_up(types=("prismatic",), reference=True),
    "one joint": lambda: made_up(types=("revolute",)),
}


@pytest.mark.parametrize("case", IV_CASES.values(), ids=IV_CASES)
def test_a_fit_by_instruments_shows_the_simulated_robot(case, written):
    signals = case()
    fit, ls = fitted_iv(signals), fitted(signals)
    file = written(signals, fit, truth=ls.beta)
    n = signals.robot.n
    assert sorted(kind for kind, _ in file.views.values()) == ["3D", "TextDocument"] + ["TimeSeries"] * 6 * n
    assert file.is_complete()
    simulated, name = fit.replica.motion, signals.robot.joints[0].name
    k, x = file.curve("q", name, "simulated")
    np.testing.assert_array_equal(k, np.rint(simulated.t_s * FS))
    np.testing.assert_allclose(x, simulated.q[:, 0])
    titles = {origin: title for origin, (_, title) in file.views.items()}
    per_unit = error_scale(titles[f"/error/{name}".replace(" ", "\\ ")], name, signals.robot.joints[0].position_unit)
    k, x = file.curve("error", name, "simulated")
    np.testing.assert_allclose(x / per_unit, simulated.q[:, 0] - fit.replica.q[:, 0])
    np.testing.assert_allclose(signals.q[k, 0] + x / per_unit, simulated.q[:, 0], atol=1e-3 * np.ptp(signals.q[:, 0]))
    if signals.q_ref is not None:
        k, x = file.curve("error", name, "reference")
        np.testing.assert_allclose(x / per_unit, (signals.q_ref - signals.q)[k, 0])
    text = file.static["/report"]["TextDocument:text"][0]
    assert "simulated robot against the recording" in text
    assert "passes from start" in text
    assert "IV and LS" in text
    assert "IV and true" in text


def test_a_robot_that_cannot_be_simulated_has_no_ghost(written):
    fit = fitted_iv(made_up())
    assert (fit.status, fit.replica.direct) == ("not_confirmed", ())
    file = written(made_up(), fit)
    assert file.is_complete()
    assert not any("simulated" in path for path in [*file.curves, *file.moving])
    assert fit.iv.reason in file.static["/report"]["TextDocument:text"][0]


def test_titles_say_joint_and_unit(written):
    titles = {origin: title for origin, (_, title) in written(made_up(types=("prismatic", "revolute"))).views.items()}
    assert titles["/torque/joint\\ 1.x"] == "torque joint 1.x [N]"
    assert titles["/torque/joint\\ 2.x"] == "torque joint 2.x [N m]"
    assert titles["/residual/joint\\ 1.x"] == "residual joint 1.x [N]"
    assert titles["/ddq/joint\\ 1.x"] == "ddq joint 1.x [m/s²]"
    assert titles["/q/joint\\ 2.x"] == "q joint 2.x [rad]"
    in_amperes = written(made_up(types=("revolute",), unit="A"), name="a.rrd").views
    assert in_amperes["/torque/joint\\ 1.x"][1] == "torque joint 1.x [A]"


@pytest.mark.parametrize(
    ("peak", "expected"),
    [(2.0, (1.0, "rad")), (0.5, (1e3, "mrad")), (1e-3, (1e3, "mrad")), (9e-4, (1e6, "µrad")), (0.0, (1.0, "rad"))],
)
def test_errors_are_in_a_readable_unit(peak, expected):
    assert readable_unit(peak, "rad") == expected


def test_joints_of_one_kind_share_the_unit_of_their_errors(written):
    signals = made_up(types=("revolute", "prismatic", "revolute"), reference=True)
    q_ref = signals.q + np.array([2e-3, 3e-5, 5e-6])
    file = written(replace(signals, q_ref=q_ref), fitted(signals))
    titles = [file.views[f"/error/joint\\ {j}.x"][1] for j in (1, 2, 3)]
    assert titles == [f"position error joint {j}.x [{unit}]" for j, unit in ((1, "mrad"), (2, "µm"), (3, "mrad"))]
    for j, error in enumerate([2.0, 30.0, 5e-3], 1):
        np.testing.assert_allclose(file.curve("error", f"joint {j}.x", "reference")[1], error, rtol=1e-6)


def test_short_curves_are_written_sample_by_sample(written):
    signals = made_up(reference=True)
    fit, file = fitted(signals), written(signals)
    plan = fit.settings
    span = np.arange(plan.start, plan.stop)
    whole = FilteredMotion(signals).between(plan.start, plan.stop, plan.cutoff_hz)  # in one pass
    for j, joint in enumerate(signals.robot.joints):
        assert not any(
            path.startswith(f"/{d}/") and path.endswith("/measured") for d in ("dq", "ddq") for path in file.curves
        )
        expected = {
            ("torque", "measured"): (np.arange(len(signals.q)), signals.effort),
            ("q", "measured"): (np.arange(len(signals.q)), signals.q),
            ("q", "reference"): (np.arange(len(signals.q)), signals.q_ref),
            ("q", "measured_filtered"): (span, whole.q),
            ("dq", "measured_filtered"): (span, whole.dq),
            ("ddq", "measured_filtered"): (span, whole.ddq),
        }
        for (quantity, key), (samples, values) in expected.items():
            k, x = file.curve(quantity, joint.name, key)
            np.testing.assert_array_equal(k, samples)
            np.testing.assert_allclose(x, values[:, j], rtol=1e-9, atol=1e-9 * np.abs(values).max())


def test_the_residual_is_the_one_whose_error_is_reported(written):
    signals = made_up()
    fit, file = fitted(signals), written(signals)
    decimation = Decimation(factor=fit.settings.decimation)
    Y = decimation.filtered(signals.effort[fit.settings.start : fit.settings.stop].T)
    motion = FilteredMotion(signals).between(fit.settings.start, fit.settings.stop, fit.settings.cutoff_hz)
    predicted = predicted_torque(motion, InverseModel(signals.robot), fit.base, fit.beta)
    for j, joint in enumerate(signals.robot.joints):
        k, rho = file.curve("residual", joint.name, "residual")
        assert 100 * np.linalg.norm(rho) / np.linalg.norm(Y[j]) == pytest.approx(fit.errors[j].relative_error_percent)
        np.testing.assert_allclose(rho, Y[j] - decimation.filtered(predicted[:, j]), atol=1e-9 * np.abs(Y[j]).max())
        np.testing.assert_array_equal(file.curve("torque", joint.name, "residual")[1], rho)
        assert k[-1] == fit.settings.stop - 1
        assert set(np.diff(k)) == {fit.settings.decimation}


def test_blocks_of_a_long_recording_leave_no_seam(written, monkeypatch):
    signals = made_up()
    whole = written(signals)
    monkeypatch.setattr(curves, "_BLOCK", 700)
    blocks = written(signals, name="blocks.rrd")
    assert whole.curves.keys() == blocks.curves.keys()
    for path, (t, x) in whole.curves.items():
        np.testing.assert_array_equal(blocks.curves[path][0], t)
        np.testing.assert_allclose(blocks.curves[path][1], x, rtol=1e-9, atol=1e-9 * np.abs(x).max())


@pytest.mark.parametrize(("N", "step"), [(1, 1), (10, 1), (10, 3), (99, 9), (1000, 7), (5, 9)])
def test_thinning_keeps_both_extremes_of_every_bucket(N, step):
    x = np.random.default_rng(N).standard_normal(N)
    k = extremes(x, step)
    assert (np.diff(k) > 0).all()
    if step == 1:
        np.testing.assert_array_equal(k, np.arange(N))
    assert len(k) <= 2 * (N // step) + N % step or step == 1
    for a in range(0, N, step):
        kept, bucket = x[k[(k >= a) & (k < a + step)]], x[a : a + step]
        assert kept.min() == bucket.min()
        assert kept.max() == bucket.max()


def test_long_curves_are_bounded_and_lose_no_peak(written, tmp_path):
    signals = made_up(types=("revolute",), samples=25_000)
    fit = fitted(signals)
    effort = signals.effort.copy()
    effort[12_345] = 10 * effort.max()
    spiked = replace(signals, effort=effort)
    file = written(spiked, fit)
    k, x = file.curve("torque", "joint 1.x", "measured")
    np.testing.assert_array_equal(x, effort[k, 0])
    assert x[k == 12_345] == effort.max()
    assert k[0] < 5
    assert k[-1] > len(effort) - 6
    step = -(-25_000 // 5000)
    assert all(len(t) <= 2 * 5000 + step for t, _ in file.curves.values())
    assert (tmp_path / "fit.rrd").stat().st_size < 4e6


def test_what_was_not_recorded_or_done_is_not_shown(written):
    signals = made_up()
    assert not any(path.endswith("reference") for path in written(signals).curves)
    unfiltered = written(signals, fitted(signals, cutoff_hz=0.0), name="b.rrd")
    k, speed = unfiltered.curve("dq", "joint 1.x", "measured")
    np.testing.assert_allclose(speed, differentiate(signals.q, FS)[k, 0], atol=1e-9 * np.abs(speed).max())
    assert not any(path.endswith("filtered") for path in unfiltered.curves)
    assert all(unfiltered.holds(origin, kind) for origin, (kind, _) in unfiltered.views.items())


def test_a_fit_that_leaves_nothing_has_no_residual_page(written):
    signals = made_up()
    fit = fitted(signals)
    nothing = np.zeros((200, 2))
    rows = {"t_s": signals.t_s[:200], "tau": nothing, "tau_predicted": nothing, "speed": nothing}
    views = written(signals, replace(fit, **rows)).views
    assert not any(origin.startswith("/residual") for origin in views)
    assert len(views) == 4 * signals.robot.n + 2


def test_the_report_tells_result_settings_and_parameters(written):
    signals = made_up(types=("revolute",), unit="A")
    fit = fitted(signals)
    text = written(signals).static["/report"]["TextDocument:text"][0]
    moving = fit.errors[-1].moving_relative_error_percent
    assert text.startswith(
        f"# made up: WLS (asked for), solved, {fit.trust.verdict}: {fit.trust.finding}; {moving:.3g} %"
    )
    for warning in fit.warnings:
        assert f"warning: {warning}" in text
    assert fit.warnings, "the drive gain is not known"
    for name, value, unit in zip(fit.estimate.names, fit.estimate.beta, fit.base.units, strict=True):
        (row,) = re.findall(rf"^\| {name} \| ([^ ]+) \|", text, flags=re.MULTILINE)
        assert float(row) == pytest.approx(value, rel=1e-3)
        assert f"| {unit} |" in text
    for part in ("made_up.mcap", "0" * 64, "low-pass 50 Hz", "WLS"):
        assert part in text


def test_each_fit_is_an_application_of_its_own(written):
    """A viewer has one layout per application: another fit's titles would stand over this one's curves."""
    signals = made_up()
    files = [written(signals, fit) for fit in (fitted(signals), fitted(signals), fitted(signals, cutoff_hz=30.0))]
    assert files[0].application == files[1].application != files[2].application


def test_a_disk_that_fills_up_leaves_what_was_there(tmp_path):
    path = tmp_path / "fit.rrd"
    path.write_bytes(b"before")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(AcquisitionError, match="cannot be written"):
            write_rrd(path, draw_fit(made_up(), fitted(made_up())))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_half_way_leaves_nothing_and_is_silent(tmp_path, monkeypatch, capfd):
    def fail(*_, **__):
        raise ValueError("half way")

    monkeypatch.setattr(rerun_panels, "_arrange", fail)
    with pytest.raises(ValueError, match="half way"):
        write_rrd(tmp_path / "fit.rrd", draw_fit(made_up(), fitted(made_up())))
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")
