"""Errors and warnings of the package: those of both, and one of its own."""

from acquisition.errors import BadInputError, NoFitError, RobotIdimError


class DoNotUseWarning(UserWarning):
    """A fit with the verdict `do not use`; its text has the tests that say so."""
