"""`robot.toml` as written in the file: its tables and keys, and their checks.

The checks are those that types cannot express. The layout of the file is that of the structure
`RobotFile`. Angles are in degrees here.
"""

import math
from functools import cached_property
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from .bus import BusFile
from .fit_tables import Capsule, Controller, FrictionTerm, Identification, PayloadFile
from .toml import Name, Positive, TomlTable, note


class DH(TomlTable, frozen=True):
    """Modified Denavit-Hartenberg row (Khalil, Kleinfinger).

    The transformation is Rot(x, alpha) Trans(x, d) Rot(z, theta) Trans(z, r).
    """

    alpha_deg: Annotated[float, note("angle between the joint axes: Rot(x, alpha), deg")]
    d_m: Annotated[float, note("distance between the joint axes: Trans(x, d), m")]
    theta_deg: Annotated[
        float, note("angle about the joint axis at joint position 0: Rot(z, theta), deg")
    ]
    r_m: Annotated[float, note("offset along the joint axis at joint position 0: Trans(z, r), m")]


# The keys of a joint by its type and the quantity.
_KEYS = {
    "revolute": {
        "zero": "zero_deg",
        "position": "position_deg",
        "speed": "speed_deg_s",
        "acceleration": "acceleration_deg_s2",
        "following_error": "following_error_deg",
        "stribeck_speed": "stribeck_speed_deg_s",
        "effort": "effort_nm",
    },
    "prismatic": {
        "zero": "zero_m",
        "position": "position_m",
        "speed": "speed_m_s",
        "acceleration": "acceleration_m_s2",
        "following_error": "following_error_m",
        "stribeck_speed": "stribeck_speed_m_s",
        "effort": "effort_n",
    },
}


class Joint(TomlTable, frozen=True):
    """One `[[joint]]`: type, geometry, friction terms and limits; None if not given."""

    name: Annotated[Name, note("name; with a URDF, that of its joint")]
    type: Annotated[
        Literal["revolute", "prismatic"],
        note("motion about (revolute) or along (prismatic) its z axis"),
    ]
    dh: Annotated[DH | None, note("row of the Denavit-Hartenberg table; replaces a URDF")] = None
    zero_deg: Annotated[float | None, note("joint angle at motor zero, deg (default: 0)")] = None
    zero_m: Annotated[float | None, note("joint position at motor zero, m (default: 0)")] = None
    viscous: Annotated[bool | None, note("viscous friction (default: true)")] = None
    coulomb: Annotated[bool | None, note("Coulomb friction (default: true)")] = None
    offset: Annotated[bool | None, note("constant torque (default: false)")] = None
    friction: Annotated[
        Literal["symmetric", "asymmetric"] | tuple[FrictionTerm, ...],
        note("asymmetric: Fv and Fc depend on the direction; or a list of all terms"),
    ] = "symmetric"
    stribeck_speed_deg_s: Annotated[
        Positive | None,
        note("speed at which Stribeck friction has fallen to 37 %, deg/s; with that term only"),
    ] = None
    stribeck_speed_m_s: Annotated[
        Positive | None,
        note("speed at which Stribeck friction has fallen to 37 %, m/s; with that term only"),
    ] = None
    rotor_inertia: Annotated[bool, note("whether the rotor inertia is a separate parameter")] = True
    position_deg: Annotated[
        tuple[float, float] | None, note("lowest and highest position, deg; needed to move")
    ] = None
    position_m: Annotated[
        tuple[float, float] | None, note("lowest and highest position, m; needed to move")
    ] = None
    speed_deg_s: Annotated[Positive | None, note("maximum speed, deg/s; needed to move")] = None
    speed_m_s: Annotated[Positive | None, note("maximum speed, m/s; needed to move")] = None
    acceleration_deg_s2: Annotated[
        Positive | None, note("maximum acceleration, deg/s²; needed to move")
    ] = None
    acceleration_m_s2: Annotated[
        Positive | None, note("maximum acceleration, m/s²; needed to move")
    ] = None
    following_error_deg: Annotated[
        Positive | None, note("maximum following error, deg; needed to move")
    ] = None
    following_error_m: Annotated[
        Positive | None, note("maximum following error, m; needed to move")
    ] = None
    effort_nm: Annotated[
        Positive | None, note("maximum torque, N m (default: the URDF's, 0: no limit)")
    ] = None
    effort_n: Annotated[
        Positive | None, note("maximum force, N (default: the URDF's, 0: no limit)")
    ] = None
    capsule: Annotated[
        Capsule | None, note("cylinder with round ends around the moved link, for `excite`")
    ] = None

    def __post_init__(self) -> None:
        other, unit = ("prismatic", "deg") if self.type == "revolute" else ("revolute", "m")
        for quantity, key in _KEYS[other].items():
            value = getattr(self, key)
            replacement = self.key(quantity) if quantity == "effort" else f"a key in {unit}"
            self.require(
                value is None, key, value, (f"the joint is {self.type}", f"Use {replacement}")
            )
        limits = getattr(self, self.key("position"))
        self.require(
            limits is None or limits[0] < limits[1],
            self.key("position"),
            limits,
            "[lowest, highest]",
        )
        if isinstance(self.friction, tuple):
            given = {name: getattr(self, name) for name in ("viscous", "coulomb", "offset")}
            self.require_all(
                *(
                    (self.friction.count(term) <= 1, "friction", term, ("it is listed twice", ""))
                    for term in self.friction
                ),
                *(
                    (stated is None, name, stated, ("friction lists all terms", f"Remove {name}"))
                    for name, stated in given.items()
                ),
            )

    @cached_property
    def position_unit(self) -> str:
        """Unit of the position, `rad` or `m`."""
        return "rad" if self.type == "revolute" else "m"

    @cached_property
    def one_sided(self) -> bool:
        """True if viscous and Coulomb friction depend on the direction.

        The key is then `friction = "asymmetric"`.
        """
        return self.friction == "asymmetric"

    @cached_property
    def terms(self) -> tuple[FrictionTerm, ...]:
        """Friction terms, from the list `friction` or from single keys.

        The keys are `viscous`, `coulomb` and `offset`.
        """
        if isinstance(self.friction, tuple):
            return self.friction
        stated: tuple[tuple[FrictionTerm, bool | None], ...] = (
            ("viscous", self.viscous),
            ("coulomb", self.coulomb),
            ("offset", self.offset or False),
        )
        return tuple(term for term, has in stated if has is not False)

    def key(self, quantity: str) -> str:
        """Return the key of a quantity of `si` in the file, such as `speed_deg_s` or `effort_n`."""
        return _KEYS[self.type][quantity]

    def si(self, quantity: str) -> Any:
        """Return a quantity of the joint in SI; None if not given.

        It is in rad or m (per s, s²); `effort` is in N m or N.
        """
        value = getattr(self, self.key(quantity))
        if self.type == "prismatic" or quantity == "effort" or value is None:
            return value
        return tuple(map(math.radians, value)) if isinstance(value, tuple) else math.radians(value)


