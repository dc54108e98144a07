"""The robot's inverse dynamic model, linear in its standard parameters.

    tau = IDM(q, dq, ddq) chi,     equation (2) of Janot2014

The standard parameters chi have Khalil's names: XX XY XZ YY YZ ZZ (about the origin of the link's
frame, kg m²), MX MY MZ (kg m), M (kg), rotor inertia Ia, viscous friction Fv, Coulomb friction Fc,
offset Off. Asymmetric friction has Fvp, Fcp for dq > 0 and Fvn, Fcn for dq < 0. The terms of motors
and friction are in `joint_terms`. The columns of load-dependent friction depend on parameters and
are zero here.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from functools import cached_property
from itertools import product

import numpy as np
import pinocchio as pin

from acquisition.errors import Location, listed
from acquisition.robot import Robot

from ..arrays import Array, Ints
from ..errors import BadInputError
from .joint_terms import SLIDING, JointTerm, joint_terms

LINK = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M")
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of XX XY XZ YY YZ ZZ
# pinocchio's order is m, mx, my, mz, xx, xy, yy, xz, yz, zz
FROM_PINOCCHIO = (4, 5, 7, 6, 8, 9, 1, 2, 3, 0)
# Elements of a URDF that its model is built from, and its numbers: path, attributes, how many.
_NEEDED = {"link": ("inertial",), "joint": ("parent", "child", "origin", "axis")}
_NUMBERS = (
    ("axis", ("xyz",), 3),
    *((path, ("xyz", "rpy"), 3) for path in ("origin", "inertial/origin", "collision/origin")),
    ("inertial/mass", ("value",), 1),
    ("inertial/inertia", ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 1),
)
_FINITE = r"\s+[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?\s*"
_BLOCK = 2048  # samples, so that the twists of six joints fit in the cache


class InverseModel:
    """Inverse dynamic model of a robot.

    Attributes:
        robot: description of the robot, with n joints.
        model: pinocchio's model.
        sources: origin of each standard parameter: (link, place in `LINK`), or a term of a joint.
        terms: terms of joints, by column.
        names: (p,) names of the standard parameters, link by link.
        units: (p,) their units.
        p: number of standard parameters.
        of_links: (p,) mask of the parameters of links.
        nonzero: (n, p) mask of the entries of the regressor that can be non-zero.
        coulomb_directions: (c, n) directions r of friction with a sign, of joints and coupled
            motors, with the speed r·dq.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.model = _model_from_urdf(robot) if robot.urdf is not None else _model_from_dh(robot)
        self.model.gravity.linear = np.array(robot.gravity)
        self._data, n = self.model.createData(), robot.n
        self.sources: list[tuple[int, int] | JointTerm] = []
        for j in range(n):
            self.sources += [(j, i) for i in range(len(LINK))]
            self.sources += joint_terms(robot, j)
        self.terms = {c: s for c, s in enumerate(self.sources) if isinstance(s, JointTerm)}
        self.names = tuple(
            s.name if isinstance(s, JointTerm) else f"{LINK[s[1]]}{s[0] + 1}" for s in self.sources
        )
        self.units = tuple(
            s.unit if isinstance(s, JointTerm) else _link_unit(robot, s) for s in self.sources
        )
        self.p, self.of_links = (
            len(self.names),
            np.array([not isinstance(s, JointTerm) for s in self.sources]),
        )
        # A parameter of a link affects all joints that carry it.
        self.nonzero = np.zeros((n, self.p), dtype=bool)
        for c, s in enumerate(self.sources):
            self.nonzero[s.rows if isinstance(s, JointTerm) else self._carriers[s[0]], c] = True
        along = [tuple(term.direction) for term in self.terms.values() if term.kind in SLIDING]
        self.coulomb_directions = np.array(list(dict.fromkeys(along))).reshape(-1, n)

    def entries(self, columns: Ints) -> Ints:
        """Return the entries (E, 2) of the regressor that can be non-zero.

        Each is a joint and a place in `columns`.
        """
        return np.argwhere(self.nonzero[:, columns])

    def series(self, q: Array, dq: Array, ddq: Array, columns: Ints) -> Array:
        """Return time series (E, N) of `entries(columns)` over the motion q, dq, ddq (N, n)."""
        entries = self.entries(columns)
        out = np.empty((len(entries), len(q)))
        rows: dict[int, dict[int, list[int]]] = {}  # of out, by link and place in LINK
        for e, (j, c) in enumerate(entries):
            source = self.sources[columns[c]]
            if isinstance(source, JointTerm):
                out[e] = source.entry(int(j), dq, ddq)
            else:
                rows.setdefault(source[0], {}).setdefault(source[1], []).append(e)
        links, gravity = 1 + max(rows, default=-1), np.array(self.robot.gravity)
        for block, twists in self._twists((q, dq, ddq), links, gravity):
            for i, own in rows.items():
                torques = _link_torques(twists[i + 1], _FORCES[[*own]], _MOMENTS[[*own]])
                out[np.concatenate([*own.values()]), block] = torques
        return out

    def regressor(self, q: Array, dq: Array, ddq: Array, columns: Ints | None = None) -> Array:
        """Return the regressor IDM (N, n, b) over the motion q, dq, ddq (N, n).

        It has the given `columns` (b,), or all.
        """
        columns = np.arange(self.p) if columns is None else columns
        entries, W = self.entries(columns), np.zeros((*q.shape, len(columns)))
        W[:, entries[:, 0], entries[:, 1]] = self.series(q, dq, ddq, columns).T
        return W

    def link_parameters(self) -> Array:
        """Return the URDF's parameters (n, 10) of the links in the order of `LINK`.

        They include fixed and locked links; they are zero for a robot given by DH rows.
        """
        return np.array(
            [inertia.toDynamicParameters() for inertia in list(self.model.inertias)[1:]]
        )[:, FROM_PINOCCHIO]

    @cached_property
    def parents(self) -> tuple[int, ...]:
        """Parent link of each joint: 0 is the base, j the link that joint number j moves."""
        return tuple(int(parent) for parent in self.model.parents)[1:]

    @cached_property
    def joint_frames(self) -> tuple[Array, Array, Array]:
        """Frames of the joints at position zero: origin (n, 3), rotation (n, 3, 3), axis (n, 3).

        Origin, m, and rotation of a link's frame are in the parent link's frame; the axis is in the
        link's frame.
        """
        placements = list(self.model.jointPlacements)[1:]
        pin.computeJointJacobians(self.model, self._data, np.zeros(self.robot.n))
        axes = np.empty((self.robot.n, 3))
        for j, joint in enumerate(self.robot.joints):
            column = np.asarray(
                pin.getJointJacobian(self.model, self._data, j + 1, pin.LOCAL)
            ).reshape(6, -1)[:, j]  # of a robot with a single joint, pinocchio returns a vector
            axes[j] = column[:3] if joint.type == "prismatic" else column[3:]
        return (
            np.array([p.translation for p in placements]),
            np.array([p.rotation for p in placements]),
            axes,
        )

    def placements(self, q: Array) -> tuple[Array, Array]:
        """Return the links' frames in the base frame at the positions q (N, n).

        These are origins (N, n, 3), m, and rotations (N, n, 3, 3).
        """
        origins, rotations = np.empty((*q.shape, 3)), np.empty((*q.shape, 3, 3))
        for k, qk in enumerate(np.ascontiguousarray(q, dtype=float)):
            pin.forwardKinematics(self.model, self._data, qk)
            for j, placement in enumerate(list(self._data.oMi)[1:]):
                origins[k, j], rotations[k, j] = placement.translation, placement.rotation
        return origins, rotations

    def torques_of_links(
        self, motion: tuple[Array, Array, Array], parameters: Array, gravity: Array
    ) -> Array:
        """Return torques (K, N, n) of links with each of K sets of parameters, N m or N.

        Parameters
        ----------
        motion : q, dq, ddq, (N, n) each.
        parameters : (K, n, 10) in the order of `LINK`.
        gravity : (3,) in the base frame, m/s².
        """
        (N, n), K, unit_wrenches = motion[0].shape, len(parameters), (_FORCES, _MOMENTS)
        tau = np.zeros((K, n, N))
        for block, twists in self._twists(motion, n, gravity):
            for i, carriers in enumerate(self._carriers):
                tau[:, carriers, block] += _link_torques(
                    twists[i + 1], *(np.tensordot(parameters[:, i], x, 1) for x in unit_wrenches)
                ).reshape(K, len(carriers), -1)
        return np.ascontiguousarray(tau.swapaxes(1, 2))

    def _twists(
        self, motion: tuple[Array, Array, Array], links: int, gravity: Array
    ) -> Iterator[tuple[slice, list[Array]]]:
        """Yield twists of the base and the first links, as `_carried`, by block of samples."""
        base = np.zeros((2, 3, 2, 1))
        base[0, :, 1, 0] = -gravity
        for k in range(0, len(motion[0]), _BLOCK):
            q, dq, ddq = (np.ascontiguousarray(x[k : k + _BLOCK].T) for x in motion)
            twists = [base]
            for i in range(links):
                twists.append(self._carried(i, twists[self.parents[i]], q[i], dq[i], ddq[i]))
            yield slice(k, k + _BLOCK), twists

    def _carried(self, i: int, before: Array, q: Array, dq: Array, ddq: Array) -> Array:
        """Return the twists of link i in its frame, (linear and angular, 3, 2 + joints, N).

        They are its velocity, its acceleration minus gravity, and its velocity for each joint that
        carries it at unit speed; `before` are the twists of its parent.
        """
        origin, axis, R, by_sin, by_cos = self._placements[i]
        prismatic = int(self.robot.joints[i].type == "prismatic")
        if prismatic:
            origin = origin + (R[..., 0] @ axis)[:, None] * q
        else:
            R = R + by_sin * np.sin(q) + by_cos * np.cos(q)
        linear = before[0] + np.zeros(len(q))
        for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # v + w x r
            if origin[c].any():
                linear[a] += before[1, b] * origin[c]
                linear[b] -= before[1, a] * origin[c]
        count = before.shape[2]
        twist = np.empty((2, 3, count + 1, len(q)))
        for part, of in ((0, linear), (1, before[1])):
            np.einsum("ban,bjn->ajn", R, of, out=twist[part, :, :count])
        own, (v, w) = axis[:, None] * dq, twist[:, :, 0]
        twist[1 - prismatic, :, 0] += own
        twist[1 - prismatic, :, 1] += axis[:, None] * ddq
        twist[0, :, 1] += _cross(w if prismatic else v, own)
        if not prismatic:
            twist[1, :, 1] += _cross(w, own)
        twist[:, :, count] = 0.0
        twist[1 - prismatic, :, count] = axis[:, None]
        return twist

    @cached_property
    def _placements(self) -> list[tuple[Array, ...]]:
        """Placement of each joint, with the rotation R + by_sin sin q + by_cos cos q.

        It has origin (3, 1), axis (3,), and R, by_sin, by_cos (3, 3, 1).
        """
        turning = np.array([joint.type == "revolute" for joint in self.robot.joints])
        crosses = np.cross(np.eye(3), self.joint_frames[2][:, None]) * turning[:, None, None]
        return [
            (origin[:, None], axis, *(x[..., None] for x in (R + R @ K @ K, R @ K, -R @ K @ K)))
            for origin, R, axis, K in zip(*self.joint_frames, crosses, strict=True)
        ]

    @cached_property
    def _carriers(self) -> list[list[int]]:
        """Joints that carry each link."""
        return [
            [joint - 1 for joint in joints if joint > 0] for joints in list(self.model.supports)[1:]
        ]


