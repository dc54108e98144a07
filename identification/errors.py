"""Errors of the package."""

from acquisition.errors import RobotIdimError


class IdentificationError(RobotIdimError):
    """Bad input or an impossible fit; data as of `AcquisitionError`: `place, key, value, expected`."""
