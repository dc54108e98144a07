"""`fit --consistent`: a physical robot as near to the estimate as it allows; the
real TX40, random arms.
"""

import dataclasses
import json

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from command_runs import refused
from conftest import REPLAY, robot_named
from fits_of_records import ls_of, signals_of
from physical_cases import lowest, one_link

from acquisition.robot import robot_from_files
from identification.commands import main
from identification.errors import BadInputError
from identification.estimation import (
    consistent_parameters,
    link_parameters,
    parameter_certainty,
    pseudo_inertia,
)
from identification.model import InverseModel, base_parameters, expected_links, physical_parameters
from identification.regression import Overrides
from identification.report import LeftOut, read_fit
from identification.results import fit_document, fit_file, identify_ls, urdf_prior, with_consistent


@pytest.fixture(scope="module")
def consistent(tx40):
    return with_consistent(ls_of(tx40))


def test_real_arm_becomes_consistent(consistent):
    """Every pseudo-inertia and every own rotor inertia and friction positive; the
    torque error hardly larger.
    """
    c, problem = consistent.consistent_set, consistent.problem
    value = {p.name: p.value for p in consistent.standard_parameters}
    assert tuple(value) == problem.model.names
    assert lowest(physical_parameters(problem.model), np.array([*value.values()])) > 0
    assert value["Ia5"] > value["Ia6"] > 0
    assert value["Fv5"] * value["Fv6"] > value["Fvm6"] ** 2
    assert (
        min(value["Fc5"] + value["Fc6"], value["Fc5"] + value["Fcm6"], value["Fc6"] + value["Fcm6"])
        > 0
    )
    free, held = consistent.errors[-1].relative_error_percent, c.relative_error_percent
    assert free < held < free + 0.1
    moved = ([p.value for p in c.base_parameters] - consistent.beta) / consistent.intervals.half
    assert c.largest_move == pytest.approx(np.abs(moved).max())
    assert c.moved_most == problem.base.names[int(np.abs(moved).argmax())]
    # Nothing is said of link 1 but its part of ZZ1R; friction and offsets come from
    # the recording alone.
    from_prior = {p.name: p.from_prior for p in consistent.standard_parameters}
    assert all(from_prior[f"{name}1"] for name in ("XX", "YY", "MX", "MZ", "M"))
    assert not any(from_prior[name] for name in from_prior if name[:2] in ("Fv", "Fc", "Of", "Ia"))
    assert not from_prior["MX2"]
    assert c.prior == "the description: all links by [parameters]"


def lines_of(fit) -> list[str]:
    sections = fit_document(fit_file(fit)).sections
    return [x for s in sections for x in s.lines if isinstance(x, str)]


def test_verdict_shares_consistent_computation(consistent):
    """chi² and largest move of the verdict's line are those of `--consistent`; not with
    another prior, which is said.
    """
    c, line = consistent.consistent_set, consistent.trust.line("physically consistent")
    assert (line.level, line.value) == ("ok", c.chi2)
    assert f"{c.moved_most} changes by {c.largest_move:.2g} half-widths" in line.text
    other = with_consistent(
        consistent, dataclasses.replace(consistent.problem.signals.robot, parameters={})
    )
    assert other.consistent_set.chi2 != line.value
    assert [
        any("has a prior of its own" in x for x in lines_of(fit)) for fit in (consistent, other)
    ] == [
        False,
        True,
    ]


def test_report_has_intervals_and_dropped_names(consistent):
    c = consistent.consistent_set
    base = [
        msgspec.structs.replace(p, move=1.7 if k == 3 else p.move)
        for k, p in enumerate(c.base_parameters)
    ]
    far = dataclasses.replace(
        consistent, consistent_set=msgspec.structs.replace(c, base_parameters=base)
    )
    sections = {s.title: s for s in fit_document(fit_file(far)).sections}
    standard = sections["Physically consistent standard parameters"]
    heads = ["parameter", "value", "95 % half-width", "unit", "mostly from"]
    assert [heading for heading, _ in standard.table.columns] == heads
    assert [row[2].value for row in standard.table.rows] == [
        p.half_width for p in consistent.standard_parameters
    ]
    assert f"Changed by more than one half-width: {base[3].name} (+1.7)." in standard.lines
    of_base = sections["Physically consistent base parameters"].table
    assert [row[0] for row in of_base.rows] == [p.name for p in base]
    assert [row[2].value for row in of_base.rows] == [p.half_width for p in base]
    assert of_base.rows[3][-1].value == 1.7
    assert not any("by more than one half-width" in line for line in lines_of(consistent))