def link_columns(idm: InverseModel) -> Ints:
    """Return the columns (n, 10) of XX XY XZ YY YZ ZZ MX MY MZ M of each link."""
    return np.flatnonzero(idm.of_links).reshape(-1, len(LINK))


def _link_torques(twist: Array, forces: Array, moments: Array) -> Array:
    """Return torques (P * joints, N) of the joints that carry a link (Khalil2002).

        f = M a + dw × MS + w × (w × MS),     n = I dw + w × I w + MS × a
        torque = v·f + w·n,     v, w the link's velocities at unit joint speed

    P forces f and moments n, (P, 3, 12) each, are as in `_unit_wrenches`.
    """
    (v, w), (a, dw) = twist[:, :, 0], twist[:, :, 1]
    # The accelerations and products of velocities that f and n are linear in.
    of = np.concatenate([a + _cross(w, v), dw, w[[0, 0, 0, 1, 1, 2]] * w[[0, 1, 2, 1, 2, 2]]])
    N, pushed = of.shape[1], forces.any(axis=(1, 2))
    out = np.einsum(
        "cjn,pcn->pjn", twist[1, :, 2:], (moments.reshape(-1, 12) @ of).reshape(-1, 3, N)
    )
    if pushed.any():
        out[pushed] += np.einsum(
            "cjn,pcn->pjn", twist[0, :, 2:], (forces[pushed].reshape(-1, 12) @ of).reshape(-1, 3, N)
        )
    return np.asarray(out.reshape(-1, N))


