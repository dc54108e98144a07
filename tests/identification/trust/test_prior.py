"""The links of a URDF as a witness of a recording: arms of a simulator of its own, with one fault
in what a fit is given.
"""

import json
import re
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from command_runs import refused, run
from hunt import fit_by_default, fit_by_least_squares
from independent_robots import with_payload
from independent_simulator import Imperfections, references, simulate
from independent_urdf import RATE_HZ, arm_of, robot_of
from urdfs import SIX, six_joints

from acquisition.robot import Payload
from identification.model import InverseModel, base_parameters, base_prior
from identification.report import to_markdown
from identification.results import fit_document, fit_file
from identification.study import write_signals
from identification.trust import prior

NAMES = [name for name, *_ in SIX]
# wrist_3 turns its own axis: its links need next to no torque, no prior can tell its gain
TOLD = NAMES[:5]
fitted = cache(fit_by_default)
CELL = Imperfections(torque_noise_percent=2.0, encoder_noise=2e-5)


@cache
def runs(payload_kg: float = 0.0):
    body, law = arm_of(six_joints())
    body = with_payload(body, payload_kg) if payload_kg else body
    return simulate(
        body,
        law,
        references(body, range(1), duration_s=8, rate_hz=RATE_HZ),
        CELL,
        seed=1,
        substeps=1,
    )


@cache
def recorded():
    """A recording whose description has the links of the arm times 0.7 to 1.4."""
    factors = np.random.default_rng(0).uniform(0.7, 1.4, len(NAMES))
    return runs().signals(robot_of(six_joints(factors), NAMES), 0)


def told(signals):
    fit = fit_by_least_squares(signals)
    line = fit.trust.line("a priori links")
    assert line.level != "do not use"
    return fit, line


def test_a_priori_torque_where_no_rotor_regrouped():
    head = 'type = "revolute"\nrotor_inertia = false\n'
    text = six_joints((1.1, 0.9, 1.2, 0.8, 1.0, 1.3))
    still = robot_of(text, NAMES, joint=lambda toml: toml.replace('type = "revolute"\n', head))
    model = InverseModel(still)
    base = base_parameters(model)
    found, source = base_prior(model, base)
    assert source == "URDF"
    assert set(found) == {name for name, of in zip(base.names, base.links, strict=True) if of}
    q, dq, ddq = np.random.default_rng(2).uniform(-2, 2, (3, 20, 6))
    W = model.regressor(q, dq, ddq)[..., base.columns]
    M, bias = arm_of(text)[0].rigid(q, dq)
    beta = np.array([found.get(name, 0.0) for name in base.names])
    np.testing.assert_allclose(W @ beta, (M @ ddq[..., None])[..., 0] + bias, atol=1e-10)

    with_rotors = InverseModel(robot_of(text, NAMES))
    base = base_parameters(with_rotors)
    named = base_prior(with_rotors, base)[0]
    assert len(named) < len(found)
    expressions = dict(zip(base.names, base.expressions, strict=True))
    assert not any("Ia" in expressions[name] for name in named)
    # A link without inertials leaves out whatever it is regrouped into.
    without = InverseModel(robot_of(six_joints((1, 1, 1, 1, 1, 0)), NAMES))
    left = base_prior(without, base_parameters(without))[0]
    assert left
    assert not any("6" in expressions[name] for name in left)


def test_forty_percent_link_error_is_no_fault(monkeypatch):
    """No cause is looked for: wrist_3 alone is not told by its links, which need no torque."""
    fit = fitted(recorded())
    line = fit.trust.line("a priori links")
    assert (fit.trust.verdict, line.level) == ("trust", "ok"), line.text
    assert {name for name, *_ in line.figures} == set(TOLD)
    assert all(0.6 < value < 1.5 for _, value, *_ in line.figures)
    monkeypatch.setattr(prior, "causes_by_prior", lambda _: 1 / 0)
    assert prior.prior_test(fit.data) == line
    assert fit.data.prior_error_percent > 3 * fit.trust.line("cross-validation").value


def with_columns(names: str, order=range(6), gain=1.0):
    """The recording with other columns of these arrays."""
    return replace(
        recorded(),
        **{name: gain * getattr(recorded(), name)[:, list(order)] for name in names.split()},
    )


@pytest.mark.parametrize(
    ("signals", "said"),
    [
        (("effort", range(6), [10, 1, 1, 1, 1, 1]), "the torque of pan is "),
        (("effort", range(6), [1, 1, 1, 3, 1, 1]), "the torque of wrist_1 is "),
        (("effort", [1, 0, 2, 3, 4, 5]), "the efforts of m_pan and m_lift are swapped."),
        (
            ("q q_ref", [0, 1, 3, 2, 4, 5]),
            "the positions of m_elbow and m_wrist_1 are swapped.",
        ),
        (
            ("q q_ref", range(6), np.pi / 180),
            "the position of all joints is in rad, declared as degrees.",
        ),
    ],
)
def test_recording_fault_named_at_joints(signals, said):
    fit, line = told(with_columns(*signals))
    assert fit.trust.verdict != "trust"
    assert line.level == "caution"
    assert line.text.startswith(said), line.text


