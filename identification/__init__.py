"""Identifies the base dynamic parameters of a robot from a recording.

The map, in the order in which the data passes::

    recording.mcap ──signals──> Signals ──filtering──> Motion ──regression──> Regression ──estimators──> Estimate
                                                          │
                                     dynamics, base_parameters

``idim`` is the method on one screen, ``report`` prints and stores what it finds, ``viewer`` draws it.
"""

from acquisition import one_line


class IdentificationError(Exception):
    """Bad input or a fit that cannot be made, told in one line."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))
