"""Errors and warnings of the package: those of both, and one of its own."""

from acquisition.errors import BadInputError as BadInputError
from acquisition.errors import NoFitError as NoFitError
from acquisition.errors import RobotIdimError as RobotIdimError


class DoNotUseWarning(UserWarning):
    """A fit with the verdict `do not use`; its text has the tests that say so."""