def test_uniform_a_priori_error_is_no_fault():
    _, line = told(
        replace(recorded(), robot=robot_of(six_joints((0.05, 9, 9, 0.02, 0.02, 0.02)), NAMES))
    )
    assert line.level == "inconclusive"
    assert "the a priori links are wrong everywhere" in line.text
    line = told(replace(recorded(), robot=robot_of(six_joints((0.2,) * 6), NAMES)))[1]
    said = line.text.startswith("torques are 5 times those of the URDF's links")
    assert (line.level, said) == ("caution", True)


def test_given_payload_counts():
    signals = runs(12.0).signals(robot_of(six_joints(), NAMES), 0)
    assert "wrist_1 is" in told(signals)[1].text
    line = told(replace(signals, payload=Payload(12.0, (0.0, 0.0, 0.0))))[1]
    assert line.level == "ok", line.text
    assert all(0.9 < value < 1.1 for _, value, *_ in line.figures)


def test_no_a_priori_without_gains_or_inertials():
    for robot in (
        robot_of(six_joints(), NAMES, joint=lambda toml: toml.replace('"N m"', '"A"')),
        robot_of(six_joints((0,) * 6), NAMES),
    ):
        fit = fit_by_least_squares(replace(recorded(), robot=robot))
        assert not any(line.test == "a priori links" for line in fit.trust.lines)
        assert "| a priori |" not in to_markdown(fit_document(fit_file(fit)))
        stored = fit_file(fit)
        assert {stored.prior_source, *(one.prior for one in stored.parameters)} == {msgspec.UNSET}


def test_held_out_error_with_a_priori_links():
    fit = fitted(recorded())
    data, problem = fit.data, fit.problem
    system, weights = data.observed.system, fit.estimate.weights
    known = np.array([data.prior.get(name, 0.0) for name in system.names])
    free = [i for i, name in enumerate(system.names) if name not in data.prior]
    (W, Y), Z = system.weighted(weights), data.Z[:, free] * data.weight[:, None]
    s = problem.for_errors.settings
    motion = problem.motion.between(s.start, s.stop, s.cutoff_hz)
    whole, T = (
        problem.model.regressor(motion.q, motion.dq, motion.ddq)[..., problem.base.columns],
        len(fit.tau),
    )
    squares = np.zeros(2)
    (spans,) = system.spans
    for k in range(5):  # fifths, which end where spans do
        others = system.span * 5 // (len(spans) - 1) != k
        block = np.flatnonzero(np.arange(T) * 5 // T == k)
        beta = known.copy()
        ZT, rest = Z[others].T, (Y - W @ known)[others]
        beta[free] = np.linalg.solve(ZT @ W[others][:, free], ZT @ rest)
        counts = fit.counts[block]
        error = (fit.tau - s.decimator.filtered((whole @ beta).T).T)[block]
        squares += (error[counts] ** 2).sum(), (fit.tau[block][counts] ** 2).sum()
    assert data.prior_error_percent == pytest.approx(
        100 * np.sqrt(squares[0] / squares[1]), rel=0.01
    )


def test_a_priori_in_report_files_and_compare(tmp_path, capsys):
    write_signals(tmp_path / "log.mcap", recorded(), source="independent simulator")
    fit, report, arm = (tmp_path / name for name in ("fit.json", "r.md", "arm.urdf"))
    command = "fit", tmp_path / "log.mcap", "--method", "wls", "--json", fit, "--report", report
    assert run(capsys, *command)[0] == 0
    stored = json.loads(fit.read_text())
    assert (stored["prior_source"], stored["prior_held_out_error_percent"] > 1) == ("URDF", True)
    prior = {one["name"]: one["prior"] for one in stored["parameters"] if "prior" in one}
    model = InverseModel(recorded().robot)
    assert prior == pytest.approx(base_prior(model, base_parameters(model))[0])
    assert "| value | 95 % half-width | relative % | unit | a priori |" in report.read_text()
    held = (
        f"{stored[key]:.3g} %" for key in ("held_out_error_percent", "prior_held_out_error_percent")
    )
    shown = "{} held out, [0-9.]+ % fitted, over the same rows; a priori links {}".format(*held)
    assert re.search(rf"- \*\*Cross-validation\*\*: {shown}", report.read_text())

    arm.write_text(six_joints((2.0,) * 6))
    status, out, _ = run(capsys, "compare", fit, arm, "--json", tmp_path / "compared.json", "--all")
    assert status == 0
    lines = out.translate(str.maketrans("┃│", "  ")).splitlines()
    head = "name unit value 95 % half-width a priori ratio"
    assert next(line for line in lines if "value" in line).split() == head.split()
    value, _, prior, ratio = map(
        float, next(line.split() for line in lines if line.strip().startswith("MZ2R"))[-4:]
    )
    assert ratio == pytest.approx(value / prior, rel=0.01)
    assert ratio == pytest.approx(0.5, rel=0.02)  # the URDF has twice the links of the arm
    compared = json.loads((tmp_path / "compared.json").read_text())
    assert (compared["a"], compared["b"]) == ("fit", "arm")
    for text, words in (
        (six_joints().replace("elbow", "knee"), "elbow"),
        (six_joints().replace("0.3922", "0.4"), "moves differently"),
        (six_joints((0,) * 6), "inertial parameters"),
    ):
        arm.write_text(text)
        assert words in refused(capsys, "compare", fit, arm)
