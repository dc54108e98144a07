"""Errors of the package."""

from acquisition.errors import RobotIdimError


class IdentificationError(RobotIdimError):
    """Bad input, or a fit that cannot be made; its data are those of `AcquisitionError`: `place, key, value, expected`."""