class Motor(TomlTable, frozen=True):
    """One `[[motor]]`: its gear ratio, the drive gain, and the unit of the recorded effort."""

    name: Annotated[Name, note("name in messages and options")]
    ratio: Annotated[
        float | None, note("motor motion per joint motion, both in rad or m, signed (default: 1)")
    ] = None
    effort_unit: Annotated[
        Literal["A", "V", "N m", "N", "%"] | None,
        note("unit of the recorded effort; required without a drive gain"),
    ] = None
    drive_gain: Annotated[
        float | None, note("motor torque or force per unit of recorded effort, in drive_gain_unit")
    ] = None
    drive_gain_unit: Annotated[
        Literal["N m/A", "N m/V", "N m/%", "N/A", "N/V", "N/%"] | None,
        note("unit of the drive gain; required with drive_gain"),
    ] = None
    drive_gain_half_width: Annotated[
        Positive | None, note("95 % half-width of the drive gain, in drive_gain_unit (default: 0)")
    ] = None
    saturation: Annotated[
        Positive | None, note("maximum effort of the drive, in the unit of the recorded effort")
    ] = None

    def __post_init__(self) -> None:
        self.require_all(
            (
                (self.drive_gain is None) == (self.drive_gain_unit is None),
                "drive_gain",
                self.drive_gain,
                ("only one of drive_gain and drive_gain_unit is given", "Give both, or neither"),
            ),
            (
                self.drive_gain is None or self.drive_gain > 0,
                "drive_gain",
                self.drive_gain,
                ("it is not greater than 0", "Put signs into ratio or motor_matrix"),
            ),
            (
                self.drive_gain_unit is not None or self.effort_unit is not None,
                "effort_unit",
                None,
                ("no drive gain gives the unit", "Set it to A, V, N m, N or %"),
            ),
            (
                self.drive_gain_unit is None or self.effort_unit in (None, self.recorded_unit),
                "effort_unit",
                self.effort_unit,
                (f"drive_gain_unit is {self.drive_gain_unit}", f"Set {self.recorded_unit!r}"),
            ),
        )

    @cached_property
    def recorded_unit(self) -> str:
        """Unit of the recorded effort.

        It is the denominator of the drive gain's unit, or `effort_unit`.
        """
        return self.drive_gain_unit.split("/")[1] if self.drive_gain_unit else str(self.effort_unit)

    @cached_property
    def gain(self) -> float | None:
        """Motor torque or force per unit of recorded effort; None if unknown.

        It is 1 if a torque or force is recorded.
        """
        is_torque = self.drive_gain_unit is None and self.effort_unit in ("N m", "N")
        return 1.0 if is_torque else self.drive_gain


