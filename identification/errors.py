"""Errors of the package."""

from acquisition.errors import RobotIdimError


class IdentificationError(RobotIdimError):
    """Bad input or an impossible fit; data as of `AcquisitionError`: `place, key, value, expected`."""


class DoNotUseWarning(UserWarning):
    """A fit with the verdict `do not use`; its text has the tests that say so."""
