"""`fit --consistent`: a physical robot as near to the estimate as it allows; the real TX40, an SDP, random arms."""

import dataclasses
import json

import numpy as np
import pinocchio as pin
import pytest
from command_runs import refused
from conftest import REPLAY, robot_named
from fits_of_records import ls_of, signals_of
from made_up_recordings import write
from physical_cases import covariance, covariance_with, lowest, one_link
from physical_cases import tx40 as described_tx40
from random_arms import random_estimate

from acquisition.robot import fourier_reference, robot_from_files
from identification.commands import main
from identification.data import signals_from_arrays
from identification.errors import BadInputError
from identification.estimation import (
    consistent_parameters,
    intervals,
    link_parameters,
    parameter_certainty,
    pseudo_inertia,
    weighted_least_squares,
)
from identification.methods import fit_document, fit_file, identify_ls, urdf_prior, with_consistent
from identification.model import InverseModel, base_parameters, expected_links, physical_parameters
from identification.regression import Overrides, rows_of_recording
from identification.report import FitFile, LeftOut, read_fit


@pytest.fixture(scope="module")
def consistent(tx40):
    return with_consistent(ls_of(tx40))


def test_the_real_arm_becomes_a_physical_one(consistent):
    """Every pseudo-inertia and every own rotor inertia and friction positive; the torque error hardly larger."""
    c, problem = consistent.consistent_set, consistent.problem
    assert c.names == problem.model.names
    physical = physical_parameters(problem.model)
    assert lowest(physical, c.chi) > 0
    value = dict(zip(c.names, c.chi, strict=True))
    assert value["Ia5"] > value["Ia6"] > 0
    assert value["Fv5"] * value["Fv6"] > value["Fvm6"] ** 2
    assert min(value["Fc5"] + value["Fc6"], value["Fc5"] + value["Fcm6"], value["Fc6"] + value["Fcm6"]) > 0
    free, held = (errors[-1].relative_error_percent for errors in (consistent.errors, consistent.consistent_errors))
    assert free < held < free + 0.1
    np.testing.assert_allclose(c.beta, problem.base.K @ c.chi, rtol=1e-12)
    assert c.certificate <= 1e-6
    moved = (c.beta - consistent.beta) / consistent.intervals.half
    assert c.largest_move == pytest.approx(np.abs(moved).max())
    assert c.moved_most == problem.base.names[int(np.abs(moved).argmax())]
    C = consistent.intervals.covariance
    rho = c.beta - consistent.beta
    assert c.chi_squared == pytest.approx(rho @ np.linalg.solve(C, rho), rel=1e-6)
    # Nothing is said of link 1 but its part of ZZ1R; friction and offsets come from the recording alone.
    from_prior = dict(zip(c.names, c.from_prior, strict=True))
    assert all(from_prior[f"{name}1"] for name in ("XX", "YY", "MX", "MZ", "M"))
    assert not any(from_prior[name] for name in c.names if name[:2] in ("Fv", "Fc", "Of", "Ia"))
    assert not from_prior["MX2"]
    assert c.prior == "the description: all links by [parameters]"


def test_the_verdict_and_the_consistent_set_are_one_computation(consistent, tx40):
    """chi² and largest move of the verdict's line are those of `--consistent`; not with another prior, which is said."""
    c, line = consistent.consistent_set, consistent.trust.line("consistent")
    assert line.value == c.chi_squared
    assert f"{c.moved_most} moved by {c.largest_move:.2g} half-widths" in line.text
    assert line.level == "ok"
    lines = [line for s in fit_document(signals_of(tx40), consistent).sections for line in s.lines]
    assert not any("has its own" in line for line in lines)
    expected = dataclasses.replace(consistent.problem.signals.robot, parameters={})
    other = with_consistent(consistent, expected)
    assert any("has its own" in line for s in fit_document(signals_of(tx40), other).sections for line in s.lines)
    assert other.consistent_set.chi_squared != line.value


def test_the_report_has_intervals_and_names_what_left_the_fits(consistent, tx40):
    c = consistent.consistent_set
    moves = c.moves.copy()
    moves[3] = 1.7
    far = dataclasses.replace(consistent, consistent_set=dataclasses.replace(c, deviations=moves * c.reach))
    sections = {s.title: s for s in fit_document(signals_of(tx40), far).sections}
    standard = sections["physically consistent standard parameters"]
    heads = ["parameter", "value", "±95%", "unit", "mostly from"]
    assert [heading for heading, _ in standard.table.columns] == heads
    assert [row[2].value for row in standard.table.rows] == c.half.tolist()
    assert f"moved by more than one half-width: {c.base_names[3]} (+1.7)" in standard.lines
    of_base = sections["physically consistent base parameters"].table
    assert [row[0] for row in of_base.rows] == list(c.base_names)
    assert [row[2].value for row in of_base.rows] == c.base_half.tolist()
    assert of_base.rows[3][-1].value == 1.7
    plain = fit_document(signals_of(tx40), consistent)
    assert not any("by more than one half-width" in line for s in plain.sections for line in s.lines)


