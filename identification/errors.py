"""Errors of the package."""

import re

from acquisition.errors import RobotIdimError

_KEYWORDS = {"range": "position", "period": "period_s", "workers": "Work(N)", "allow-untrusted": "allow_untrusted=True"}


class IdentificationError(RobotIdimError):
    """Bad input or an impossible fit; data as of `AcquisitionError`: `place, key, value, expected`.

    As a string it has keyword arguments in place of options, but for commands in backticks; `args[0]` is for the command line.
    """

    def __str__(self) -> str:
        parts = self.args[0].split("`")
        for k, part in list(enumerate(parts))[::2]:
            parts[k] = re.sub("--([a-z][a-z-]*)", lambda x: _KEYWORDS.get(x[1], x[1].replace("-", "_")), part)
        return "`".join(parts)


class DoNotUseWarning(UserWarning):
    """A fit with the verdict `do not use`; its text has the tests that say so."""
