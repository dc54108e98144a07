"""The robot's inverse dynamic model, linear in its standard parameters.

tau = IDM(q, dq, ddq) chi, equation (2) of Janot2014, with the standard parameters chi in Khalil's names: XX XY XZ YY YZ ZZ
(about the origin of the link's frame, kg m²), MX MY MZ (kg m), M (kg), rotor inertia Ia, viscous friction Fv, Coulomb
friction Fc, offset Off. Asymmetric friction has Fvp, Fcp for dq > 0 and Fvn, Fcn for dq < 0.
What motors and friction add, these and further terms, is in `joint_terms`; the columns of load friction, which depend on
parameters, are zero here.
"""

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from acquisition.errors import listed
from acquisition.robot import Robot

from ..arrays import Array
from ..errors import IdentificationError
from .joint_terms import SLIDING, JointTerm, joint_terms

LINK = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M")
FROM_PINOCCHIO = (4, 5, 7, 6, 8, 9, 1, 2, 3, 0)  # pinocchio's order is m, mx, my, mz, xx, xy, yy, xz, yz, zz
_CHUNK = 256  # samples per copy out of pinocchio: 256 regressors of six joints stay in the cache


class InverseModel:
    """Inverse dynamic model of a robot: `n` joints, `p` standard parameters with `names` and `units`, link by link."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.model = _model_from_urdf(robot) if robot.urdf is not None else _model_from_dh(robot)
        self.model.gravity.linear = np.array(robot.gravity)
        self._data = self.model.createData()
        n = robot.n
        self.sources: list[tuple[int, int] | JointTerm] = []  # (link, place in LINK) or a term of a joint
        for j in range(n):
            self.sources += [(j, i) for i in range(len(LINK))]
            self.sources += joint_terms(robot, j)
        self.names = tuple(s.name if isinstance(s, JointTerm) else f"{LINK[s[1]]}{s[0] + 1}" for s in self.sources)
        self.units = tuple(s.unit if isinstance(s, JointTerm) else _link_unit(robot, s) for s in self.sources)
        self._nonzero = self._structure()

    @property
    def p(self) -> int:
        """Number of standard parameters."""
        return len(self.names)

    def is_link_parameter(self, column: int) -> bool:
        """Whether a column belongs to a link (XX ... M) rather than to a motor or to friction."""
        return not isinstance(self.sources[column], JointTerm)

    @property
    def coulomb_directions(self) -> Array:
        """Directions r (c, n) that friction with a sign acts along, its speed being r·dq: of joints, and of coupled motors."""
        terms = [s for s in self.sources if isinstance(s, JointTerm) and s.kind in SLIDING]
        return np.array(list(dict.fromkeys(tuple(term.direction) for term in terms))).reshape(-1, self.robot.n)

    def entries(self, columns: NDArray[np.intp]) -> NDArray[np.intp]:
        """The entries (E, 2) of the regressor that are not zero by structure: (joint, place in `columns`)."""
        return np.argwhere(self._nonzero[:, columns])

    def series(self, q: Array, dq: Array, ddq: Array, columns: NDArray[np.intp]) -> Array:
        """Time series (E, N) of `entries(columns)` over the motion q, dq, ddq (N, n), in one pass over the samples."""
        n, N = self.robot.n, len(q)
        entries = self.entries(columns)
        out = np.empty((len(entries), N))
        places, picks = [], []
        for e, (j, c) in enumerate(entries):
            source = self.sources[columns[c]]
            if isinstance(source, JointTerm):
                out[e] = source.entry(int(j), dq, ddq)
            else:
                places.append(e)
                picks.append((10 * source[0] + FROM_PINOCCHIO[source[1]]) * n + int(j))
        self._link_series(q, dq, ddq, np.array(places, dtype=np.intp), np.array(picks, dtype=np.intp), out)
        return out

    def regressor(self, q: Array, dq: Array, ddq: Array) -> Array:
        """The whole regressor (N, n, p) over the motion q, dq, ddq (N, n)."""
        columns = np.arange(self.p)
        entries = self.entries(columns)
        W = np.zeros((len(q), self.robot.n, self.p))
        W[:, entries[:, 0], entries[:, 1]] = self.series(q, dq, ddq, columns).T
        return W

    def link_parameters(self) -> Array:
        """Parameters (n, 10) of the links in the order of `LINK` as the URDF has them, fixed and locked links lumped in.

        They are zero for a table of DH rows.
        """
        inertias = list(self.model.inertias)[1:]
        return np.array([inertia.toDynamicParameters() for inertia in inertias])[:, FROM_PINOCCHIO]

    @property
    def parents(self) -> tuple[int, ...]:
        """By joint, the link it sits on: 0 the base, j the link that joint number j moves."""
        return tuple(int(parent) for parent in self.model.parents)[1:]

    @property
    def joint_frames(self) -> tuple[Array, Array, Array]:
        """By joint, at position zero: origin (n, 3) and rotation (n, 3, 3) of its link's frame in that of the link it sits on,
        and its axis (n, 3) in its link's frame.
        """
        placements = list(self.model.jointPlacements)[1:]
        pin.computeJointJacobians(self.model, self._data, np.zeros(self.robot.n))
        axes = np.empty((self.robot.n, 3))
        for j, joint in enumerate(self.robot.joints):
            jacobian = np.asarray(pin.getJointJacobian(self.model, self._data, j + 1, pin.LOCAL))
            column = jacobian.reshape(6, -1)[:, j]  # of a single joint pinocchio gives a vector
            axes[j] = column[:3] if joint.type == "prismatic" else column[3:]
        return np.array([p.translation for p in placements]), np.array([p.rotation for p in placements]), axes

    def placements(self, q: Array) -> tuple[Array, Array]:
        """Where the links' frames are at the positions q (N, n): origins (N, n, 3), rotations (N, n, 3, 3), in the base."""
        origins, rotations = np.empty((*q.shape, 3)), np.empty((*q.shape, 3, 3))
        for k, qk in enumerate(np.ascontiguousarray(q, dtype=float)):
            pin.forwardKinematics(self.model, self._data, qk)
            for j, placement in enumerate(list(self._data.oMi)[1:]):
                origins[k, j], rotations[k, j] = placement.translation, placement.rotation
        return origins, rotations

    def _link_series(
        self, q: Array, dq: Array, ddq: Array, places: NDArray[np.intp], picks: NDArray[np.intp], out: Array
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
        for c, source in enumerate(self.sources):
            if isinstance(source, JointTerm):
                nonzero[source.rows, c] = True
            else:
                carriers = [joint - 1 for joint in self.model.supports[source[0] + 1] if joint > 0]
                nonzero[carriers, c] = True
        return nonzero


def _link_unit(robot: Robot, source: tuple[int, int]) -> str:
    """Unit of a link parameter; where the gain is unknown, that of joint torque in A or V in place of N m or N."""
    link, place = source
    power = 2 if place < 6 else 1 if place < 9 else 0  # kg m², kg m, kg
    if robot.gain_known:
        return ("kg", "kg m", "kg m²")[power]
    below = (1 if robot.joints[link].type == "prismatic" else 2) - power
    return f"{robot.effort_units[link]} s²" + {2: "/m²", 1: "/m", 0: "", -1: " m"}[below]


def _model_from_dh(robot: Robot) -> pin.Model:
    """Rot(x, alpha) Trans(x, d) Rot(z, theta) Trans(z, r): modified Denavit-Hartenberg, Khalil2002."""
    model, parent = pin.Model(), 0
    for joint in robot.joints:
        assert joint.dh is not None  # load_robot has seen to it
        about_x = pin.SE3(pin.utils.rotate("x", np.deg2rad(joint.dh.alpha_deg)), np.array([joint.dh.d_m, 0.0, 0.0]))
        about_z = pin.SE3(pin.utils.rotate("z", np.deg2rad(joint.dh.theta_deg)), np.array([0.0, 0.0, joint.dh.r_m]))
        kind = pin.JointModelRZ() if joint.type == "revolute" else pin.JointModelPZ()
        parent = model.addJoint(parent, kind, about_x * about_z, joint.name)
    return model


def _model_from_urdf(robot: Robot) -> pin.Model:
    """The movable joints that the description names, in its order; any others of the URDF are locked at zero."""
    place = f"robot {robot.name}: URDF"
    wanted = [joint.name for joint in robot.joints]
    try:
        root = ET.fromstring(robot.urdf or "")
        found = [str(joint.get("name")) for joint in root.findall("joint") if joint.get("type") != "fixed"]
        for name in wanted:
            if name not in found:
                expected = f"one of {listed(found)}"
                raise IdentificationError(place=place, key="movable joint", value=name, expected=expected)
        for joint in root.findall("joint"):
            if joint.get("name") in wanted:
                _free(joint, place)
            else:
                joint.set("type", "fixed")
        model = pin.buildModelFromXML(ET.tostring(root, encoding="unicode"))
    except (ET.ParseError, ValueError, RuntimeError, IndexError) as error:
        raise IdentificationError(f"does not load: {str(error).splitlines()[0]}", place=place) from error
    order = list(model.names)[1:]
    if order != wanted:
        shown = ", ".join(wanted)
        key = "order of joints"
        raise IdentificationError(place=place, key=key, value=wanted, shown=shown, expected=", ".join(order))
    for said, built in zip(robot.joints, list(model.joints)[1:], strict=True):
        prismatic = built.shortname().startswith("JointModelP")
        if prismatic != (said.type == "prismatic") or built.nq != 1:
            where = f"{place}: joint {said.name!r}"
            raise IdentificationError(place=where, key="type", value=built.shortname(), expected=said.type)
    return model


def _free(joint: ET.Element, place: str) -> None:
    """Make a joint one that pinocchio builds: with an axis, without limits, which a model does not need."""
    axis = joint.find("axis") if joint.get("type") != "floating" else None  # exporters write 0 0 0 for it
    if axis is not None and not any(float(x) for x in (axis.get("xyz") or "1").split()):
        where = f"{place}: joint {joint.get('name')!r}"
        raise IdentificationError(place=where, key="axis", value="0 0 0", expected="a direction")
    if joint.get("type") == "continuous":  # pinocchio would give it two coordinates
        joint.set("type", "revolute")
    if joint.get("type") in ("revolute", "prismatic"):  # without limits it is not built
        for limit in joint.findall("limit"):
            joint.remove(limit)
        ET.SubElement(joint, "limit", {"lower": "-1e9", "upper": "1e9", "effort": "1e9", "velocity": "1e9"})
