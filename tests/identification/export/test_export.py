"""`robot-identify export`: reloaded in pinocchio and MuJoCo, models have the fit's torques; the
user's files keep the rest.
"""

import dataclasses
import json
import re
import tomllib
import xml.etree.ElementTree as ET

import msgspec
import numpy as np
import pinocchio as pin
import pytest
import urdfs
from command_runs import refused, run
from conftest import REPLAY, robot_named
from fits_of_records import ls_of
from loops import simulate
from random_arms import set_own
from scipy.interpolate import CubicSpline

from acquisition.robot import load_robot, robot_from_files
from identification import Fit, load
from identification.control import Reference, described_law
from identification.errors import BadInputError, RobotIdimError
from identification.estimation import consistent_parameters
from identification.export import (
    export_model,
    make_urdf,
    model_of_fit,
    quaternion,
    replace_parameters,
    roll_pitch_yaw,
    split_parameters,
    write_models,
)
from identification.model import (
    InverseModel,
    JointTerm,
    base_parameters,
    direct_model,
    physical_parameters,
)
from identification.report import Covariance, LeftOut, read_fit, write_json
from identification.results import fit_file, stored_robot, with_consistent

SCARA = REPLAY / "scara" / "session.mcap"
RNG = np.random.default_rng(5)


def states(n, speed=2.0, acceleration=5.0, count=40):
    return (RNG.uniform(-s, s, (count, n)) for s in (3.0, speed, acceleration))


def values_of(model, seed=1):
    physical, rng = physical_parameters(model), np.random.default_rng(seed)
    chi = physical.start.copy()
    chi[physical.links] *= rng.uniform(0.5, 2.0, (len(physical.links), 1))
    rows = set_own(model, chi, lambda count: rng.uniform(0.1, 2.0, count))
    for c, source in enumerate(model.sources):
        if isinstance(source, JointTerm) and c not in rows:
            chi[c] = rng.uniform(0.1, 1.0)
    return chi


def exported(model, chi, folder, **outputs):
    paths = {
        name: folder / f"out.{name}" for name in ("urdf", "mjcf", "toml") if outputs.get(name, True)
    }
    made, document = export_model(split_parameters(model, chi, "fit.json"), "fit.json", **paths)
    write_models(made)
    return {name: path.read_text() for name, path in paths.items()}, document


def torque(model, chi, q, dq, ddq, *, without=()):
    """The fit's torque (N, n), terms of some kinds left out; `links` of all
    terms that are of joints.
    """
    left_out = (
        isinstance(s, JointTerm) and ("terms" in without or s.kind in without)
        for s in model.sources
    )
    kept = np.flatnonzero(~np.fromiter(left_out, bool))
    return model.regressor(q, dq, ddq)[:, :, kept] @ chi[kept]


def in_pinocchio(urdf, names, q, dq, ddq):
    whole = pin.buildModelFromXML(urdf)
    locked = [whole.getJointId(name) for name in list(whole.names)[1:] if name not in names]
    model = pin.buildReducedModel(whole, locked, pin.neutral(whole))
    return rnea(model, q, dq, ddq), model


def rnea(model, q, dq, ddq):
    data, found = model.createData(), np.empty_like(dq)
    for k in range(len(q)):
        joints = zip(q[k], list(model.joints)[1:], strict=True)
        at = [[x] if joint.nq == 1 else [np.cos(x), np.sin(x)] for x, joint in joints]
        found[k] = pin.rnea(model, data, np.concatenate(at), dq[k], ddq[k])
    return found


@pytest.fixture(scope="module")
def tx40_model():
    return InverseModel(dataclasses.replace(robot_named("tx40"), parameters={}))


