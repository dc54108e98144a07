"""The robot's inverse dynamic model, linear in its standard parameters. The only file that imports pinocchio.

tau = IDM(q, dq, ddq) chi, equation (2) of Janot2014, with the standard parameters chi in Khalil's names: XX XY XZ YY YZ ZZ
(about the origin of the link's frame, kg m²), MX MY MZ (kg m), M (kg), rotor inertia Ia, viscous friction Fv, Coulomb
friction Fc, offset Off. Asymmetric friction has Fvp, Fcp for dq > 0 and Fvn, Fcn for dq < 0.

Motors act through the motor matrix. With r the row of motor m, divided by its entry at joint m, the motor turns at r·dq
and adds rᵀ Ia (r·ddq), rᵀ Fvm (r·dq), rᵀ Fcm sign(r·dq) to the joint torques; Fvm and Fcm exist where a motor turns with
several joints. As is the custom for coupled wrists, the part of Ia and Fvm that acts on one joint alone belongs to that
joint's own Ia and Fv: on the Stäubli TX40 tau5 has Ia6 ddq6 + Fvm6 dq6 and tau6 has Ia6 (ddq5 + ddq6) + Fvm6 dq5.
"""

import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from acquisition.robot import DH, Robot

from . import IdentificationError

Vector = NDArray[np.float64]

LINK = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M")
_FROM_PINOCCHIO = (4, 5, 7, 6, 8, 9, 1, 2, 3, 0)  # pinocchio's order is m, mx, my, mz, xx, xy, yy, xz, yz, zz
_CHUNK = 256  # samples per copy out of pinocchio: 256 regressors of six joints stay in the cache

Term = Callable[[Vector, Vector], Vector]


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTerm:
    """A standard parameter outside the links: its entries per joint as functions of (dq, ddq), each (N, n) → (N,)."""

    name: str
    unit: str
    rows: dict[int, Term]


class Dynamics:
    """Inverse dynamic model of a robot: `n` joints, `p` standard parameters with `names` and `units`, link by link."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.model = _model_from_urdf(robot) if robot.urdf is not None else _model_from_dh(robot)
        self.model.gravity.linear = np.array(robot.gravity)
        self._data = self.model.createData()
        n = robot.n
        terms = [_joint_terms(robot, j) for j in range(n)]
        self._source: list[tuple[int, int] | JointTerm] = []  # (link, place in LINK) or a term of a joint
        for j in range(n):
            self._source += [(j, i) for i in range(len(LINK))]
            self._source += terms[j]
        self.names = tuple(s.name if isinstance(s, JointTerm) else f"{LINK[s[1]]}{s[0] + 1}" for s in self._source)
        self.units = tuple(s.unit if isinstance(s, JointTerm) else _link_unit(robot, s) for s in self._source)
        self._nonzero = self._structure()

    @property
    def p(self) -> int:
        """Number of standard parameters."""
        return len(self.names)

    def is_link_parameter(self, column: int) -> bool:
        """Whether a column belongs to a link (XX ... M) rather than to a motor or to friction."""
        return not isinstance(self._source[column], JointTerm)

    def entries(self, columns: NDArray[np.intp]) -> NDArray[np.intp]:
        """The entries (E, 2) of the regressor that are not zero by structure: (joint, place in `columns`)."""
        return np.argwhere(self._nonzero[:, columns])

    def series(self, q: Vector, dq: Vector, ddq: Vector, columns: NDArray[np.intp]) -> Vector:
        """Time series (E, N) of `entries(columns)` over the motion q, dq, ddq (N, n), in one pass over the samples."""
        n, N = self.robot.n, len(q)
        entries = self.entries(columns)
        out = np.empty((len(entries), N))
        places, picks = [], []
        for e, (j, c) in enumerate(entries):
            source = self._source[columns[c]]
            if isinstance(source, JointTerm):
                out[e] = source.rows[int(j)](dq, ddq)
            else:
                places.append(e)
                picks.append((10 * source[0] + _FROM_PINOCCHIO[source[1]]) * n + int(j))
        self._link_series(q, dq, ddq, np.array(places, dtype=np.intp), np.array(picks, dtype=np.intp), out)
        return out

    def regressor(self, q: Vector, dq: Vector, ddq: Vector) -> Vector:
        """The whole regressor (N, n, p) over the motion q, dq, ddq (N, n)."""
        columns = np.arange(self.p)
        entries = self.entries(columns)
        W = np.zeros((len(q), self.robot.n, self.p))
        W[:, entries[:, 0], entries[:, 1]] = self.series(q, dq, ddq, columns).T
        return W

    def _link_series(
        self, q: Vector, dq: Vector, ddq: Vector, places: NDArray[np.intp], picks: NDArray[np.intp], out: Vector
    ) -> None:
        """Fill out[places] with the entries `picks` of pinocchio's regressor, stored by columns."""
        if not len(places):
            return
        compute, model, data = pin.computeJointTorqueRegressor, self.model, self._data
        regressor = data.jointTorqueRegressor.T  # a view: filled anew by each call, by rows when transposed
        buffer = np.empty((_CHUNK, *regressor.shape))
        flat = buffer.reshape(_CHUNK, -1)
        q, dq, ddq = (np.ascontiguousarray(x) for x in (q, dq, ddq))
        for k in range(0, len(q), _CHUNK):
            chunk = slice(k, k + _CHUNK)
            rows = q[chunk]
            for qk, vk, ak, target in zip(rows, dq[chunk], ddq[chunk], buffer, strict=False):
                compute(model, data, qk, vk, ak)
                target[:] = regressor
            out[places, chunk] = flat[: len(rows), picks].T

    def _structure(self) -> NDArray[np.bool_]:
        """Which entries (n, p) of the regressor can be other than zero: joint j feels link i if j carries it."""
        nonzero = np.zeros((self.robot.n, self.p), dtype=bool)
        for c, source in enumerate(self._source):
            if isinstance(source, JointTerm):
                nonzero[list(source.rows), c] = True
            else:
                carriers = [joint - 1 for joint in self.model.supports[source[0] + 1] if joint > 0]
                nonzero[carriers, c] = True
        return nonzero