def _unit_wrenches() -> tuple[Array, Array]:
    """Return force and moment (10, 3, 12) of a link per unit of each parameter of `LINK`.

    They are linear in its acceleration a, its angular acceleration dw, and the products wx wx, wx
    wy, wx wz, wy wy, wy wz, wz wz of its angular velocity.
    """
    forces, moments = np.zeros((2, 10, 3, 12))
    S = np.cross(np.eye(3)[:, None], np.eye(3)[None])  # S[i, k]: e_i x e_k
    product = {pair: 6 + k for k, (i, j) in enumerate(_PAIRS) for pair in ((i, j), (j, i))}
    for place, (i, j) in enumerate(_PAIRS):
        inertia = np.zeros((3, 3))
        inertia[i, j] = inertia[j, i] = 1.0
        moments[place, :, 3:6] = inertia
        for b, c in np.ndindex(3, 3):
            moments[place, :, product[b, c]] += np.cross(np.eye(3)[b], inertia[:, c])
    for k in range(3):
        moments[6 + k, :, :3] = S[k].T
        forces[6 + k, :, 3:6] = S[:, k].T
        for b, c in np.ndindex(3, 3):
            forces[6 + k, :, product[b, c]] += np.cross(np.eye(3)[b], S[c, k])
    forces[9, :, :3] = np.eye(3)
    return forces, moments