@pytest.mark.parametrize("name", ["tx40", "scara", "emps"])
def test_new_urdf_matches_link_torques(name, tmp_path):
    robot = robot_named(name)
    if name == "tx40":
        robot = dataclasses.replace(robot, gravity=np.array([9.81, 0.0, 0.0]))
    model = InverseModel(robot)
    chi = values_of(model)
    texts, document = exported(model, chi, tmp_path)
    q, dq, ddq = states(robot.n)
    names = [joint.name for joint in robot.joints]
    found, loaded = in_pinocchio(texts["urdf"], names, q, dq, ddq)
    turned = tuple(robot.gravity) != (0.0, 0.0, -9.81)
    if turned:
        loaded.gravity.linear = np.array(robot.gravity)
        found = rnea(loaded, q, dq, ddq)
    assert list(loaded.names)[1:] == names
    np.testing.assert_allclose(found, torque(model, chi, q, dq, ddq, without=["terms"]), atol=1e-9)
    if name != "tx40":
        value = dict(zip(model.names, chi, strict=True))
        np.testing.assert_allclose(loaded.damping, [value[f"Fv{j + 1}"] for j in range(robot.n)])
        np.testing.assert_allclose(
            loaded.upperDryFrictionLimit, [value[f"Fc{j + 1}"] for j in range(robot.n)]
        )
    limits = [joint.si("position") for joint in robot.joints]
    found = zip(loaded.lowerPositionLimit, loaded.upperPositionLimit, strict=True)
    assert None in limits or list(found) == limits  # a joint without has two coordinates
    known = {"emps": [10.0 * 35.15065188]}.get(name)  # N: saturation in V, drive gain in N/V
    assert list(loaded.effortLimit) == (pytest.approx(known) if known else [1e9] * robot.n)
    assert list(loaded.velocityLimit) == pytest.approx(
        [joint.si("speed") for joint in robot.joints]
    )
    (lines,) = [
        s.lines for s in document.sections if s.title.startswith(str(tmp_path / "out.urdf"))
    ]
    assert any(line.startswith("a URDF has no gravity: set ") for line in lines) == turned
    unknown = (
        f"The effort limit of {', '.join(names)} is unknown and written as 1e+09. Set effort_nm, "
        "effort_n or saturation in robot.toml."
    )
    assert [line for line in lines if " is unknown and " in line] == ([] if known else [unknown])


def test_given_effort_is_limit_of_new_urdf():
    robot = robot_named("scara")
    keys = {"drive_gain": None, "drive_gain_unit": None, "effort_unit": "A"}
    motors = tuple(msgspec.structs.replace(m, **keys) for m in robot.motors)
    joints = tuple(msgspec.structs.replace(joint, effort_nm=30.0) for joint in robot.joints)
    model = InverseModel(dataclasses.replace(robot, motors=motors, joints=joints))
    assert make_urdf(model).count('effort="30.0"') == robot.n


def inverse_in_mujoco(text, q, dq, ddq, *, friction):
    mujoco = pytest.importorskip("mujoco", reason="mujoco, of the extra `test`, is not installed")
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    if not friction:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, found = mujoco.MjData(model), np.empty_like(q)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], dq[k], ddq[k]
        mujoco.mj_inverse(model, data)
        found[k] = data.qfrc_inverse
    return found, model


def test_frictionloss_is_saturated_dry_friction(tx40_model, tmp_path):
    """|v| > 0.25 rad/s of every joint and of motor 6, |a| < 2 rad/s²."""
    chi = values_of(tx40_model)
    texts, _ = exported(tx40_model, chi, tmp_path)
    q, dq, ddq = states(6, speed=3.0, acceleration=2.0, count=200)
    fast = (np.abs(dq) > 0.25).all(axis=1) & (np.abs(dq[:, 4] + dq[:, 5]) > 0.25)
    q, dq, ddq = q[fast], dq[fast], ddq[fast]
    assert len(q) > 50
    found, _ = inverse_in_mujoco(texts["mjcf"], q, dq, ddq, friction=True)
    np.testing.assert_allclose(
        found, torque(tx40_model, chi, q, dq, ddq, without=["offset"]), atol=1e-9
    )


USERS = urdfs.urdf(
    turn=urdfs.joint(
        "turn", "continuous", "base", "column", '<dynamics damping="9" friction="8"/>', "0 0.6 0.8"
    ),
    mount=urdfs.joint("mount", "fixed", "beam", "tool", origin="0.1 0.2 0"),
    left="<link name='left'><!-- by hand --><visual><geometry><mesh "
    "filename='package://arm/l.stl'/></geometry></visual></link>",
    extra="""<material name="grey"><color rgba="0.5 0.5 0.5 1"/></material> <!-- the hand -->
<xacro:note xmlns:xacro="http://www.ros.org/wiki/xacro" text="a > b"/>
<gazebo><plugin name="x" filename="libx.so"/></gazebo>
<!-- the end -->""",
)
USERS = USERS.replace("?>", ' encoding="utf-8"?>\n<!-- made by a CAD program; do not edit -->', 1)


