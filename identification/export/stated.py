"""What options say of a robot where its URDF does not: one value for all joints, or one for each."""

from dataclasses import dataclass, replace
from typing import Any

from ..errors import IdentificationError
from .chain import Chain, UrdfJoint

OPTIONS = {
    "position": "--range",
    "speed": "--speed",
    "acceleration": "--acceleration",
    "following_error": "--following-error",
    "bandwidth_hz": "--bandwidth-hz",
}
_NEEDED = {
    "position": "{}, to each side of zero",
    "speed": "{}/s",
    "acceleration": "{}/s²",
}  # by a reference, with units


@dataclass(frozen=True, kw_only=True)
class Stated:
    """Values in rad or m (per s, s²), empty where an option was not given.

    `range` is to each side of zero. Where the URDF has a range or speed too, the smaller holds. A description has one
    bandwidth: of several the lowest holds.
    """

    range: tuple[float, ...] = ()
    speed: tuple[float, ...] = ()
    acceleration: tuple[float, ...] = ()
    following_error: tuple[float, ...] = ()
    bandwidth_hz: tuple[float, ...] = ()

    def of(self, chain: Chain) -> Chain:
        """The chain with these values; raises `IdentificationError` for a wrong number of values."""
        spread = {key: _spread(getattr(self, _field(option)), chain, option) for key, option in OPTIONS.items()}
        bandwidths = spread.pop("bandwidth_hz")
        joints = []
        for j, joint in enumerate(chain.joints):
            added: dict[str, Any] = {key: values[j] for key, values in spread.items() if values}
            if "position" in added:
                added["position"] = _narrowed(joint, added["position"], chain.place)
            if "speed" in added and joint.speed is not None:
                added["speed"] = min(joint.speed, added["speed"])
            joints.append(replace(joint, **added))
        return replace(chain, joints=tuple(joints), bandwidth_hz=min(bandwidths, default=None))


def refuse_unstated(chain: Chain) -> None:
    """Refuse a robot that is to move where neither the URDF nor an option states a limit or the bandwidth."""
    for key, unit in _NEEDED.items():
        for joint in chain.joints:
            if getattr(joint, key) is None:
                where = f"{chain.place}: joint {joint.name!r}"
                expected = f"{OPTIONS[key]} ({unit.format(joint.unit)}), one value or one per joint"
                raise IdentificationError(place=where, key=key, value=None, expected=expected)
    if chain.bandwidth_hz is None:
        expected = f"{OPTIONS['bandwidth_hz']}, of the position loops"
        place = f"{chain.place}: joint {chain.joints[0].name!r} and all others"
        raise IdentificationError(place=place, key="bandwidth", value=None, expected=expected)


def _field(option: str) -> str:
    return option.removeprefix("--").replace("-", "_")


def _spread(values: tuple[float, ...], chain: Chain, option: str) -> tuple[float, ...]:
    """One value for each joint of the chain; empty where there are none."""
    n, kinds = len(chain.joints), {joint.type for joint in chain.joints}
    if len(values) not in (0, 1, n):
        names = ", ".join(joint.name for joint in chain.joints)
        raise IdentificationError(
            place=chain.place,
            key=option,
            value=values,
            shown=f"{len(values)} values",
            expected=f"one, or {n}: of {names}",
        )
    if len(values) == 1 and n > 1 and len(kinds) > 1 and option != OPTIONS["bandwidth_hz"]:
        expected = f"{n} values: some joints count in rad, others in m"
        raise IdentificationError(place=chain.place, key=option, value=values[0], expected=expected)
    return values * n if len(values) == 1 else values


def _narrowed(joint: UrdfJoint, side: float, place: str) -> tuple[float, float]:
    low, high = joint.position or (-side, side)
    narrowed = max(low, -side), min(high, side)
    if not narrowed[0] < narrowed[1]:
        expected = f"a range that reaches into the URDF's, {low:g} to {high:g} {joint.unit}"
        raise IdentificationError(place=f"{place}: joint {joint.name!r}", key="--range", value=side, expected=expected)
    return narrowed
