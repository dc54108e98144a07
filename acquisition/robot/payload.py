"""The payload of a recording: a weighed mass that the last link carries, and where its centre of mass is."""

import math
from dataclasses import dataclass

from ..errors import AcquisitionError
from .robot import Robot

MAX_DISTANCE_M = 5.0  # of the centre of mass: a larger number is in another unit


@dataclass(frozen=True)
class Payload:
    """A mass fixed to the last link. `str` is for people, `text` is what `parse_payload` reads.

    Attributes:
        mass_kg: None: unknown.
        center_of_mass_m: None: unknown.
        frame: fixed link of the URDF in which the centre of mass is given; None: frame of the last joint.
        mass_half_width_kg: half-width of the mass's 95 % interval.

    Raises `AcquisitionError` with `key` and `value` for a mass, a centre of mass or a half-width that no payload has.
    """

    mass_kg: float | None
    center_of_mass_m: tuple[float, float, float] | None = None
    frame: str | None = None
    mass_half_width_kg: float = 0.0

    def __post_init__(self) -> None:
        mass, center, width = self.mass_kg, self.center_of_mass_m, self.mass_half_width_kg
        if mass is not None and not 0 < mass < math.inf:
            raise AcquisitionError(key="payload.mass_kg", value=mass, expected="more than 0, and finite")
        if center is not None and not math.hypot(*center) <= MAX_DISTANCE_M:
            expected = f"three numbers in m, within {MAX_DISTANCE_M:g} m"
            raise AcquisitionError(key="payload.center_of_mass_m", value=list(center), expected=expected)
        if not 0 <= width < math.inf:
            raise AcquisitionError(key="payload.mass_half_width_kg", value=width, expected="0 or more, and finite")

    @property
    def text(self) -> str:
        """The numbers as of `--payload`: `2.805@0.03,0.15,-0.16`."""
        center = "" if self.center_of_mass_m is None else "@" + ",".join(map(repr, self.center_of_mass_m))
        return f"{'unknown' if self.mass_kg is None else repr(self.mass_kg)}{center}"

    def describe(self, last_joint: str = "the last joint") -> str:
        """For people: `2.805 kg at 0.03, 0.15, -0.16 m in tool0`."""
        width = f" ± {self.mass_half_width_kg:g}" if self.mass_half_width_kg else ""
        mass = "unknown mass" if self.mass_kg is None else f"{self.mass_kg:g}{width} kg"
        if self.center_of_mass_m is None:
            return f"{mass}, centre of mass not stated"
        center = ", ".join(f"{x:g}" for x in self.center_of_mass_m)
        return f"{mass} at {center} m in {self.frame or f'the frame of {last_joint}'}"

    def __str__(self) -> str:
        return self.describe()


def parse_payload(text: str, robot: Robot, key: str = "--payload") -> Payload:
    """The payload of `KG` or `KG@X,Y,Z` (m), with the frame and the half-width of the robot's `[payload]`.

    Raises `AcquisitionError` with `key`, the text as `value`, and `expected`.
    """
    mass, at, center = text.partition("@")
    try:
        numbers = tuple(float(x) for x in center.split(",")) if at else None
        if numbers is not None and len(numbers) != 3:
            raise ValueError("three numbers are a centre of mass")
        table = robot.payload
        return Payload(float(mass), numbers, table.frame, table.mass_half_width_kg)
    except (ValueError, AcquisitionError) as error:
        expected = f"KG or KG@X,Y,Z: a mass above 0 in kg, and a centre of mass in m within {MAX_DISTANCE_M:g} m"
        raise AcquisitionError(key=key, value=text, expected=expected) from error