def _cross(x: Array, y: Array) -> Array:
    """Return cross products along axis 0."""
    return np.asarray(x[[1, 2, 0]] * y[[2, 0, 1]] - x[[2, 0, 1]] * y[[1, 2, 0]])


_FORCES, _MOMENTS = _unit_wrenches()


def _link_unit(robot: Robot, source: tuple[int, int]) -> str:
    """Return the unit of a link parameter; it has A or V if the drive gain is unknown."""
    link, place = source
    power = 2 if place < 6 else 1 if place < 9 else 0  # kg m², kg m, kg
    if robot.gain_known:
        return ("kg", "kg m", "kg m²")[power]
    below = (1 if robot.joints[link].type == "prismatic" else 2) - power
    return f"{robot.effort_units[link]} s²" + {2: "/m²", 1: "/m", 0: "", -1: " m"}[below]


def _model_from_dh(robot: Robot) -> pin.Model:
    """Build the model from modified Denavit–Hartenberg rows (Khalil2002).

    Rot(x, alpha) Trans(x, d) Rot(z, theta) Trans(z, r)
    """
    model, parent, rotate = pin.Model(), 0, pin.utils.rotate
    for joint in robot.joints:
        dh = joint.dh
        assert dh is not None  # load_robot checks it
        about_x = pin.SE3(rotate("x", np.deg2rad(dh.alpha_deg)), np.array([dh.d_m, 0.0, 0.0]))
        about_z = pin.SE3(rotate("z", np.deg2rad(dh.theta_deg)), np.array([0.0, 0.0, dh.r_m]))
        parent = model.addJoint(
            parent,
            pin.JointModelRZ() if joint.type == "revolute" else pin.JointModelPZ(),
            about_x * about_z,
            joint.name,
        )
    return model


