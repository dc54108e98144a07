"""Errors and warnings of the package: those of both, and one of its own."""

from acquisition.errors import BadInputError, NoFitError, RobotIdimError


class DoNotUseWarning(UserWarning):
    """A fit has the verdict `do not use`; the text lists the tests that found a problem."""
