"""The parameters in the JSON file of a fit: base and standard parameters, drive gains, payloads.

Their names are built and read here alone:

    Fv1          a base parameter, common to all recordings
    Fv1@A        that of the recording A alone, a per-recording parameter
    MX:loaded    of the payload on the recording `loaded`; MXR:loaded with others regrouped into it
    K:motor_1    the gain of a drive, as a factor on the described one
    mu1          a base parameter of load-dependent friction

Names of recordings and motors may have either sign in them: the first one in a name counts.
"""

import math
import re
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Annotated

import msgspec
from msgspec import UNSET, UnsetType

AboveZero = Annotated[float, msgspec.Meta(gt=0)]
PER_INTERVAL = 1.96  # deviations in half a 95 % interval

_Question = Callable[[str], re.Match[str] | None]

# A base parameter belongs to the robot, not to a payload or a drive gain.
is_base: _Question = re.compile(r"[^:@]*(@|$)").match
# A per-recording parameter carries the name of its recording.
is_own: _Question = re.compile(r"[^:@]*@").match
is_gain: _Question = re.compile(r"K:").match
is_load: _Question = re.compile(r"mu").match
# Without its recording, Off1@A becomes Off1.
base_name: Callable[[str], str] = partial(re.compile(r"\A([^:@]*)@.*", re.DOTALL).sub, r"\1")


def own_name(base: str, recording: str) -> str:
    """Name a base parameter of one recording alone."""
    return f"{base}@{recording}"


def payload_name(parameter: str, recording: str) -> str:
    """Name a parameter of the payload on a recording."""
    return f"{parameter}:{recording}"


def gain_name(motor: str) -> str:
    """Name the gain of a motor's drive."""
    return f"K:{motor}"


def motor_of(gain: str) -> str:
    """Return the motor whose drive gain has this name."""
    return gain.partition(":")[2]


def recording_of(name: str) -> str:
    """Return the recording of a per-recording base parameter; empty for a common one."""
    return name.partition("@")[2] if is_own(name) else ""


def payload_parameter(name: str) -> str:
    """Return the parameter without the recording of its payload: MX of MX:loaded."""
    return name.partition(":")[0]


MEANINGS = {
    "M": "mass",
    **{f"M{axis}": f"first moment {axis.lower()}" for axis in "XYZ"},
    **{f"{axis}{axis}": f"moment of inertia {axis.lower()}{axis.lower()}" for axis in "XYZ"},
    **{axes: f"product of inertia {axes.lower()}" for axes in ("XY", "XZ", "YZ")},
    "Ia": "rotor inertia",
    "Fv": "viscous friction",
    "Fvp": "viscous friction forwards",
    "Fvn": "viscous friction backwards",
    "Fvm": "viscous friction",
    "Fc": "Coulomb friction",
    "Fcp": "Coulomb friction forwards",
    "Fcn": "Coulomb friction backwards",
    "Fcm": "Coulomb friction",
    "Fa": "asymmetric friction",
    "Fr": "square-root friction",
    "Frm": "square-root friction",
    "Fs": "Stribeck friction",
    "Fsm": "Stribeck friction",
    "mu": "load-dependent friction",
    "Off": "offset",
}
OF_LINKS = tuple(MEANINGS)[:10]
# kind, R if regrouped, number of the joint, R, and recording
_parts: _Question = re.compile(r"([A-Za-z]+?)(R?)(\d*)(R?)(?:[:@](.*)|$)", re.DOTALL).match


def meaning_of(name: str, joints: Sequence[str]) -> str:
    """Return a parameter in words: `first moment x of link 2 (regrouped)`.

    `joints` are the names of the joints, in order; a joint without a name has its number. A gain or
    an unknown name gives an empty text.
    """
    found = _parts(name)
    kind, before, number, after, where = found.groups() if found else ("", "", "", "", None)
    if kind not in MEANINGS:
        return ""
    place = (
        "payload"
        if not number
        else f"link {number}"
        if kind in OF_LINKS
        else f"motor {number}"
        if kind.endswith("m")
        else joints[int(number) - 1]
        if int(number) <= len(joints)
        else f"joint {number}"
    )
    ending = (f" in {where}" if where else "") + (" (regrouped)" if before or after else "")
    return f"{MEANINGS[kind]} of {place}{ending}"


def by_joint(names: Iterable[str], joints: Sequence[str]) -> str:
    """Return parameters by joint in words: `joint_1: offset; joint_2: 2 inertias, offset`.

    `joints` are the names of the joints, in order. Names without a joint or a meaning are ignored.
    """
    found = [
        # without the axes of `moment of inertia xx`, `first moment x`
        (int(parts[3]) - 1, re.sub(r"(moment|product) of | [x-z]+$", "", MEANINGS[parts[1]]))
        for parts in map(_parts, names)
        if parts and parts[3] and parts[1] in MEANINGS
    ]
    return "; ".join(
        f"{joint}: "
        + ", ".join(f"{words.count(x)} {x}s" if words.count(x) > 1 else x for x in unique)
        for j, joint in enumerate(joints)
        for words in [[word for k, word in found if k == j]]
        for unique in [dict.fromkeys(words)]
        if words
    )