def _model_from_urdf(robot: Robot) -> pin.Model:
    """Build the model of the movable joints that the description names.

    Other joints are locked at zero.
    """
    place, wanted = f"robot {robot.name}: URDF", [joint.name for joint in robot.joints]
    try:
        root = ET.fromstring(robot.urdf or "")
        joints = root.findall("joint")
        found = [str(joint.get("name")) for joint in joints if joint.get("type") != "fixed"]
        for name in wanted:
            Location(place).require(name in found, "movable joint", name, f"one of {listed(found)}")
        _refuse_malformed_numbers(root, place)
        # Remove what the model does not need, such as visuals, so that it cannot fail.
        for element in root:
            element[:] = [part for part in element if part.tag in _NEEDED.get(element.tag, ())]
        root[:] = [element for element in root if element.tag in _NEEDED]
        for joint in joints:
            if joint.get("name") in wanted:
                _make_buildable(joint, place)
            else:
                joint.set("type", "fixed")
        model = pin.buildModelFromXML(ET.tostring(root, encoding="unicode"))
    except (ET.ParseError, ValueError, RuntimeError, IndexError) as error:
        raise BadInputError(
            f"cannot be loaded: {str(error).splitlines()[0]}", place=place
        ) from error
    if (order := list(model.names)[1:]) != wanted:
        raise BadInputError(
            place=place,
            key="order of joints",
            value=wanted,
            shown=", ".join(wanted),
            expected=", ".join(order),
        )
    for described, built in zip(robot.joints, list(model.joints)[1:], strict=True):
        kind, at = built.shortname(), f"{place}: joint {described.name!r}"
        Location(at).require(
            kind.startswith("JointModelP") == (described.type == "prismatic") and built.nq == 1,
            "type",
            kind,
            described.type,
        )
    return model


def _refuse_malformed_numbers(root: ET.Element, place: str) -> None:
    """Refuse malformed numbers, at which the parser would silently drop e.g. an inertial."""
    for owner, (path, keys, count) in product(root, _NUMBERS):
        needed = count == 1 and owner.find("inertial") is not None
        for part, key in product(owner.findall(path) or [ET.Element(path)] * needed, keys):
            Location(f"{place}: {owner.tag} {owner.get('name')!r}").require(
                re.fullmatch(_FINITE * count, " " + part.get(key, "" if needed else "0 0 0")),
                f"{path.replace('/', ' ')} {key}",
                part.get(key),
                "a finite number" if needed else "three finite numbers",
            )


def _make_buildable(joint: ET.Element, place: str) -> None:
    """Change a joint so that pinocchio can build it: with an axis and very wide limits."""
    axis = joint.find("axis") if joint.get("type") != "floating" else None
    # Exporters write a zero axis for floating joints, where it does not matter.
    Location(f"{place}: joint {joint.get('name')!r}").require(
        axis is None or any(float(x) for x in axis.get("xyz", "1").split()),
        "axis",
        "0 0 0",
        "a vector other than zero",
    )
    # Pinocchio uses two coordinates for a continuous joint.
    if joint.get("type") == "continuous":
        joint.set("type", "revolute")
    if joint.get("type") in ("revolute", "prismatic"):  # pinocchio needs limits
        ET.SubElement(
            joint, "limit", {"lower": "-1e9", "upper": "1e9", "effort": "1e9", "velocity": "1e9"}
        )