def without_values(text):
    """A URDF in canonical form, comments included, without inertials and dynamics, and without
    blanks between elements.
    """
    text = ET.canonicalize(text, with_comments=True)
    for tag in ("inertial", "dynamics"):
        text = re.sub(rf"<{tag}[ >].*?</{tag}>", "", text, flags=re.DOTALL)
    return re.sub(r">\s+<", "><", text)


@pytest.mark.parametrize("light", [False, True])
def test_user_urdf_changes_values_only(light, tmp_path):
    """Header, comments, prefixes, meshes, limits stay, bodies have its names.

    A link too light for those fixed to it is all.
    """
    model = InverseModel(urdfs.robot_of_arm(USERS, "# my arm\n"))
    chi = values_of(model)
    chi[26:36] *= 0.3 if light else 10  # of the beam
    texts, document = exported(model, chi, tmp_path)
    assert without_values(texts["urdf"]) == without_values(USERS)
    assert texts["urdf"].startswith('<?xml version="1.0" encoding="utf-8"?>\n<!-- made by')
    q, dq, ddq = states(3)
    found, loaded = in_pinocchio(texts["urdf"], urdfs.ARM, q, dq, ddq)
    np.testing.assert_allclose(found, torque(model, chi, q, dq, ddq, without=["terms"]), atol=1e-9)
    value = dict(zip(model.names, chi, strict=True))
    np.testing.assert_allclose(loaded.damping, [value["Fv1"], value["Fv2"], value["Fv3"]])
    assert loaded.lowerPositionLimit[-1] == 0.1
    found, loaded = inverse_in_mujoco(texts["mjcf"], q, dq, ddq, friction=False)
    expected = torque(model, chi, q, dq, ddq, without=["coulomb", "offset"])
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert [loaded.body(k).name for k in (1, 2, 3)] == ["column", "arm", "beam"]
    said = " ".join(line for section in document.sections for line in section.lines)
    if light:
        assert '<link name="tool"/>' in texts["urdf"]
        assert "link beam: without the inertials of tool, right (0.4 kg)" in said
    else:
        assert '<mass value="0.3"/>' in texts["urdf"]
        assert "link beam: tool, right, fixed to it, keep" in said


def test_toml_has_values_and_all_other_lines(tx40_model, tmp_path):
    chi = values_of(tx40_model)
    texts, _ = exported(tx40_model, chi, tmp_path)
    again = load_robot(tmp_path / "out.toml")
    assert [again.parameters[name] for name in tx40_model.names] == list(chi)
    before, _, _ = (REPLAY / "tx40" / "robot.toml").read_text().partition("# A-priori values")
    head = "# Physically consistent values identified in fit.json.\n[parameters]\nXX1 = "
    assert texts["toml"].startswith(before + head)


@pytest.mark.parametrize(
    "table",
    [
        "",
        "parameters = { Fv1 = 1.0 }\n",
        "parameters.Fv1 = 1.0\nparameters.Fc1 = 2\n",
        "\n# old\n# remarks\n[parameters] # SI\nFv1 = 1.0\n# inside\nFc1 = 2\n\n# of the joint\n",
    ],
)
def test_parameters_replaced_in_any_notation(table):
    text = (
        f'name = "x"\nmatrix = [\n    [1, 0],\n    [0, 1],\n]\n{table}[[joint]]\nname = "j" # '
        "remark\n"
    )
    made = replace_parameters(text, {"Fv1": 0.25, "M1": 1e-3}, "new")
    was, now = tomllib.loads(text), tomllib.loads(made)
    assert now.pop("parameters") == {"Fv1": 0.25, "M1": 1e-3}
    was.pop("parameters", None)
    assert now == was
    for part, kept in (
        ("# remark", True),
        ("old", False),
        ("# of the joint", "# of the joint" in text),
    ):
        assert (part in made) == kept
    assert "# new\n[parameters]\n" in made


def test_urdf_of_any_name_replaced():
    text, name = 'name = "x"\nurdf = "a.urdf" # mine\n[controller]\n', 'bras\\é "2".urdf'
    made = replace_parameters(text, {"Fv1": 0.25}, "new", name)
    assert tomllib.loads(made)["urdf"] == name
    assert "# mine\n" in made


def test_irreplaceable_table_refused():
    with pytest.raises(BadInputError) as caught:
        replace_parameters('text = """\n[parameters]\n"""\n', {"Fv1": 1.0}, "new")
    assert caught.value.key == "[parameters]"


