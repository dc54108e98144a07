"""Identifies the base dynamic parameters of a robot from a recording.

The map, in the order in which the data passes::

    recording.mcap ──signals──> Signals ──filtering──> Motion ──regression──> Regression ──estimators──> Estimate
                                                          │
                                     dynamics, base_parameters

``idim`` is the method on one screen, ``fit`` what it gives, ``judgement`` what speaks for and against it. For instrumental
variables ``instruments`` lays out the experiment and ``simulation`` is the robot in closed loop. ``report`` makes tables and
lines, ``printing`` prints them, ``fit_file`` stores, ``viewer`` draws; ``synthetic``, ``plant``, ``demo`` and ``study`` work
on robots whose parameters are known.
"""

from acquisition import one_line


class IdentificationError(Exception):
    """Bad input or a fit that cannot be made, told in one line."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))