class RobotFile(TomlTable, frozen=True):
    """`robot.toml` as written in the file."""

    name: Annotated[Name, note("name of the robot")]
    joint: Annotated[
        tuple[Joint, ...], note("[[joint]] tables, from the base outwards", min_length=1)
    ]
    motor: Annotated[
        tuple[Motor, ...], note("[[motor]] tables; motor k moves joint k", min_length=1)
    ]
    controller: Annotated[Controller, note("how the drives follow their reference")]
    gravity_m_s2: Annotated[tuple[float, float, float], note("gravity in the base frame, m/s²")] = (
        0.0,
        0.0,
        -9.81,
    )
    urdf: Annotated[
        str | None, note("URDF in the same folder; joints not named here are locked at 0")
    ] = None
    urdf_meshes: Annotated[
        bool, note("whether recordings contain the meshes of the URDF's visual shapes")
    ] = False
    motor_matrix: Annotated[
        tuple[tuple[float, ...], ...] | None,
        note("matrix R of motor speed = R · joint speed; replaces the ratios"),
    ] = None
    identification: Annotated[
        Identification, note("settings of a fit; they replace the defaults")
    ] = Identification()
    parameters: Annotated[dict[str, float], note("a priori standard parameters, by name, SI")] = (
        msgspec.field(default_factory=dict)
    )
    payload: Annotated[PayloadFile, note("frame and accuracy of the numbers of `--payload`")] = (
        PayloadFile()
    )
    bus: Annotated[BusFile | None, note("CAN bus and drives; required to record")] = None
    base_capsule: Annotated[
        Capsule | None, note("cylinder with round ends around the base, in the base frame")
    ] = None
    ground_m: Annotated[
        float | None, note("height of the ground in the base frame, against gravity, m")
    ] = None
    unconfirmed: Annotated[
        tuple[Name, ...],
        note("joints that a fit corrected; nothing moves until a person checks and deletes this"),
    ] = ()

    def __post_init__(self) -> None:
        n = len(self.joint)
        drives = n if self.bus is None else len(self.bus.drive)
        names = {"joint": [j.name for j in self.joint], "motor": [m.name for m in self.motor]}
        self.require_all(
            (len(self.motor) == n, "motor", f"{len(self.motor)} tables", f"{n}, one per joint"),
            (drives == n, "bus.drive", f"{drives} tables", f"{n}, one per motor"),
            (
                not self.urdf_meshes or self.urdf is not None,
                "urdf_meshes",
                True,
                ("robot.toml has no urdf", "Name a urdf with meshes, or remove the key"),
            ),
            (
                self.payload.frame is None or self.urdf is not None,
                "payload.frame",
                self.payload.frame,
                ("robot.toml has no urdf", "Name a urdf with this link, or remove the frame"),
            ),
            *(
                (name not in named[:i], f"{kind}[{i}].name", name, (f"another {kind} has it", ""))
                for kind, named in names.items()
                for i, name in enumerate(named)
            ),
            *((x in names["joint"], "unconfirmed", x, "names of joints") for x in self.unconfirmed),
        )
        for i, joint in enumerate(self.joint):
            # This is not checked in the joint: if its terms are chosen for a fit, the speed may
            # remain.
            key, speed = f"joint[{i}].{joint.key('stribeck_speed')}", joint.si("stribeck_speed")
            self.require_all(
                (
                    (joint.dh is None) != (self.urdf is None),
                    f"joint[{i}].dh",
                    joint.dh,
                    ("a urdf is given too" if joint.dh else "", "Give a dh row, or one urdf"),
                ),
                (
                    "stribeck" not in joint.terms or speed is not None,
                    key,
                    None,
                    ("", "Give the speed at which Stribeck friction has decreased to 37 %"),
                ),
                (
                    "stribeck" in joint.terms or speed is None,
                    key,
                    speed,
                    ('friction has no term "stribeck"', "Add the term, or remove the speed"),
                ),
            )
        self._check_motors(n)

    def _check_motors(self, n: int) -> None:
        unknown = [m.name for m in self.motor if m.gain is None]
        self.require_all(
            *(
                (
                    motor.ratio is None or (motor.ratio != 0 and self.motor_matrix is None),
                    f"motor[{i}].ratio",
                    motor.ratio,
                    ("it is 0, or given beside motor_matrix", "Give a ratio or motor_matrix"),
                )
                for i, motor in enumerate(self.motor)
            ),
            (
                not 0 < len(unknown) < n,
                "motor.drive_gain",
                None,
                (
                    f"{', '.join(unknown)} have none",
                    "Give a drive gain for all motors, or for none",
                ),
            ),
        )
        if self.motor_matrix is not None:
            self.require(
                [len(row) for row in self.motor_matrix] == [n] * n,
                "motor_matrix",
                [len(row) for row in self.motor_matrix],
                f"{n} rows of {n} numbers",
            )
            self.require_all(
                (
                    np.linalg.matrix_rank(np.array(self.motor_matrix)) >= n,
                    "motor_matrix",
                    self.motor_matrix,
                    "an invertible matrix",
                ),
                # Names such as Ia2 and gains belong to joints, so each joint needs its own motor.
                *(
                    (
                        row[i] != 0,
                        f"motor_matrix[{i}]",
                        list(row),
                        (f"motor {i + 1} does not move joint {i + 1}", "Order motors by joints"),
                    )
                    for i, row in enumerate(self.motor_matrix)
                ),
            )
        for name, gains in self.controller.gains.items():
            self.require(
                gains is None or len(gains) == n,
                f"controller.{name}",
                gains and list(gains),
                f"{n} numbers, one per motor",
            )