def test_toml_names_its_exported_urdf(tmp_path):
    model = InverseModel(urdfs.robot_of_arm(USERS, "# my arm\n"))
    texts, _ = exported(model, values_of(model), tmp_path)
    assert texts["toml"].startswith("# my arm\n")
    assert load_robot(tmp_path / "out.toml").urdf == texts["urdf"]
    _, document = exported(model, values_of(model), tmp_path, urdf=False)
    assert any(
        "it refers to arm.urdf, which is not in" in line
        for s in document.sections
        for line in s.lines
    )


def losses(document, title):
    """Rows of a format's table as (what, joint): (rms, percent)."""
    (section,) = [s for s in document.sections if s.title.endswith(title)]
    found, what = {}, ""
    for row in section.table.rows if section.table else ():
        what = row[0] or what
        found[what, row[1]] = (row[2].value, row[4].value)
    return found


def test_format_losses_reported_with_torque(tx40_model, tmp_path):
    chi = values_of(tx40_model)
    texts, document = exported(tx40_model, chi, tmp_path)
    of_urdf, of_mjcf = losses(document, "out.urdf"), losses(document, "out.mjcf")
    value = dict(zip(tx40_model.names, chi, strict=True))
    for j, joint in enumerate(tx40_model.robot.joints):
        for of in (of_urdf, of_mjcf):
            assert of["constant offset", joint.name][0] == pytest.approx(value[f"Off{j + 1}"])
    assert {what for what, _ in of_mjcf} == {"constant offset"}
    # Accelerations are spread evenly within ±a: their rms is a over root 3.
    rms = value["Ia3"] * tx40_model.robot.joints[2].si("acceleration") / np.sqrt(3)
    assert of_urdf["rotor inertia", "joint_3"][0] == pytest.approx(rms, rel=0.05)
    what = "friction (Fvm6, Fcm6)"
    assert {(w, joint) for w, joint in of_urdf if w.startswith("friction")} == {
        (what, "joint_5"),
        (what, "joint_6"),
    }
    # Joints have their own friction, at full size; that of the motor along both is missing.
    speeds = [joint.si("speed") for joint in tx40_model.robot.joints]
    dq = np.random.default_rng(2).uniform(-1, 1, (4000, 6)) * speeds
    zero = np.zeros_like(dq)
    _, loaded = in_pinocchio(
        texts["urdf"], [j.name for j in tx40_model.robot.joints], zero[:1], dq[:1], zero[:1]
    )
    np.testing.assert_allclose(loaded.damping, [value[f"Fv{j + 1}"] for j in range(6)])
    np.testing.assert_allclose(
        loaded.upperDryFrictionLimit, [value[f"Fc{j + 1}"] for j in range(6)]
    )
    both = [
        torque(tx40_model, chi, zero, dq, zero, without=kinds)[:, 4]
        for kinds in (["offset"], ["terms"])
    ]
    missing = (
        both[0] - both[1] - (dq * loaded.damping + np.sign(dq) * loaded.upperDryFrictionLimit)[:, 4]
    )
    assert of_urdf[what, "joint_5"][0] == pytest.approx(np.sqrt(np.mean(missing**2)), rel=0.05)


def test_negative_wrist_friction_exported_with_loss(
    tmp_path,
):
    """The published TX40: Fv6 - Fvm6 is below zero, which MuJoCo takes and gains energy by;
    robot.toml says it as it is.
    """
    robot = robot_named("tx40")
    model = InverseModel(robot)
    chi = np.array([robot.parameters.get(name, 0.0) for name in model.names])
    texts, document = exported(model, chi, tmp_path)
    found = losses(document, "out.mjcf")
    assert {(what, joint) for what, joint in found} == {("friction (Fv6)", "joint_6")}
    missing = (
        (robot.parameters["Fvm6"] - robot.parameters["Fv6"])
        * robot.joints[5].si("speed")
        / np.sqrt(3)
    )
    assert found["friction (Fv6)", "joint_6"][0] == pytest.approx(missing, rel=0.05)
    values = [
        float(x) for x in re.findall(r'(?:damping|frictionloss|armature)="([^"]*)"', texts["mjcf"])
    ]
    assert min(values) >= 0
    assert load_robot(tmp_path / "out.toml").parameters["Fv6"] == 0.6894
    chi[model.names.index("Fvm6")] = 1.2
    with pytest.raises(RobotIdimError) as caught:
        split_parameters(model, chi, "fit.json")
    assert caught.value.key == "viscous friction of joint_5 and joint_6"


