"""The payload of a recording: a weighed mass that the last link carries, and its centre of mass."""

from dataclasses import dataclass
from typing import Annotated

import msgspec

from ..errors import BadInputError
from .robot import Robot

Mass = Annotated[float, msgspec.Meta(gt=0, le=1e6)]
# A larger number is in another unit.
Metres = Annotated[float, msgspec.Meta(ge=-5, le=5)]
HalfWidth = Annotated[float, msgspec.Meta(ge=0, le=1e6)]
# A centre of mass from a drawing or measured by hand is known to about this.
CENTER_HALF_WIDTH_M = 0.005


@dataclass(frozen=True)
class Payload:
    """A mass fixed to the last link. Its ranges are checked where it is parsed or read.

    Attributes:
        mass_kg: mass in kg; None if unknown.
        center_of_mass_m: coordinates of the centre of mass in m; None if unknown.
        frame: fixed link of the URDF in which the centre of mass is given; None for the frame of
            the last joint.
        mass_half_width_kg: 95 % half-width of the mass in kg.
        center_half_width_m: 95 % half-width of each coordinate of the centre of mass in m; 0 if
            exact.
    """

    mass_kg: Mass | None
    center_of_mass_m: tuple[Metres, Metres, Metres] | None = None
    frame: str | None = None
    mass_half_width_kg: HalfWidth = 0.0
    center_half_width_m: HalfWidth = CENTER_HALF_WIDTH_M

    @property
    def text(self) -> str:
        """Text of the payload as in options, or `unknown`.

        An example is `2.805@0.03,0.15,-0.16`, with `+-0.001` if that is not the default.
        """
        center, mass = ",".join(map(repr, self.center_of_mass_m or ())), self.mass_kg or "unknown"
        width = (
            f"+-{self.center_half_width_m!r}"
            if self.center_half_width_m != CENTER_HALF_WIDTH_M
            else ""
        )
        return f"{mass}@{center}{width}" if center else f"{mass}"

    def describe(self, last_joint: str = "the last joint") -> str:
        """Describe the payload for people: `2.805 kg at 0.03, 0.15, -0.16 ± 0.005 m in tool0`."""
        width = f" ± {self.mass_half_width_kg:g}" if self.mass_half_width_kg else ""
        mass = "unknown mass" if self.mass_kg is None else f"{self.mass_kg:g}{width} kg"
        if self.center_of_mass_m is None:
            return f"{mass}, centre of mass not given"
        center = (
            ", ".join(f"{x:g}" for x in self.center_of_mass_m) + f" ± {self.center_half_width_m:g}"
        )
        return f"{mass} at {center} m in {self.frame or f'the frame of {last_joint}'}"

    __str__ = describe


def parse_payload(text: str, robot: Robot, key: str = "payload") -> Payload:
    """Parse a payload, with the frame and half-widths of the robot's `[payload]`.

    Parameters
    ----------
    text : `KG`, `KG@X,Y,Z` or `KG@X,Y,Z+-HALF`, in kg and m.
    robot : the robot that carries it.
    key : argument that gives it, for errors.

    Raises
    ------
    BadInputError : the text is not a payload, or a number is outside its range.
    """
    mass, at, center = text.partition("@")
    center, within, half_width = center.partition("+-")
    try:
        given = {
            "mass_kg": float(mass),
            "center_of_mass_m": [float(x) for x in center.split(",")] if at else None,
            **({"center_half_width_m": float(half_width)} if within else {}),
        }
        return msgspec.convert(msgspec.structs.asdict(robot.payload) | given, Payload)
    # The errors of msgspec are ValueErrors, too.
    except ValueError as error:
        raise BadInputError(
            key=key,
            value=text,
            expected="KG or KG@X,Y,Z[+-HALF]: a mass in kg greater than 0, a centre of mass in m "
            "(-5 to 5), and its half-width in m",
        ) from error