def _motor_rows(robot: Robot) -> Vector:
    """Motor matrix (n, n) with each row divided by its entry at the motor's own joint, or else by its largest."""
    own = np.diag(robot.R).copy()
    for m in np.flatnonzero(own == 0):
        own[m] = robot.R[m, np.argmax(np.abs(robot.R[m]))]
    return np.asarray(robot.R / own[:, None])


def _joint_terms(robot: Robot, j: int) -> list[JointTerm]:
    """Rotor, friction and offset columns that carry the number of joint j, motor matrix included."""
    joint, number = robot.joints[j], j + 1
    rows = _motor_rows(robot)
    r = rows[j]
    alone = np.count_nonzero(rows, axis=1) == 1  # motors that turn with one joint only
    coupled = [int(i) for i in np.flatnonzero(r)]
    effort, length = robot.effort_units[j], joint.position_unit
    viscous_unit, inertia_unit = f"{effort} s/{length}", _inertia_unit(robot, j)

    def own(*names_and_terms: tuple[str, str, Term]) -> list[JointTerm]:
        return [JointTerm(name=f"{name}{number}", unit=unit, rows={j: t}) for name, unit, t in names_and_terms]

    terms: list[JointTerm] = []
    if joint.rotor_inertia:
        # The share of a diagonal entry goes to the Ia of the joint it acts on, where there is one that can take it.
        taken = [i for i in coupled if i != j and alone[i] and robot.joints[i].rotor_inertia]
        terms.append(JointTerm(name=f"Ia{number}", unit=inertia_unit, rows=_through_motor(r, taken, acceleration=True)))
    if joint.friction == "symmetric":
        viscous = own(("Fv", viscous_unit, lambda dq, _: dq[:, j]))
        coulomb = own(("Fc", effort, lambda dq, _: np.sign(dq[:, j])))
    else:
        viscous = own(
            ("Fvp", viscous_unit, lambda dq, _: np.maximum(dq[:, j], 0.0)),
            ("Fvn", viscous_unit, lambda dq, _: np.minimum(dq[:, j], 0.0)),
        )
        coulomb = own(
            ("Fcp", effort, lambda dq, _: (dq[:, j] > 0).astype(float)),
            ("Fcn", effort, lambda dq, _: -(dq[:, j] < 0).astype(float)),
        )
    for v, c in zip(viscous, coulomb, strict=True):
        terms += [v] * joint.viscous + [c] * joint.coulomb
    if joint.offset:
        terms += own(("Off", effort, lambda dq, _: np.ones(len(dq))))
    if len(coupled) > 1 and joint.viscous:
        taken = [i for i in coupled if robot.joints[i].viscous and robot.joints[i].friction == "symmetric"]
        terms.append(
            JointTerm(name=f"Fvm{number}", unit=viscous_unit, rows=_through_motor(r, taken, acceleration=False))
        )
    if len(coupled) > 1 and joint.coulomb:
        sign = {i: _scaled(float(r[i]), lambda dq, _: np.sign(dq @ r)) for i in coupled}
        terms.append(JointTerm(name=f"Fcm{number}", unit=effort, rows=sign))
    return terms