def test_asymmetric_friction_written_as_mean(tmp_path):
    own = (REPLAY / "scara" / "robot.toml").read_text()
    text = own.replace('type = "revolute"', 'type = "revolute"\nfriction = "asymmetric"', 1)
    model = InverseModel(robot_from_files({"robot.toml": text.encode()}, "scara.toml"))
    chi = values_of(model)
    for name, value in {"Fvp1": 0.0, "Fvn1": 0.0, "Fcp1": 1.5, "Fcn1": 0.5}.items():
        chi[model.names.index(name)] = value
    texts, document = exported(model, chi, tmp_path)
    rms = losses(document, "out.mjcf")
    ((what, joint),) = rms
    assert (what, joint) == ("friction (Fcp1, Fcn1)", "shoulder")
    assert rms[what, joint][0] == pytest.approx(0.5, rel=0.01)
    found = re.search(r'name="shoulder".*?damping="([^"]*)" frictionloss="([^"]*)"', texts["mjcf"])
    assert [float(x) for x in found.groups()] == [0.0, 1.0]


def test_rotations_match_angles_and_quaternions():
    special = [0.3, np.pi / 2, 0.2], [0.0, -np.pi / 2, 0.0], [np.pi, 0, 0], [0, 0, np.pi]
    for angles in (*RNG.uniform(-3, 3, (20, 3)), *special):
        R = pin.rpy.rpyToMatrix(*angles)
        np.testing.assert_allclose(pin.rpy.rpyToMatrix(*roll_pitch_yaw(R)), R, atol=1e-14)
        np.testing.assert_allclose(pin.Quaternion(*quaternion(R)).matrix(), R, atol=1e-14)


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    folder, fit = tmp_path_factory.mktemp("fits"), ls_of(SCARA)
    files = {name: folder / f"{name}.json" for name in ("free", "consistent")}
    for path, made in zip(files.values(), (fit, with_consistent(fit)), strict=True):
        write_json(path, fit_file(made))
    return files


def outputs_in(folder, name="x", kinds=("urdf", "mjcf", "toml")):
    return [f"--{kind}={folder / name}.{kind}" for kind in kinds]


def test_inconsistent_fit_made_consistent(fits, tmp_path, capsys):
    values = {}
    for name, path in fits.items():
        status, printed, _ = run(capsys, "export", path, *outputs_in(tmp_path, name))
        assert status == 0
        assert ("adjusted to be physically consistent" in printed) == (name == "free")
        values[name] = load_robot(tmp_path / f"{name}.toml").parameters
    assert values["free"] == pytest.approx(values["consistent"], rel=1e-6, abs=1e-9)
    consistent = json.loads(fits["consistent"].read_text())["standard_parameters"]
    assert values["consistent"] == {
        p["name"]: p["value"] if abs(p["value"]) > 1e-18 else 0.0 for p in consistent
    }


def test_dropped_parameters_zero_with_standard_error(fits):
    stored = read_fit(fits["free"])
    names, sigma = [p.name for p in stored.parameters], 0.02
    out = names.index("ZZ2")  # no link has zero: how far from it depends on the deviation
    at = np.delete(np.arange(len(names)), out)
    C = np.array(stored.covariance.values)
    few = msgspec.structs.replace(
        stored,
        parameters=[stored.parameters[k] for k in at],
        covariance=Covariance(names=[names[k] for k in at], values=C[np.ix_(at, at)].tolist()),
        left_out=[LeftOut(name="ZZ2", sigma=sigma)],
    )
    beta = np.array([p.value for p in stored.parameters])
    beta[out], C[out], C[:, out], C[out, out] = 0.0, 0.0, 0.0, sigma**2
    model = InverseModel(stored_robot(stored, "fit.json"))
    expected = consistent_parameters(
        beta, C, base_parameters(model).K, physical_parameters(model)
    ).chi
    np.testing.assert_allclose(model_of_fit(few, "fit.json")[0].chi, expected, rtol=1e-6, atol=1e-9)


def changed(path, folder, change):
    content = json.loads(path.read_text())
    change(content)
    (folder / "changed.json").write_text(json.dumps(content))
    return folder / "changed.json"


def unknown_gain(content):
    text = content["description"]["robot.toml"]
    content["description"]["robot.toml"] = text.replace('effort_unit = "N m"', 'effort_unit = "A"')


def value_of(content, name):
    return next(p for p in content["standard_parameters"] if p["name"] == name)


