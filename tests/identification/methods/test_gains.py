"""Drive gains and payloads of a fit: exact rows, noise, the scale by other means than a
payload, and bad input.
"""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from command_runs import refused
from described_truth import off, truth_of
from gain_cases import GainCase, fit_with_gains, gains_of, off_in_half_widths, with_gains
from planned_pairs import planned, planned_pair

import identification.methods.idim as idim
from acquisition.robot import Payload, load_robot
from identification.commands import main
from identification.data import Recordings, load_signals
from identification.methods import read_model
from identification.methods.model import model_of
from identification.model import (
    LINK,
    InverseModel,
    base_parameters,
    described_parameters,
    link_columns,
    payload_parameters,
)
from identification.regression import (
    FilteredMotion,
    Overrides,
    make_problem,
    make_unknowns,
    predicted_torque,
)
from identification.results import fit_document, fit_file, identify, identify_ls
from identification.simulation import SimulatedRecording
from identification.study import write_signals

WHITE = GainCase(robot="scara", white=5.0)
ALL = Overrides(gains=("all",))


def fitted(*signals, **overrides):
    return identify(Recordings(sources=signals), Overrides(**overrides))


def exact(observed, case):
    """The same recordings with the torques of the true parameters along the filtered motion,
    by the described gains.
    """
    found = []
    for problem in observed.problems:
        robot, signals = problem.signals.robot, problem.signals
        beta, payload = described_parameters(problem.model, problem.base), signals.payload
        if payload is not None:
            whole = problem.base.K[:, link_columns(problem.model)[-1]]
            beta = beta + whole @ payload_parameters(problem.model, payload)
        motion = problem.motion.between(0, len(signals.q), problem.settings.cutoff_hz)
        torque = predicted_torque(motion, problem.model, problem.base, beta)
        effort = (np.linalg.solve(robot.R.T, torque.T).T * robot.gain / case.gains) @ robot.R
        signals = replace(signals, effort=effort)
        found.append(replace(problem, signals=signals, motion=FilteredMotion(signals)))
    return model_of(found, observed.laws, observed.overrides, observed.work, observed.order)


@pytest.mark.parametrize(("robot", "catalogue"), [("scara", True), ("axis", False), ("tx40", True)])
def test_model_rows_recover_gains_exactly(robot, catalogue, monkeypatch):
    case = GainCase(robot=robot, catalogue=catalogue)
    monkeypatch.setattr(idim, "read_model", lambda *given: exact(read_model(*given), case))
    fit = fit_with_gains(*planned_pair(case))
    np.testing.assert_allclose(gains_of(fit)[0], case.gains, rtol=1e-6)
    true = truth_of(fit)
    np.testing.assert_allclose(fit.estimate.beta, true, rtol=1e-6, atol=1e-6 * np.abs(true).max())


def test_known_gain_gives_scale_without_payload():
    recording = with_gains(planned(WHITE, None, 0), WHITE.gains * [1.0, 1.3], None)
    (gain,) = fitted(recording, gains=("motor_2",)).gains
    assert (gain.motor, gain.described) == ("motor_2", WHITE.gains[1] * 1.3)
    assert abs(gain.value - WHITE.gains[1]) <= 1.5 * gain.half_width < 0.05 * WHITE.gains[1]


