"""Errors of the package."""

from acquisition.errors import one_line


class IdentificationError(Exception):
    """Bad input or a fit that cannot be made, told in one line."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))