REFUSED = {
    "friction": (lambda c: value_of(c, "Fv1").update(value=-0.1), "Fv1 = -0.1"),
    "dry friction": (lambda c: value_of(c, "Fc2").update(value=-0.1), "Fc2 = -0.1"),
    "link": (lambda c: value_of(c, "M2").update(value=-0.1), "link 2, of joint elbow"),
    "verdict": (lambda c: c.update(verdict="do not use"), "--allow-untrusted"),
    "amperes": (unknown_gain, "motor[0].drive_gain is missing"),
    "description": (lambda c: c.update(description={}), "description"),
    "names": (lambda c: c["standard_parameters"].pop(), "standard_parameters"),
    "covariance": (
        lambda c: (c.pop("standard_parameters"), c.pop("covariance")),
        "covariance is missing",
    ),
    "some of it": (
        lambda c: (c.pop("standard_parameters"), c["covariance"]["names"].pop()),
        "covariance",
    ),
}


@pytest.mark.parametrize("why", REFUSED)
def test_unusable_models_refused(why, fits, tmp_path, capsys):
    change, words = REFUSED[why]
    path = changed(fits["consistent"], tmp_path, change)
    assert words in refused(capsys, "export", path, *outputs_in(tmp_path))
    assert [p.name for p in tmp_path.iterdir()] == ["changed.json"]


def test_refused_fit_is_exported_on_request(fits, tmp_path, capsys):
    path = changed(fits["consistent"], tmp_path, lambda c: c.update(verdict="do not use"))
    status, printed, _ = run(capsys, "export", path, *outputs_in(tmp_path), "--allow-untrusted")
    assert (status, "verdict do not use" in printed) == (0, True)


def test_files_written_all_or_none(fits, tmp_path, capsys):
    (tmp_path / "x.mjcf").mkdir()
    for outputs in (outputs_in(tmp_path), [], ["--toml", fits["consistent"]]):
        refused(capsys, "export", fits["consistent"], *outputs)
    assert [p.name for p in tmp_path.iterdir()] == ["x.mjcf"]


DRAWS = 20


@pytest.fixture(scope="module")
def draws_of_tx40(tmp_path_factory):
    """A folder with the model of the TX40 and its draws, and what the command printed."""
    folder, fit = tmp_path_factory.mktemp("draws"), read_fit(REPLAY / "tx40" / "fit.json")
    printed = Fit(fit, "fit.json").export(
        **{kind: folder / f"x.{kind}" for kind in ("urdf", "mjcf", "toml")}, draws=DRAWS
    )
    return folder, printed


def test_draws_load_with_their_own_torques(draws_of_tx40):
    """In MuJoCo and pinocchio; rotors and links, since Fv6 of some is below zero."""
    folder, printed = draws_of_tx40
    names = [f"x_{k:02}" for k in range(1, DRAWS + 1)]
    assert {p.stem for p in folder.iterdir()} == {"x", *names}
    q, dq, ddq = states(6, count=5)
    found = []
    for name in names:
        robot = load_robot(folder / f"{name}.toml")
        model = InverseModel(robot)
        chi = np.array([robot.parameters[x] for x in model.names])
        text = (folder / f"{name}.mjcf").read_text()
        assert (
            min(map(float, re.findall(r'(?:damping|frictionloss|armature)="([^"]*)"', text))) >= 0
        )
        text = re.sub('damping="[^"]*"', 'damping="0"', text)
        in_mujoco, _ = inverse_in_mujoco(text, q, dq, ddq, friction=False)
        expected = torque(model, chi, q, dq, ddq, without=["viscous", "coulomb", "offset"])
        np.testing.assert_allclose(in_mujoco, expected, atol=1e-9)
        joints = [joint.name for joint in robot.joints]
        links, _ = in_pinocchio((folder / f"{name}.urdf").read_text(), joints, q, dq, ddq)
        expected = torque(model, chi, q, dq, ddq, without=["terms"])
        np.testing.assert_allclose(links, expected, atol=1e-9)
        found.append(in_mujoco)
    assert (np.std(found, axis=0) > 1e-6).all()
    first, last = (f"{folder}/x_{k}.mjcf" for k in ("01", "20"))
    assert f"{first} to {last}" in printed
    assert re.search(r"at a bound of physical consistency.*link 6", printed)
    assert re.search(r"spread below 90 % of the interval.*XY6", printed)