def held_out_error(fit, observed, trained, physical) -> tuple[float, float]:
    """Torque errors in percent on the rows that are not `trained`, of weighted least squares and of its consistent set."""
    system = observed.system
    estimate = weighted_least_squares(system.with_rows(system.used * trained))
    W, Y = system.with_rows(system.used * trained).weighted(estimate.weights)
    found = intervals(estimate, Y - W @ estimate.beta, observed.tau.shape[1])
    nearest = consistent_parameters(estimate.beta, found.covariance, fit.base.K, physical)
    assert lowest(physical, nearest.chi) > 0
    left = trained == 0
    return tuple(
        100 * np.linalg.norm((system.Y - system.W @ beta)[left]) / np.linalg.norm(system.Y[left])
        for beta in (estimate.beta, nearest.beta)
    )


@pytest.fixture(scope="module")
def observed(consistent):
    return rows_of_recording(consistent.problem)


@pytest.mark.parametrize("expected", ["described", "plausible"])
def test_held_out_torque_is_predicted_no_worse(consistent, observed, expected):
    """Halves both ways and fifths of the real record, each fitted alone and tried on all the rest."""
    model = consistent.problem.model
    if expected == "plausible":
        model = InverseModel(dataclasses.replace(model.robot, parameters={}))
    physical = physical_parameters(model)
    rows, n = consistent.tau.shape
    at = np.tile(np.arange(rows) / rows, n)
    parts = [(0.0, 0.5), (0.5, 1.0), *((k / 5, (k + 1) / 5) for k in range(5))]
    errors = np.array(
        [held_out_error(consistent, observed, ((at >= a) & (at < b)).astype(float), physical) for a, b in parts]
    )
    assert errors[:, 1].mean() < errors[:, 0].mean()
    assert (errors[:, 1] < 1.1 * errors[:, 0]).all()


def pull_of(physical, chi) -> float:
    """Sum over the links of tr(P0⁻¹ P)."""
    links = np.linalg.solve(physical.prior, pseudo_inertia(chi[physical.links]))
    return float(np.trace(links, axis1=1, axis2=2).sum())


def sdp(beta, covariance, K, physical, gamma, near):
    """Clarabel's optimum of the problem without its logarithms, and its dual, a bound from below.

    min 1/2 |A chi - t|² + gamma sum_j tr(P0_j⁻¹ P_j), with A = root(C)⁻¹ K; a symmetric matrix is the column of its upper
    triangle, off-diagonal entries times root 2. Unknown is the difference to `near` (p,), so that numbers are small.
    """
    clarabel = pytest.importorskip("clarabel", reason="clarabel, of the extra `test`, is not installed")
    from scipy.sparse import csc_matrix

    sigma = np.sqrt(np.diag(covariance))
    root = np.linalg.inv(np.linalg.cholesky(covariance / np.outer(sigma, sigma))) / sigma
    A, t, p = root @ K, root @ (beta - K @ near), K.shape[1]
    d = np.linalg.norm(A, axis=0)
    d = 1 / np.where(d > 0, d, 1.0)  # variables of norm one
    cones, G, q = [], [], -A.T @ t

    def add(matrices: np.ndarray) -> None:  # (s, s, p)
        rows, columns = np.triu_indices(len(matrices))
        order = np.lexsort((rows, columns))
        rows, columns = rows[order], columns[order]
        G.append(-np.where(rows == columns, 1.0, np.sqrt(2))[:, None] * matrices[rows, columns])
        cones.append(clarabel.PSDTriangleConeT(len(matrices)))

    for link, prior in zip(physical.links, physical.prior, strict=True):
        matrices = np.zeros((4, 4, p))
        for c, basis in zip(link, pseudo_inertia(np.eye(10)), strict=True):
            matrices[..., c] = basis
            q[c] += gamma * np.trace(np.linalg.solve(prior, basis))
        add(matrices)
    for matrices in physical.matrices:
        add(matrices)
    G.append(-physical.combinations)
    cones.append(clarabel.NonnegativeConeT(len(physical.combinations)))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_rel = settings.tol_gap_abs = settings.tol_feas = 1e-9
    G = np.concatenate(G) * d
    H = np.triu((A * d).T @ (A * d))
    solved = clarabel.DefaultSolver(csc_matrix(H), q * d, csc_matrix(G), -G @ (near / d), cones, settings).solve()
    assert solved.status in (clarabel.SolverStatus.Solved, clarabel.SolverStatus.AlmostSolved)
    half = 0.5 * t @ t + gamma * pull_of(physical, near)
    return solved.obj_val + half, solved.obj_val_dual + half