def test_prior_supplies_unmeasured_parameters():
    """Variances by a Hessian of differences; a parameter that is measured alone, and one that
    is not measured at all.
    """
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
    H = [
        [sum(s * prior_cost(found.chi + x * a + y * b) for s, x, y in signs) for b in h] for a in h
    ]
    H = np.array(H) / (4 * np.outer(np.diag(h), np.diag(h)))
    # what tells of the link is of no other parameter
    of_data = (K.T @ np.linalg.solve(C, K))[:10, :10]
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
<joint name="a" type="revolute"><parent link="base"/><child link="one"/>
<origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="b" type="revolute"><parent link="one"/><child link="two"/>
<origin xyz="0.3 0 0"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>"""


def test_urdf_gives_links_of_dh_robot():
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
    assert (caught.value.place, caught.value.key, caught.value.value) == (
        "prior cad.urdf",
        "joint",
        "b",
    )


def test_file_holds_model_inputs(tmp_path, capsys):
    session, out, prior = (
        REPLAY / "scara" / "session.mcap",
        tmp_path / "fit.json",
        tmp_path / "prior.toml",
    )
    prior.write_text((REPLAY / "scara" / "robot.toml").read_text())
    command = ["fit", str(session), "--consistent", "--prior", str(prior), "--essential"]
    assert main([*command, "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    content = json.loads(out.read_text())
    model = InverseModel(robot_named("scara"))
    base, c, standard = (
        base_parameters(model).names,
        content["consistent"],
        content["standard_parameters"],
    )
    assert [p["name"] for p in standard] == list(model.names)
    assert c["prior"].startswith("prior.toml: ")
    assert f"chi² increases by {c['chi2']:.3g} over 8 parameters" in printed
    assert {p["name"] for p in content["left_out"] + content["parameters"]} == set(base)
    assert "robot.toml" in content["description"]
    assert [p.value for p in read_fit(out).standard_parameters] == [p["value"] for p in standard]
    assert [p["name"] for p in c["base_parameters"]] == list(base)
    assert max(abs(p["move"]) for p in c["base_parameters"]) == pytest.approx(c["largest_move"])
    assert all(p["half_width"] > 0 for p in c["base_parameters"] + standard)
    for one in standard:
        del one["half_width"]
    del c["base_parameters"]
    (tmp_path / "old.json").write_text(json.dumps(content))  # of an earlier version
    assert read_fit(tmp_path / "old.json").consistent.chi2 == c["chi2"]


def test_file_holds_parameters_dropped_by_essential():
    path = REPLAY / "tx40" / "session.mcap"
    fit = identify_ls(signals_of(path), Overrides(), essential=True)
    full, names = fit.full, fit.estimate.names
    sigma = np.sqrt(np.diag(full.covariance))
    left_out = [
        LeftOut(name=n, sigma=float(s))
        for n, s in zip(full.names, sigma, strict=True)
        if n not in names
    ]
    assert len(left_out) > 5
    assert fit_file(fit).left_out == left_out


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--prior", "x.toml"], ("--prior", "--consistent")),
        (["--consistent", "--prior", "none.toml"], ("none.toml", "cannot be read")),
        (["--consistent", "--prior", "none.urdf"], ("none.urdf", "cannot be read")),
    ],
)
def test_meaningless_options_refused(more, words, capsys):
    err = refused(capsys, "fit", REPLAY / "scara" / "session.mcap", *more)
    assert all(word in err for word in words)


def test_validate_judges_consistent_set(tmp_path, capsys, monkeypatch):
    session, out, free = (
        REPLAY / "scara" / "session.mcap",
        tmp_path / "fit.json",
        tmp_path / "free.json",
    )
    validation = tmp_path / "validation.json"
    assert main(["fit", str(session), "--consistent", "--json", str(out)]) == 0
    content = json.loads(out.read_text())

    integrated = []
    monkeypatch.setattr(
        "identification.results.parameters.errors_ahead", lambda *of: integrated.append(of)
    )

    def judged() -> tuple[float, float]:
        assert (
            main(["validate", str(out), str(session), "--consistent", "--json", str(validation)])
            == 0
        )
        found = json.loads(validation.read_text())
        return found["relative_error_percent"], found["consistent_errors"][-1][
            "relative_error_percent"
        ]

    expected = content["relative_error_percent"], content["consistent"]["relative_error_percent"]
    assert judged() == pytest.approx(expected, rel=1e-6)
    assert len(integrated) == 1  # of the fit, not also of the consistent set
    for one in content["standard_parameters"]:
        one["value"] *= 1.1
    out.write_text(json.dumps(content))
    plain, consistent = judged()
    assert consistent > 1.01 * plain
    assert "Physically consistent: " in capsys.readouterr().out
    between = [
        "validate",
        str(out),
        str(session),
        "--max-error-percent",
        str(0.5 * (plain + consistent)),
    ]
    assert main(between) == 0
    assert main([*between, "--consistent"]) == 3
    del content["standard_parameters"], content["consistent"]
    free.write_text(json.dumps(content))
    capsys.readouterr()
    assert "fit --consistent" in refused(capsys, "validate", free, session, "--consistent")