def _through_motor(r: Vector, taken: list[int], *, acceleration: bool) -> dict[int, Term]:
    """Entries rᵀ r x of a motor's column, x = ddq or dq, less the diagonal entries of the joints in `taken`."""

    def entry(i: int) -> Term:
        weights = r[i] * r
        if i in taken:
            weights = weights - np.eye(len(r))[i] * r[i] ** 2
        return lambda dq, ddq: (ddq if acceleration else dq) @ weights

    return {int(i): entry(int(i)) for i in np.flatnonzero(r) if int(i) not in taken or np.count_nonzero(r) > 1}


def _scaled(factor: float, term: Term) -> Term:
    return lambda dq, ddq: factor * term(dq, ddq)


def _inertia_unit(robot: Robot, j: int) -> str:
    if not robot.gain_known:
        return f"{robot.effort_units[j]} s²/{robot.joints[j].position_unit}"
    return "kg m²" if robot.joints[j].type == "revolute" else "kg"


def _link_unit(robot: Robot, source: tuple[int, int]) -> str:
    """Unit of a link parameter; where the gain is unknown, that of joint torque in A or V in place of N m or N."""
    link, place = source
    power = 2 if place < 6 else 1 if place < 9 else 0  # kg m², kg m, kg
    if robot.gain_known:
        return ("kg", "kg m", "kg m²")[power]
    below = (1 if robot.joints[link].type == "prismatic" else 2) - power
    return f"{robot.effort_units[link]} s²" + {2: "/m²", 1: "/m", 0: "", -1: " m"}[below]


def _placement(dh: DH) -> pin.SE3:
    """Rot(x, alpha) Trans(x, d) Rot(z, theta) Trans(z, r): modified Denavit-Hartenberg, Khalil2002."""
    about_x = pin.SE3(pin.utils.rotate("x", np.deg2rad(dh.alpha_deg)), np.array([dh.d_m, 0.0, 0.0]))
    about_z = pin.SE3(pin.utils.rotate("z", np.deg2rad(dh.theta_deg)), np.array([0.0, 0.0, dh.r_m]))
    return about_x * about_z


def _model_from_dh(robot: Robot) -> pin.Model:
    model, parent = pin.Model(), 0
    for joint in robot.joints:
        assert joint.dh is not None  # load_robot has seen to it
        kind = pin.JointModelRZ() if joint.type == "revolute" else pin.JointModelPZ()
        parent = model.addJoint(parent, kind, _placement(joint.dh), joint.name)
    return model


def _model_from_urdf(robot: Robot) -> pin.Model:
    """The movable joints that the description names, in its order; any others of the URDF are locked at zero."""
    place = f"robot {robot.name}: URDF"
    try:
        root = ET.fromstring(robot.urdf or "")
        for joint in root.iter("joint"):
            if joint.get("type") == "continuous":  # pinocchio would give it two coordinates
                joint.set("type", "revolute")
                limits = {"lower": "-1e9", "upper": "1e9", "effort": "1e9", "velocity": "1e9"}
                for limit in joint.findall("limit"):
                    joint.remove(limit)
                ET.SubElement(joint, "limit", limits)
        whole = pin.buildModelFromXML(ET.tostring(root, encoding="unicode"))
    except (ET.ParseError, ValueError, RuntimeError, IndexError) as error:
        raise IdentificationError(f"{place} does not load: {str(error).splitlines()[0]}") from error
    found = list(whole.names)[1:]
    wanted = [joint.name for joint in robot.joints]
    for name in wanted:
        if name not in found:
            raise IdentificationError(f"{place}: no movable joint {name!r}; expected one of {', '.join(found)}")
    locked = [whole.getJointId(name) for name in found if name not in wanted]
    model = pin.buildReducedModel(whole, locked, pin.neutral(whole))
    order = list(model.names)[1:]
    if order != wanted:
        raise IdentificationError(f"{place}: joints in the order {', '.join(wanted)}; expected {', '.join(order)}")
    for said, built in zip(robot.joints, list(model.joints)[1:], strict=True):
        prismatic = built.shortname().startswith("JointModelP")
        if prismatic != (said.type == "prismatic") or built.nq != 1:
            raise IdentificationError(f"{place}: joint {said.name!r} is {built.shortname()}; expected {said.type}")
    return model