def test_without_its_barrier_the_optimum_is_that_of_an_sdp():
    """With gamma 1e-8 within gamma (4 n + number of x_i), of an arm whose own parameters no robot has."""
    idm, K, chi, _ = described_tx40()
    physical = physical_parameters(idm)
    wrong = chi.copy()
    wrong[[idm.names.index(name) for name in ("ZZ6", "YY6", "Ia6", "Fc5")]] *= -1.0
    beta = K @ wrong
    C = covariance_with(covariance(len(beta), 1.0), 0.1 * np.abs(beta) + 0.02)
    gamma = 1e-8
    found = consistent_parameters(beta, C, K, physical, gamma=gamma, gamma_x=1.0)
    best, bound = sdp(beta, C, K, physical, gamma, found.chi)
    mine = 0.5 * found.chi_squared + gamma * pull_of(physical, found.chi)
    gap = gamma * (4 * len(physical.links) + len(physical.combinations) + 100 * sum(map(len, physical.matrices)))
    assert lowest(physical, found.chi) > 0
    assert best > 1.0
    assert bound - 1e-6 < mine < best + gap + 1e-6


def test_random_arms_at_ten_times_the_noise():
    """A sample of what `benchmarks/test_consistent_rates.py` does a thousand times; of these 1 and 4 need the path."""
    for seed in (0, 1, 2, 4):
        beta, C, K, physical, _ = random_estimate(seed, 10.0)
        found = consistent_parameters(beta, C, K, physical)
        assert found.decrement <= 1e-6
        assert lowest(physical, found.chi) > 0
        rho = K @ found.chi - beta
        assert found.chi_squared == pytest.approx(rho @ np.linalg.solve(C, rho), rel=1e-6)


def test_what_comes_from_the_prior_is_what_the_recording_does_not_say():
    """Variances by a Hessian of differences; a parameter that is measured alone, and one that is not measured at all."""
    _, physical = one_link()
    K = np.eye(14)[[0, 9, 10, 11, 12, 13]]
    C = np.diag([1e-6, 100.0, 0.01, 0.01, 0.01, 0.01]) ** 2
    found = consistent_parameters(K @ physical.start, C, K, physical, gamma=0.5, gamma_x=0.1)
    shares = parameter_certainty(found, C, K, physical, gamma=0.5)[0][1]

    def prior_cost(chi):
        P = pseudo_inertia(chi[:10])
        divergence = np.trace(np.linalg.solve(physical.prior[0], P)) - np.linalg.slogdet(P)[1]
        return 0.5 * divergence

    h = 1e-4 * np.maximum(np.abs(found.chi), 0.01) * np.eye(14)[:10]
    signs = [(sign * other, sign, other) for sign in (1, -1) for other in (1, -1)]
    H = [[sum(s * prior_cost(found.chi + x * a + y * b) for s, x, y in signs) for b in h] for a in h]
    H = np.array(H) / (4 * np.outer(np.diag(h), np.diag(h)))
    of_data = (K.T @ np.linalg.solve(C, K))[:10, :10]  # what tells of the link is of no other parameter
    expected = np.diag(np.linalg.inv(H + of_data)) / np.diag(np.linalg.inv(H))
    assert not shares[10:].any()
    np.testing.assert_allclose(shares[:10], expected, rtol=1e-3, atol=1e-6)
    assert shares[0] < 1e-3
    assert shares[9] > 0.7
    assert (shares[1:9] > 0.2).all()


TWO = """name = "two"
[[joint]]
name = "a"
type = "revolute"
dh = { alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0.1 }
[[joint]]
name = "b"
type = "revolute"
dh = { alpha_deg = -90, d_m = 0.3, theta_deg = 0, r_m = 0 }
[[motor]]
name = "a"
effort_unit = "N m"
[[motor]]
name = "b"
effort_unit = "N m"
[controller]
bandwidth_hz = 5
"""
# The same arm: the second joint turns about y of its link's frame.
CAD = """<robot name="cad"><link name="base"/>
<link name="one"><inertial><origin xyz="0.1 0.02 0.03" rpy="0.3 0.1 0"/><mass value="2"/>
<inertia ixx="0.01" ixy="0.001" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link>
<link name="two"><inertial><origin xyz="0.2 0 -0.05"/><mass value="1.5"/>
<inertia ixx="0.01" ixy="0" ixz="0.002" iyy="0.03" iyz="0" izz="0.03"/></inertial></link>
<joint name="a" type="revolute"><parent link="base"/><child link="one"/><origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="b" type="revolute"><parent link="one"/><child link="two"/><origin xyz="0.3 0 0"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>"""