class Parameter(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter with its 95 % interval and its classical standard error `sigma`.

    `sigma` is 0 for an exact value. `low`, `high` and `expression`, its sum of standard parameters,
    are None in a file of an earlier version. `prior` is its a priori value.
    """

    name: str
    value: float
    low: float | None = None
    high: float | None = None
    unit: str
    expression: str | None = None
    sigma: float = 0.0
    sigma_hac: float | UnsetType | None = UNSET  # of a file of an earlier version
    sigma_percent: float | UnsetType | None = UNSET
    essential: bool = False
    prior: float | UnsetType = UNSET
    column_norm: float | UnsetType = UNSET  # of its weighted column: torque per unit
    meaning: str | UnsetType = UNSET  # in words; a file does not have it

    def __repr__(self) -> str:
        return (
            f"Parameter({self.name} = {self.value:.5g} ± {self.half_width:.2g} {self.unit}, "
            f"{self.meaning or self.expression})"
        )

    @property
    def half_width(self) -> float:
        """Half the 95 % interval; without one, 1.96 times the larger standard error."""
        return (
            PER_INTERVAL * max(self.sigma, self.sigma_hac or 0.0)
            if self.low is None or self.high is None
            else 0.5 * (self.high - self.low)
        )

    half = half_width  # its earlier name

    @property
    def half_percent(self) -> float:
        """Half the interval in percent of the value; infinite for a value of zero."""
        return 100 * self.half / abs(self.value) if self.value else math.inf

    @property
    def torque(self) -> float:
        """The torque that the parameter causes in the weighted rows of the fit.

        It is 0 if its column in these rows is not known.
        """
        return abs(self.value) * (self.column_norm or 0.0)

    @property
    def spread(self) -> float:
        """The standard error by the interval: its half-width / 1.96."""
        return self.half / PER_INTERVAL


class PhysicalWarning(msgspec.Struct, frozen=True):
    """A physically impossible value of a fit, in files of every version.

    It is `severe` if it is significant.
    """

    text: str
    severe: bool


class Covariance(msgspec.Struct, frozen=True, kw_only=True):
    """The covariance (b, b) of the parameters `names`.

    The standard errors are those of the intervals, the correlations those of the formula.
    """

    names: list[str]
    values: list[list[float]]


class LeftOut(msgspec.Struct, frozen=True, kw_only=True):
    """A base parameter that `--essential` leaves out.

    Its standard error is that of least squares with all parameters.
    """

    name: str
    sigma: float


class StandardParameter(msgspec.Struct, frozen=True):
    """A parameter of the physically consistent set.

    `from_prior`: it comes mostly from the prior. `move`: its change in half-widths of the fit.
    """

    name: str
    value: float
    unit: str
    from_prior: bool
    half_width: float | UnsetType = UNSET
    move: float | UnsetType = UNSET


class ConsistentFile(msgspec.Struct, frozen=True, kw_only=True):
    """The physically consistent set of parameters.

    The record also has the prior, the distance from the estimate (chi², largest change in
    half-widths), the torque error, and the Newton decrement. Files of earlier versions may have
    another weight of the prior.
    """

    prior: str
    prior_weight: AboveZero = 1.0
    chi2: float
    largest_move: float
    moved_most: str
    certificate: float
    relative_error_percent: float | None = None
    base_parameters: list[StandardParameter] | UnsetType = UNSET


class DriveGain(msgspec.Struct, frozen=True, kw_only=True):
    """An identified drive gain, such as N m/A, with the half-width of its 95 % interval.

    `described`: that of the description, null without one. `determined`: known to better than 10 %.
    """

    motor: str
    unit: str
    described: float | None
    value: float
    half_width: float
    determined: bool


class MotorLaw(msgspec.Struct, frozen=True, kw_only=True):
    """The control law u = Kp (r - q) + Kd (phi dr - dq) + Ki integral + offset of a motor.

    Half-widths are those of 95 % intervals, in recorded effort per motor rad (or m). `clear`: this
    motor alone determines the structure.
    """

    motor: str
    gains: dict[str, tuple[float | None, float | None]]
    delay_s: float | None
    delay_half_width_s: float | None
    residual_percent: float | None
    clear: bool


class LawFile(msgspec.Struct, frozen=True, kw_only=True):
    """The control law of the recording, as keys of `[controller]`.

    The keys are null if no control law is estimated, for the `reason`.
    """

    structure: str
    reason: str | None
    controller: dict[str, str | float | list[float]] | None
    motors: list[MotorLaw]


class PayloadOfFit(msgspec.Struct, frozen=True, kw_only=True):
    """A payload as given and as estimated.

    The record has the payload as given (`stated`), also in words, its nearest rigid body, and its
    share of the base parameters. `recording` is the first with it. `given` is what is known of it,
    `mass` and `center`; a mass has its half-width, null for an exact one.
    """

    recording: str
    stated: str
    parameters: list[StandardParameter]
    base_parameters: dict[str, float] | UnsetType = UNSET
    described: str = ""
    given: list[str] = msgspec.field(default_factory=list)
    mass_half_width_kg: float | None = None
