"""Tables of robot.toml that only a fit and a simulation read, and friction terms.

The tables are controller, identification, payload and capsules. Each friction term is a function of
speed.

To add a term, add its name to `FrictionTerm` and its row to `FRICTION`: descriptions, models,
intervals, charts and exports take it from there. Viscous friction and offsets act through matrices
and have no row.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
import numpy as np

from ..arrays import Array
from .toml import Name, Positive, TomlTable, note

Rows = Annotated[int, msgspec.Meta(ge=0)]
RowStep = Annotated[int, msgspec.Meta(ge=1)]
Share = Annotated[float, msgspec.Meta(ge=0, lt=100)]
Lag = Annotated[float, msgspec.Meta(gt=-1, lt=1)]
Edges = Literal["smooth", "matlab"]
GAINS = ("position_gain", "velocity_gain", "integral_gain")
Gains = tuple[float, ...] | None


class Capsule(TomlTable, frozen=True):
    """A cylinder with round ends around a link.

    It has a radius, and the ends of its axis in the frame of the link.
    """

    radius_m: Annotated[Positive, note("radius, m")]
    from_m: Annotated[
        tuple[float, float, float], note("one end of its axis in the frame of the link, x, y, z, m")
    ]
    to_m: Annotated[tuple[float, float, float], note("other end of its axis, x, y, z, m")]


class Controller(TomlTable, frozen=True):
    """Table `[controller]`: how the drives follow their reference.

    Least squares needs only `bandwidth_hz`.
    """

    bandwidth_hz: Annotated[
        Positive | None,
        note(
            "bandwidth of the position loop, Hz; sets cut-off and decimation (default: "
            "from the motion)"
        ),
    ] = None
    structure: Annotated[
        Literal[
            "pd", "pd_velocity_feedforward", "cascade_p_p", "cascade_p_pi", "pid", "computed_torque"
        ]
        | None,
        note("control law (default: a PD controller with this bandwidth)"),
    ] = None
    sample_rate_hz: Annotated[Positive | None, note("rate of the control law, Hz")] = None
    position_gain: Annotated[
        Gains, note("gains per motor, effort per rad or m (computed_torque: 1/s²)")
    ] = None
    velocity_gain: Annotated[
        Gains, note("gains per motor, effort per rad/s or m/s (computed_torque: 1/s)")
    ] = None
    integral_gain: Annotated[
        Gains, note("gains per motor, effort per rad s or m s; only with an integral")
    ] = None
    velocity_estimate: Annotated[
        Literal["exact", "backward_difference", "two_sample_mean"] | None,
        note("how speeds are computed from positions (default: backward_difference)"),
    ] = None
    gravity_feedforward: Annotated[
        bool, note("whether the control law adds gravity at the measured position")
    ] = False

    def __post_init__(self) -> None:
        self.require_all(
            (
                not self.gravity_feedforward or self.structure not in (None, "computed_torque"),
                "gravity_feedforward",
                True,
                ("it needs a control law without gravity", "Change controller.structure"),
            ),
            *(
                (all(g > 0 for g in gains or ()), name, gains and list(gains), "positive numbers")
                for name, gains in self.gains.items()
            ),
        )

    @property
    def gains(self) -> dict[str, Gains]:
        """Controller gains by name; None where one is not given."""
        return {name: getattr(self, name) for name in GAINS}


class LowSpeed(TomlTable, frozen=True):
    """Percentage of the peak speed below which samples have zero weight.

    There is one for least squares and one for iv. It is None for the default.
    """

    ls: Annotated[
        Share | None, note("threshold of least squares, % of the joint's peak speed (default: 4)")
    ] = None
    iv: Annotated[
        Share | None,
        note("threshold of instrumental variables, % of the joint's peak speed (default: 4)"),
    ] = None


class Identification(TomlTable, frozen=True):
    """Table `[identification]`: settings that replace the defaults of a fit.

    Options of the command replace both.
    """

    cutoff_hz: Annotated[
        Positive | None, note("cut-off of the low-pass filter, Hz (default: 5 times the bandwidth)")
    ] = None
    decimation: Annotated[
        RowStep | None, note("samples per row of the fit (default: from the bandwidth)")
    ] = None
    span: Annotated[
        Literal["motion", "all"], note("rows from the first to the last motion, or all rows")
    ] = "motion"
    cut_start_samples: Annotated[
        Rows | None, note("samples removed at the start (default: 5 periods of the cut-off)")
    ] = None
    cut_end_samples: Annotated[
        Rows | None, note("samples removed at the end (default: 5 periods of the cut-off)")
    ] = None
    edges: Annotated[Edges, note('how decimation treats the ends; "matlab": as MATLAB does')] = (
        "smooth"
    )
    low_speed_percent: Annotated[
        Share | LowSpeed | None,
        note(
            "slower samples have zero weight, % of the joint's peak speed; one number, "
            "or one per method (default: 4)"
        ),
    ] = None
    torque_lag_s: Annotated[
        Lag | Literal["none"] | None,
        note(
            'known delay of the recorded torque, s, positive if late; "none": no delay '
            "(default: estimated)"
        ),
    ] = None
    tolerance_percent: Annotated[
        Positive, note("iv has converged if no value changes by more, % of the value")
    ] = 2.5
    max_iterations: Annotated[RowStep, note("maximum number of iterations of iv")] = 10
    own: Annotated[
        tuple[Literal["Off", "Fv", "Fc"], ...] | None,
        note(
            "kinds of per-recording parameters (default: Fv and Fc if drive gains are "
            "identified, else none)"
        ),
    ] = None

    @property
    def low_speed(self) -> LowSpeed:
        """`low_speed_percent` by method."""
        return low_speed_by_method(self.low_speed_percent)


def low_speed_by_method(percent: float | LowSpeed | None) -> LowSpeed:
    """Return a low-speed threshold by method, from one number for both or one for each."""
    return percent if isinstance(percent, LowSpeed) else LowSpeed(ls=percent, iv=percent)


class PayloadFile(TomlTable, frozen=True):
    """`[payload]`: frame of the centre of mass in `--payload`, and the accuracy of its numbers."""

    frame: Annotated[
        Name | None,
        note(
            "link of the URDF in whose frame the centre of mass is given (default: frame "
            "of the last joint)"
        ),
    ] = None
    mass_half_width_kg: Annotated[float, note("95 % half-width of the weighed mass, kg", ge=0)] = (
        0.0
    )
    center_half_width_m: Annotated[
        float, note("95 % half-width of each coordinate of the centre of mass, m", ge=0)
    ] = 0.005


FrictionTerm = Literal["viscous", "coulomb", "offset", "asymmetric", "root", "load", "stribeck"]


@dataclass(frozen=True, kw_only=True)
class Friction:
    """A friction term as a function of the speed u along a direction of joints or of a motor.

    Attributes:
        name: name of its parameter.
        motor_name: name for a motor that moves several joints; "" if such a motor does not have
            this term.
        unit: unit of the parameter, made of {effort} and {length}.
        size: value per unit of the parameter, a function of |u|, the specified speed and the size
            of the links' torque; None for 1 at any speed, as in Coulomb friction.
        slope: derivative of `size` by |u|, a function of |u| and the specified speed.
        has_sign: whether the term is sign(u) size, which jumps or is steep at 0. False for a
            function of |u| alone, which a simulated robot implements as viscous friction that
            depends on the direction.
        is_steep: whether the slope is infinite at 0.
    """

    name: str
    motor_name: str = ""
    unit: str = "{effort}"
    size: Callable[[Array, float | Array, float | Array], Array] | None = None
    slope: Callable[[Array, float | Array], Array] = lambda u, u_s: 0.0 * u
    has_sign: bool = True
    is_steep: bool = False


FRICTION: dict[str, Friction] = {
    "coulomb": Friction(name="Fc", motor_name="Fcm"),
    "asymmetric": Friction(
        name="Fa",
        unit="{effort} s/{length}",
        size=lambda u, u_s, load: u,
        slope=lambda u, u_s: np.ones_like(u),
        has_sign=False,
    ),
    "root": Friction(
        name="Fr",
        motor_name="Frm",
        unit="{effort} (s/{length})^½",
        size=lambda u, u_s, load: np.sqrt(u),
        slope=lambda u, u_s: 0.5 / np.sqrt(u),
        is_steep=True,
    ),
    "stribeck": Friction(
        name="Fs",
        motor_name="Fsm",
        size=lambda u, u_s, load: np.exp(-((u / u_s) ** 2)),
        slope=lambda u, u_s: -2 * u / u_s**2 * np.exp(-((u / u_s) ** 2)),
    ),
    "load": Friction(name="mu", unit="", size=lambda u, u_s, load: load + 0.0 * u),
}