def test_a_urdf_says_what_the_links_of_a_robot_of_dh_rows_are():
    """In the frames of the rows they give the torques of the URDF in pinocchio."""
    robot = robot_from_files({"robot.toml": TWO.encode()}, "two.toml")
    idm = InverseModel(robot)
    links, sources = expected_links(idm, InverseModel(urdf_prior(robot, CAD, "cad.urdf")))
    assert sources == ("URDF", "URDF")
    chi = np.zeros(idm.p)
    physical = physical_parameters(idm, InverseModel(urdf_prior(robot, CAD, "cad.urdf")))
    chi[physical.links] = links
    np.testing.assert_allclose(physical.prior, pseudo_inertia(links))
    np.testing.assert_allclose(link_parameters(pseudo_inertia(links)), links, atol=1e-15)
    cad = pin.buildModelFromXML(CAD)
    data = cad.createData()
    q, dq, ddq = np.random.default_rng(1).uniform(-2, 2, (3, 20, 2))
    torque = np.array([pin.rnea(cad, data, *state) for state in zip(q, dq, ddq, strict=True)])
    np.testing.assert_allclose(idm.regressor(q, dq, ddq) @ chi, torque, atol=1e-12)
    longer = CAD.replace('<origin xyz="0.3 0 0"/>', '<origin xyz="0.31 0 0"/>')
    with pytest.raises(BadInputError) as caught:
        expected_links(idm, InverseModel(urdf_prior(robot, longer, "cad.urdf")))
    assert (caught.value.place, caught.value.key, caught.value.value) == ("prior cad.urdf", "joint", "b")


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({}, None),  # as published: Fv6 below Fvm6
        ({"Fc6": -0.5}, None),  # Coulomb friction of motor 6 makes up for it
        ({"Fvm6": 1.5}, "viscous friction of joint_5 and joint_6 = -"),
        ({"Fcm6": -2.5}, "Fc6 + Fcm6 = -"),
    ],
)
def test_a_wrist_that_feeds_energy_is_told_by_the_verdict_and_by_the_consistent_set(values, told):
    """Alike: where `physical` is ok, friction has not to move for `consistent`; and it ends up taking power."""
    robot = robot_named("tx40")
    robot = dataclasses.replace(robot, parameters={**robot.parameters, **values})
    model = InverseModel(robot)
    chi = np.array([robot.parameters.get(name, 0.0) for name in model.names])
    base = base_parameters(model)
    x = fourier_reference(robot, period_s=10.0, seed=2).at(np.arange(0.0, 10.0, 2e-3))
    tau = (model.regressor(*x) @ chi) + np.random.default_rng(0).normal(0, 0.05, x[0].shape)
    fit = identify_ls(signals_from_arrays(x[0], tau, 500.0, robot), Overrides(torque_lag_s="none", edges="smooth"))
    line, made = fit.trust.line("physical"), with_consistent(fit).consistent_set
    assert (line.level == "do not use") == bool(told), line.text
    assert (told or "no friction or rotor inertia is below zero") in line.text
    of_friction = [i for i, name in enumerate(base.names) if name[:2] in ("Fv", "Fc") and name[-1] in "56"]
    assert (np.abs(made.moves[of_friction]).max() > 1) == bool(told)
    assert lowest(physical_parameters(model), made.chi) > 0
    assert made.chi_squared == fit.trust.line("consistent").value