@pytest.mark.parametrize(("robot", "push"), [("scara", 1.0), ("emps", 20.0)])
def test_external_torque_gives_scale_without_payload(robot, push):
    case = replace(WHITE, robot=robot)
    gains, half = gains_of(fitted(planned(case, None, 0, push=push), gains=("all",)))
    assert (np.abs(gains - case.gains) <= 1.5 * half).all()
    assert (half < 0.05 * case.gains).all()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Recordings as files: free, loaded, free2 (the bare arm again), by the SCARA; free_true and
    loaded_true by true gains.
    """
    path = tmp_path_factory.mktemp("gains")
    free, loaded = planned_pair(WHITE)
    for name, one in (("free", free), ("loaded", loaded), ("free2", planned(WHITE, None, 2))):
        write_signals(path / f"{name}.mcap", one, source="")
        if name != "free2":
            write_signals(path / f"{name}_true.mcap", with_gains(one, WHITE.gains, None), source="")
    for name, case in (
        ("axis", replace(WHITE, robot="axis")),
        ("torque", replace(WHITE, torques=True, catalogue=False)),
        ("light", replace(WHITE, mass_kg=0.04)),
        ("blank", replace(WHITE, catalogue=False)),
    ):
        for one in planned_pair(case):
            write_signals(path / f"{name}_{one.recording.partition('_')[0]}.mcap", one, source="")
    return path


def run_fit(folder, names, *options):
    return main(
        [
            "fit",
            *(str(folder / f"{name}.mcap") for name in names.split()),
            "--workers",
            "1",
            "--all",
            *options,
        ]
    )


STATED = "2@0.05,0.02,0"


@pytest.mark.parametrize(
    ("names", "options"),
    [
        ("free_true loaded_true", "--essential"),
        ("free_true loaded_true", "--method ols"),
        ("free_true loaded_true", "--essential --consistent"),
        ("loaded_true", "--method ols"),
        ("loaded_true", "--essential --method ols"),
        ("loaded_true", "--essential --consistent"),
    ],
)
def test_loaded_essential_parameters_are_true(folder, tmp_path, names, options):
    """With a payload that is stated; alone, its inertia, which is not, is the arm's. Each option
    with both, and each pair of options.
    """
    out = tmp_path / "fit.json"
    assert run_fit(folder, names, *options.split(), "--json", str(out)) == 0
    found = {p["name"]: p for p in json.loads(out.read_text())["parameters"]}
    signals = load_signals(folder / "loaded_true.mcap")
    base = base_parameters(model := InverseModel(signals.robot))
    unknown = payload_parameters(model, signals.payload)[: LINK.index("MX")] * (" " not in names)
    carried = base.K[:, link_columns(model)[-1][: len(unknown)]] @ unknown
    true = dict(zip(base.names, described_parameters(model, base) + carried, strict=True))
    assert (len(found) >= 3, len(found) < len(true)) == (True, "--essential" in options)
    for name, p in found.items():
        assert abs(p["value"] - true[name]) < 1.5 * (p["high"] - p["low"])


@pytest.mark.parametrize(
    ("names", "options", "status", "words"),
    [
        ("free loaded", ["--gains", f"--payload=free={STATED}", "--payload=loaded=none"], 3,
         "all drive gains are negative"),
        ("free_true loaded_true", ["--gains", "--payload=loaded_true=1"], 0,
         "drive gains caution: the drive gains are 0.49"),
        ("free free2", ["--gains", f"--payload=free2={STATED}"], 3,
         "drive gains do not use: no drive gain is usable"),
        ("light_free light_loaded", ["--gains"], 3,
         "drive gains do not use: no drive gain is usable (motor_1 ±"),
        ("torque_free torque_loaded", ["--gains"], 0,
         "all are 1 N m per unit, so the recorded effort is already a torque"),
        ("blank_free blank_loaded", ["--gains"], 0, "drive gains passed: known to "),
        ("blank_free blank_loaded", [], 3, "units do not use: "),
    ],
)  # fmt: skip
def test_wrong_pairs(folder, capsys, names, options, status, words):
    assert run_fit(folder, names, *options) == status
    printed = capsys.readouterr()
    assert words in " ".join(printed.out.split())
    assert (printed.err == "") == (status == 0)


@pytest.mark.parametrize(
    ("names", "options", "words"),
    [
        ("free free", ["--gains"], "free.mcap: has the same content as free.mcap. Pass each "
                                   "recording once."),
        ("free loaded", ["--gains", "--payload=loaded=none"],
         "gains cannot be identified, since all recordings have the same payload. Use one"),
        ("loaded", ["--gains"], "loaded.mcap: gains: drive gains cannot be identified, since "
                                "all recordings have the same "),
        ("axis_free axis_loaded", ["--gains", "--payload=axis_loaded=2"],
         "drive gains cannot be identified from the mass of the payload alone. Give"),
        ("free loaded", ["--gains", "--payload=loaded=unknown"],
         "drive gains cannot be identified with a payload of unknown mass. Give its mass"),
        ("free loaded", ["--gains", "--method=wls"],
         "method = 'wls': least squares biases drive gains towards zero. Use iv, or do not "
         "estimate gains (--gains)."),
        ("free loaded", ["--gains=motor_9"], "robot SCARA: gains = 'motor_9': expected one of "
                                             "motor_1, motor_2"),
        ("blank_free blank_loaded", ["--gains=motor_1"],
         "motor motor_2: drive_gain is missing. Give it in robot.toml, or identify it (--gains)."),
        ("free loaded", ["--gains", "--payload=lodaed=2"],
         "--payload = 'lodaed=2': expected NAME=KG[@X,Y,Z], NAME=none or"),
        ("free loaded", ["--gains", "--payload=loaded="],
         "--payload = 'loaded=': expected NAME=KG[@X,Y,Z]"),
    ],
)  # fmt: skip
def test_data_without_scale_refused(folder, capsys, names, options, words):
    assert run_fit(folder, names, *options) == 1
    printed = capsys.readouterr()
    assert re.fullmatch(r"robot-identify: .+\n", printed.err), printed.err
    assert words in printed.err
    assert not printed.out


@pytest.fixture(scope="module")
def pair():
    return planned_pair(WHITE)


@pytest.fixture(scope="module")
def fit(pair):
    return fit_with_gains(*pair)


def test_mass_half_width_adds_to_intervals(pair):
    """Seen by a second way: the fit of a mass that is heavier by its half-width."""
    free, loaded = (with_gains(one, WHITE.gains, None) for one in pair)
    stated = loaded.payload
    heavy = replace(loaded, payload=replace(stated, mass_kg=stated.mass_kg + 0.04))
    unsure = replace(loaded, payload=replace(stated, mass_half_width_kg=0.04))
    sure, unsure, moved = (fitted(free, one, gains=("all",)) for one in (loaded, unsure, heavy))
    for of_mass, half, value in (
        (moved.estimate.beta - sure.estimate.beta, unsure.intervals.half, sure.intervals.half),
        (gains_of(moved)[0] - gains_of(sure)[0], gains_of(unsure)[1], gains_of(sure)[1]),
    ):
        np.testing.assert_allclose(half, np.hypot(value, of_mass), rtol=5e-3, atol=1e-9)


def test_payload_weighed_with_gain_half_widths(fit):
    """The half-widths seen by a second way: fits with one gain each moved by its half-width."""
    gains, half = gains_of(fit)
    free, loaded = planned_pair(replace(WHITE, mass_kg=1.4), 1)
    loaded = replace(loaded, payload=Payload(None))

    def masses(gains, half):
        found = fitted(*(with_gains(one, gains, half) for one in (free, loaded)))
        (payload,) = found.payloads
        return payload.parameters[-1].value, payload.parameters[-1].half_width

    mass, without = masses(gains, None)
    _, whole = masses(gains, half)
    moves = [masses(gains + half * (np.arange(2) == m), None)[0] - mass for m in range(2)]
    assert abs(mass - 1.4) <= whole
    assert whole == pytest.approx(np.hypot.reduce([without, *moves]), rel=0.02)
    assert whole > 1.1 * without


def test_free_and_loaded_share_arm_parameters(pair):
    free, loaded = (with_gains(one, WHITE.gains, None) for one in pair)
    fit = fitted(free, loaded, with_gains(planned(WHITE, loaded.payload, 9), WHITE.gains, None))
    assert fit.estimate.names == fit.base.names
    assert (off(fit) <= 2.5).all()
    (found,), true = fit.payloads, payload_parameters(InverseModel(free.robot), loaded.payload)
    assert (
        abs(found.parameters[5].value - true[5])
        <= 2 * found.parameters[5].half_width
        < 0.2 * true[5]
    )


def test_lone_loaded_recording_names_its_parameters(pair):
    """What is stated of the payload is taken off, the rest stays."""
    loaded = with_gains(pair[1], WHITE.gains, None)
    for stated, within in (
        (loaded.payload, slice(0, 6)),
        (Payload(2.0), slice(0, 9)),
        (Payload(None), slice(0, 10)),
    ):
        fit = identify_ls(replace(loaded, payload=stated), Overrides())
        model, left = fit.problem.model, np.zeros(10)
        left[within] = payload_parameters(model, loaded.payload)[within]
        apart = fit.beta - truth_of(fit)
        assert (
            np.abs(apart - fit.base.K[:, link_columns(model)[-1]] @ left) <= 2 * fit.intervals.half
        ).all()
        assert (np.abs(apart) > 2 * fit.intervals.half).any()
        assert fit.trust.line("noise bias").level == "ok"
        (why,) = [one.why for one in fit.trust.assumed if one.what == "payload"]
        assert "the parameters include what is not given of the lightest" in why


def validated(folder, name, out, *options):
    """Torque error of the fit `out` in percent, and the warnings."""
    found = out.with_suffix(".validated.json")
    assert (
        main(["validate", str(out), str(folder / f"{name}.mcap"), *options, "--json", str(found)])
        == 0
    )
    file = json.loads(found.read_text())
    return file["relative_error_percent"], file["warnings"]


@pytest.mark.parametrize(
    ("names", "options"),
    [
        ("free_true loaded_true", ["--payload", "loaded_true=unknown"]),
        ("loaded_true", ["--payload", "loaded_true=2"]),
        ("free loaded", ["--gains"]),
    ],
)
def test_estimated_payload_belongs_to_recording(folder, tmp_path, names, options):
    out, name = tmp_path / "fit.json", names.split()[-1]
    run_fit(folder, names, *options, "--json", str(out))
    fit = json.loads(out.read_text())
    (of_fit,) = [
        x["relative_error_percent"]
        for x in fit.get("recordings", [fit])
        if x.get("recording", name).startswith(name)
    ]
    stated = options if "--payload" in options else []
    error, _ = validated(folder, name, out, *stated)
    # with gains the recording has friction of its own, of which another one takes the mean
    assert error == pytest.approx(of_fit, rel=0.05 if "--gains" in options else 1e-6)
    for other in (f"{name}=none", f"{name}=1.5@0.05,0.02,0"):
        assert validated(folder, name, out, "--payload", other)[0] > 1.5 * of_fit


def test_payload_option_with_fit_description(folder, tmp_path, capsys):
    toml, out = tmp_path / "offset.toml", tmp_path / "fit.json"
    text = with_gains(planned(WHITE, None, 0), WHITE.gains, None).robot.files["robot.toml"].decode()
    toml.write_text(text.replace('name = "shoulder"\n', 'name = "shoulder"\noffset = true\n'))
    assert run_fit(folder, "free_true", "--robot", str(toml), "--json", str(out)) == 0
    errors = []
    for payload in ("2@0.05,0.02,0", "none", "2@0.3,0.3,0"):
        error, warnings = validated(
            folder, "loaded_true", out, "--payload", f"loaded_true={payload}"
        )
        assert any(
            "its description does not have the parameters of the fit (Off1)" in text
            for text in warnings
        )
        errors.append(error)
    assert errors[0] < errors[1] != errors[2] > errors[0]
    told = refused(
        capsys, "validate", out, folder / "loaded_true.mcap", "--payload", "loaded_true=unknown"
    )
    assert "payload = 'unknown mass, centre of mass not given': has no mass. Give" in told


def test_gains_without_reference_use_measured_motion(pair, fit):
    assert (fit.status, fit.trust.verdict, fit.method, fit.passes) == (
        "solved",
        "caution",
        "iv",
        (),
    )
    told = "drive gains from the measured motion: the robot cannot be simulated without a recorded"
    assert fit.trust.line("convergence").text.startswith(told)
    assert (off_in_half_widths(fit, WHITE.gains) <= 1).all()


def test_negative_gains_not_simulated(pair, monkeypatch):
    free, loaded = (replace(one, q_ref=one.q.copy()) for one in pair)
    monkeypatch.setattr(SimulatedRecording, "simulated", None)
    fit = fit_with_gains(replace(free, payload=loaded.payload), replace(loaded, payload=None))
    line = fit.trust.line("convergence")
    assert (line.level, fit.trust.verdict) == ("caution", "do not use")
    assert line.text.startswith(
        "drive gains from the measured motion: the robot cannot be simulated with them"
    )
    assert (gains_of(fit)[0] < 0).all()


def test_consistent_parameters_need_no_given_gain(folder, capsys, tmp_path):
    out = tmp_path / "k.json"
    assert run_fit(folder, "blank_free blank_loaded", "--consistent") == 1
    assert "motor[0].drive_gain is missing" in capsys.readouterr().err
    assert (
        run_fit(folder, "blank_free blank_loaded", "--gains", "--consistent", "--json", str(out))
        == 0
    )
    found = {one["name"]: one for one in json.loads(out.read_text())["standard_parameters"]}
    assert found["ZZ2"]["value"] == pytest.approx(0.061, abs=0.01)


def test_files_of_fit_with_gains(folder, tmp_path):
    out, toml = tmp_path / "k.json", tmp_path / "robot.toml"
    files = ["--json", str(out), "--rrd", str(tmp_path / "k.rrd")]
    assert run_fit(folder, "blank_free blank_loaded", "--gains", *files) == 0
    found = json.loads(out.read_text())
    for one, true in zip(found["gains"], WHITE.gains, strict=True):
        assert abs(one["value"] - true) <= one["half_width"]
    (payload,) = found["payloads"]
    assert (payload["recording"], payload["stated"]) == ("blank_loaded.mcap", "2.0@0.05,0.02,0.0")
    assert sorted(tmp_path.glob("*.rrd")) == [
        tmp_path / "k_blank_free.rrd",
        tmp_path / "k_blank_loaded.rrd",
    ]
    assert main(["export", str(out), "--toml", str(toml)]) == 0
    described = load_robot(toml).motors
    assert [motor.drive_gain for motor in described] == [one["value"] for one in found["gains"]]
    assert [motor.drive_gain_half_width for motor in described] == [
        one["half_width"] for one in found["gains"]
    ]


@pytest.mark.parametrize(
    ("robot", "payload", "names"),
    [
        ("scara", Payload(2.0), ("MX", "MY", "ZZ")),
        ("emps", Payload(20.0), ()),
        ("emps", Payload(None), ("M",)),
        ("axis", Payload(2.0, (0.3, 0.02, 0.0), center_half_width_m=0.0), ("ZZ",)),
    ],
)
def test_inseparable_last_link_regrouped(robot, payload, names):
    """The planar arm feels ZZ, MX, MY and the mass; the EMPS the mass alone."""
    case = replace(WHITE, robot=robot)
    free, loaded = (with_gains(one, case.gains, None) for one in planned_pair(case))
    sources = free, replace(loaded, payload=payload)
    fit = fitted(*sources)
    assert not fit.recordings[0].carried.any()
    (found,) = fit.payloads
    carried = read_model(Recordings(sources=sources), Overrides(), print).names[fit.base.b :]
    assert [name.partition(":")[0] for name in carried] == list(names)
    true = payload_parameters(InverseModel(free.robot), loaded.payload)
    told = [(p, x) for p, x in zip(found.parameters, true, strict=True) if not p.from_prior]
    assert len(told) >= len(names) - 2
    (table,) = (
        one.table for one in fit_document(fit_file(fit)).sections if "Payload of" in one.title
    )
    assert [row[-1] == "given" for row in table.rows] == [
        payload.mass_kg is not None,
        *[payload.center_of_mass_m is not None] * 3,
        *[False] * 6,
    ]
    assert all(abs(p.value - x) <= 2.5 * p.half_width + 1e-6 for p, x in told)


@pytest.mark.parametrize(
    "payload",
    [Payload(2.0, (0.05, 0.02, 0.1)), Payload(2.0), Payload(None), Payload(3.0, (0.0, 0.1, 0.0))],
    ids=str,
)
def test_simulated_robot_matches_rows(payload):
    """Without a recording of the bare arm its parameters include what is not stated, and a ball
    beside them would count it twice.
    """
    signals = replace(planned(replace(WHITE, robot="tx40"), None, 0), payload=payload)
    unknowns = make_unknowns([make_problem(signals, Overrides())])
    x = np.random.default_rng(0).normal(size=len(unknowns.names))
    (arm,), whole = unknowns.arms, np.r_[x, np.zeros(len(unknowns.all) - len(x))]
    ((simulated, _, carried),) = unknowns.simulated(x, np.eye(len(x)))
    np.testing.assert_allclose(simulated, arm.beta(whole), atol=1e-12)
    np.testing.assert_allclose(carried, arm.beta(0 * whole), atol=1e-12)
