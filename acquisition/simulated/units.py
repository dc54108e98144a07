"""What a simulated drive without a dictionary states of itself: texts, modes, units and
limits of the description.
"""

from fractions import Fraction

import numpy as np

from ..protocol import MOTION_LIMITS, POSITION_UNITS, SUPPORTED_MODES, TEXTS, Mode, saturated
from ..robot import Bus


def units_and_limits(bus: Bus, i: int) -> dict[tuple[int, int], int]:
    """Raw texts, modes, position units and limits of motor `i`; 0 where the description states
    none, or the motor slides.
    """
    drive, per_turn = (
        bus.drives[i],
        Fraction(bus.file.drive[i].counts_per_turn or 0).limit_denominator(1000),
    )
    position, velocity, motor_speed = MOTION_LIMITS
    texts = zip(TEXTS, (b"sim", b"none", b"none"), strict=True)  # of four bytes: in one frame
    values = {
        (SUPPORTED_MODES, 0): 1 << Mode.CYCLIC_SYNCHRONOUS_POSITION - 1,
        **{(index, 0): int.from_bytes(text, "little") for index, text in texts},
    }
    speeds = {velocity: drive.motion.speed or 0.0}
    if per_turn:
        for index, units in zip(POSITION_UNITS, (per_turn, Fraction(1), per_turn), strict=True):
            values |= {(index, 1): units.numerator, (index, 2): units.denominator}
        speeds[motor_speed] = drive.motion.rpm or 0.0
    values |= {(index, 0): int(saturated(np.array(x), "U32")) for index, x in speeds.items()}
    if drive.motion.position is not None:
        low, high = saturated(np.array(drive.motion.position), "I32").tolist()
        values |= {(position, 1): low, (position, 2): high}
    return values