def test_the_file_holds_what_a_model_is_made_of(tmp_path, capsys):
    session, out, prior = REPLAY / "scara" / "session.mcap", tmp_path / "fit.json", tmp_path / "prior.toml"
    prior.write_text((REPLAY / "scara" / "robot.toml").read_text())
    command = ["fit", str(session), "--consistent", "--prior", str(prior), "--essential"]
    assert main([*command, "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    content = json.loads(out.read_text())
    names = InverseModel(robot_named("scara")).names
    assert [p["name"] for p in content["standard_parameters"]] == list(names)
    assert set(content["standard_parameters"][0]) == {"name", "value", "unit", "from_prior", "half_width"}
    c = content["consistent"]
    assert {"prior", "prior_weight", "chi2", "largest_move", "certificate"} <= set(c)
    assert c["prior_weight"] == 1.0
    assert c["prior"].startswith("prior.toml: ")
    assert f"chi² {c['chi2']:.3g} on 8 parameters" in printed
    assert f"{c['largest_move']:.2g} half-widths" in printed
    base = base_parameters(InverseModel(robot_named("scara"))).names
    assert {p["name"] for p in content["left_out"] + content["parameters"]} == set(base)
    assert "robot.toml" in content["description"]
    assert [p.value for p in read_fit(out).standard_parameters] == [p["value"] for p in content["standard_parameters"]]
    assert [p["name"] for p in c["base_parameters"]] == list(base)
    moves = [abs(p["move"]) for p in c["base_parameters"]]
    assert max(moves) == pytest.approx(c["largest_move"])
    assert all(p["half_width"] > 0 for p in c["base_parameters"] + content["standard_parameters"])
    for one in content["standard_parameters"]:
        del one["half_width"]
    del c["base_parameters"]
    (tmp_path / "old.json").write_text(json.dumps(content))  # of an earlier version
    assert read_fit(tmp_path / "old.json").consistent.chi2 == c["chi2"]
    assert {"standard_parameters", "consistent", "left_out"} <= set(FitFile.__struct_fields__)


def test_the_file_holds_what_an_essential_fit_leaves_out(tx40):
    fit = identify_ls(signals_of(tx40), Overrides(), essential=True)
    full, names = fit.least_squares.full, fit.estimate.names
    sigma = np.sqrt(np.diag(full.covariance))
    left_out = [LeftOut(name=n, sigma=float(s)) for n, s in zip(full.names, sigma, strict=True) if n not in names]
    assert len(left_out) > 5
    assert fit_file(fit).left_out == left_out
    assert fit_file(ls_of(tx40)).left_out == []


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--prior", "x.toml"], ("--prior", "--consistent")),
        (["--consistent", "--prior", "none.toml"], ("none.toml", "cannot be read")),
        (["--consistent", "--prior", "none.urdf"], ("none.urdf", "cannot be read")),
    ],
)
def test_options_that_cannot_be_meant_are_refused(more, words, capsys):
    err = refused(capsys, "fit", REPLAY / "scara" / "session.mcap", *more)
    assert all(word in err for word in words)


def test_a_fit_in_amperes_is_refused(tmp_path, capsys):
    text = (REPLAY / "scara" / "robot.toml").read_text().replace('effort_unit = "N m"', 'effort_unit = "A"')
    write(tmp_path / "amperes.mcap", robot_from_files({"robot.toml": text.encode()}, "amperes.toml"))
    told = refused(capsys, "fit", tmp_path / "amperes.mcap", "--consistent")
    assert "motor[0].drive_gain is missing" in told


def test_validate_judges_the_consistent_set_beside_the_fit(tmp_path, capsys):
    session, out, free = REPLAY / "scara" / "session.mcap", tmp_path / "fit.json", tmp_path / "free.json"
    assert main(["fit", str(session), "--consistent", "--json", str(out)]) == 0
    assert main(["fit", str(session), "--json", str(free)]) == 0
    content = json.loads(out.read_text())
    capsys.readouterr()
    validation = tmp_path / "validation.json"
    assert main(["validate", str(out), str(session), "--consistent", "--json", str(validation)]) == 0
    printed, judged = capsys.readouterr().out, json.loads(validation.read_text())
    error = content["consistent"]["relative_error_percent"]
    assert judged["relative_error_percent"] == pytest.approx(content["relative_error_percent"], rel=1e-6)
    assert judged["consistent_errors"][-1]["relative_error_percent"] == pytest.approx(error, rel=1e-6)
    for one in content["standard_parameters"]:
        one["value"] *= 1.1
    out.write_text(json.dumps(content))
    assert main(["validate", str(out), str(session), "--consistent", "--json", str(validation)]) == 0
    error = json.loads(validation.read_text())["consistent_errors"][-1]["relative_error_percent"]
    assert error > 1.01 * judged["relative_error_percent"]
    assert "consistent set: relative torque error: " in printed
    assert "relative torque error of the consistent set, %" in printed
    between = str(0.5 * (error + judged["relative_error_percent"]))
    assert main(["validate", str(out), str(session), "--max-error-percent", between]) == 0
    assert main(["validate", str(out), str(session), "--consistent", "--max-error-percent", between]) == 3
    capsys.readouterr()
    err = refused(capsys, "validate", free, session, "--consistent")
    assert str(free) in err
    assert "fit --consistent" in err