def test_same_seed_draws_same_files(fits, tmp_path, capsys):
    made = {}
    for name, options in {
        "a": ["--draws", 3],
        "b": ["--draws", 3, "--seed", 1],
        "c": ["--draws", 3, "--seed", 2],
        "d": [],
    }.items():
        folder = tmp_path / name
        folder.mkdir()
        assert run(capsys, "export", fits["consistent"], *outputs_in(folder), *options)[0] == 0
        made[name] = {p.name: p.read_bytes() for p in folder.iterdir()}
    assert made["a"] == made["b"]
    assert made["d"] == {name: made["c"][name] for name in ("x.urdf", "x.mjcf", "x.toml")}
    same = {name for name in made["a"] if made["a"][name] == made["c"][name]}
    assert same == {"x.urdf", "x.mjcf", "x.toml"}
    assert len({*made["a"].values(), *made["c"].values()}) == 3 + 2 * 9


def test_draws_replace_nothing_else(fits, tmp_path, capsys):
    fit, notes = fits["consistent"], tmp_path / "x_2.mjcf"
    notes.write_text("check the brake\n")
    command = ["export", fit, "--mjcf", tmp_path / "x.mjcf"]
    assert "x_2.mjcf: the file already exists" in refused(capsys, *command, "--draws", 3)
    both = "two outputs have this name"
    assert both in refused(capsys, *command, "--urdf", tmp_path / "x_1.mjcf", "--draws", 3)
    assert "--seed" in refused(capsys, *command, "--seed", 3)
    for options in ({"draws": -1}, {"draws": 1, "seed": -1}):
        with pytest.raises(BadInputError, match="0 or greater"):
            load(str(fit)).export(mjcf=tmp_path / "x.mjcf", **options)
    assert [p.name for p in tmp_path.iterdir()] == [notes.name]
    assert notes.read_text() == "check the brake\n"


GAINS = [
    {
        "motor": "j1",
        "unit": "N m/A",
        "described": 0.5,
        "value": 0.61,
        "half_width": 0.01,
        "determined": True,
    },
    {
        "motor": "j2",
        "unit": "N m/A",
        "described": 0.3,
        "value": 0.9,
        "half_width": 0.4,
        "determined": False,
    },
]
MOTORS = """[[motor]]  # shoulder
name = "{}"
drive_gain = 0.5  # catalogue
drive_gain_unit = "N m/A"

# the elbow
[[motor]]
name = "{}"
drive_gain = 0.3
drive_gain_unit = "N m/A"
"""


def in_amperes(content, motors, gains):
    """The fit's description with efforts in A by these [[motor]] tables, and identified gains."""
    text = content["description"]["robot.toml"]
    names = [motor["name"] for motor in tomllib.loads(text)["motor"]]
    head, _, rest = text.partition("[[motor]]")
    rest = rest[rest.index("\n[controller]") :]
    content["description"]["robot.toml"] = head + motors.format(*names) + rest
    content["gains"] = [gain | {"motor": name} for gain, name in zip(gains, names, strict=True)]


UNKNOWN = re.sub(r"(?m)^drive_gain = .*\ndrive_gain_unit = .*$", 'effort_unit = "A"', MOTORS)


@pytest.mark.parametrize(
    ("motors", "others", "expected", "said"),
    [
        (MOTORS, {}, [(0.61, 0.01), (0.3, None)], "as given"),
        (
            UNKNOWN,
            {"described": None},
            [(0.61, 0.01), (0.9, 0.4)],
            "as identified, since none is given",
        ),
    ],
)
def test_toml_has_well_determined_drive_gains(
    motors, others, expected, said, fits, tmp_path, capsys
):
    gains = [gain | others for gain in GAINS]
    path = changed(fits["consistent"], tmp_path, lambda content: in_amperes(content, motors, gains))
    status, printed, _ = run(capsys, "export", path, *outputs_in(tmp_path, kinds=("toml", "urdf")))
    assert (
        status,
        f"{said}; not well determined: 0.9 ± 0.4 N m/A" in " ".join(printed.split()),
    ) == (
        0,
        True,
    )
    robot, text = load_robot(tmp_path / "x.toml"), (tmp_path / "x.toml").read_text()
    assert [(m.drive_gain, m.drive_gain_half_width) for m in robot.motors] == expected
    assert ("drive_gain = 0.61  # catalogue\n" in text) == (motors == MOTORS)
    assert "[[motor]]  # shoulder\n" in text
    assert "\n\n# the elbow\n[[motor]]\n" in text


def under_law(name, structure):
    """A robot under a law at its motors of 6 Hz, its values, and a reference of 3
    s that begins at rest.
    """
    robot = robot_named(name)
    model = InverseModel(robot)
    chi = values_of(model)
    t, w = np.linspace(0.0, 3.0, 3001), 2 * np.pi * 6.0
    rng = np.random.default_rng(3)
    f, amplitude = rng.uniform(0.2, 0.6, (2, robot.n)), rng.uniform(0.1, 0.4, robot.n)
    shape = np.minimum(t, 1.0)[:, None] ** 2 * amplitude
    q_ref = shape * (np.sin(2 * np.pi * t[:, None] * f[0]) + np.sin(2 * np.pi * t[:, None] * f[1]))
    J, ratio = np.diag(direct_model(model, chi).inertia(q_ref[:1])[0]), np.diag(robot.R)
    kp, kd = J * w**2 / ratio**2 / robot.gain, 1.6 * J * w / ratio**2 / robot.gain
    position = kp / kd if structure.startswith("cascade") else kp
    law = msgspec.structs.replace(
        robot.controller, structure=structure, sample_rate_hz=1000.0, position_gain=tuple(position),
        velocity_gain=tuple(kd), integral_gain=None, velocity_estimate="exact",
    )  # fmt: skip
    robot = dataclasses.replace(robot, controller=law)
    return InverseModel(robot), chi, t, q_ref


@pytest.mark.parametrize(
    ("name", "structure"),
    [("scara", "pd"), ("tx40", "cascade_p_p"), ("scara", "pd_velocity_feedforward")],
)
def test_mujoco_actuators_match_control_law(name, structure, tmp_path):
    """Without Coulomb friction and offsets, which MuJoCo has softly or not at all; the wrist
    of the TX40 is coupled.
    """
    mujoco = pytest.importorskip("mujoco", reason="mujoco, of the extra `test`, is not installed")
    model, chi, t, q_ref = under_law(name, structure)
    chi[[isinstance(s, JointTerm) and s.kind in ("coulomb", "offset") for s in model.sources]] = 0.0
    texts, document = exported(model, chi, tmp_path, urdf=False, toml=False)
    told = [line for section in document.sections for line in section.lines]
    assert f"actuators follow positions by {structure}, without its sampling" in told
    loaded = mujoco.MjModel.from_xml_string(texts["mjcf"])
    loaded.opt.timestep, loaded.opt.integrator = 1e-3, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data, n = mujoco.MjData(loaded), model.robot.n
    path, moved = CubicSpline(t, q_ref), []
    data.qpos[:] = q_ref[0]
    # The place of an actuator is its joint's, or the sum along its tendon.
    rows = np.eye(n)
    if loaded.ntendon:
        rows[-1] = [0, 0, 0, 0, 1, 1]
    for _ in t[:-1]:
        moved.append(data.qpos.copy())
        r, dr = rows @ path(data.time), rows @ path(data.time, 1)
        data.ctrl[:] = np.column_stack([r, dr]).ravel() if loaded.nu == 2 * n else r
        mujoco.mj_step(loaded, data)
    simulated = simulate(
        direct_model(model, chi),
        described_law(model.robot),
        Reference(q_ref, path(t, 1), path(t, 2)),
    )
    assert simulated.reason is None
    q, given = simulated.q[: len(moved)], q_ref[: len(moved)]
    off, behind = (
        np.abs(q - other).max(axis=0) / np.ptp(q, axis=0) for other in (np.array(moved), given)
    )
    print(np.round(100 * off, 3), np.round(100 * behind, 1))
    assert off.max() < 0.02
    assert behind.max() > 0.02


@pytest.mark.parametrize("name", ["tx40", "scara"])
def test_estimated_law_written_if_none_given(name, tmp_path, capsys):
    stored, toml = read_fit(REPLAY / name / "fit.json"), tmp_path / "new.toml"
    assert run(capsys, "export", REPLAY / name / "fit.json", "--toml", toml)[0] == 0
    described, now = (robot_named(name).controller, load_robot(toml).controller)
    found = stored.law.controller
    for key, value in found.items():
        expected = value if name == "tx40" else getattr(described, key)
        assert getattr(now, key) == (tuple(expected) if isinstance(expected, list) else expected)
    assert now.bandwidth_hz == described.bandwidth_hz
    assert (found["structure"], len(stored.law.motors)) == (
        ("pid", 6) if name == "tx40" else (now.structure, 2)
    )
