"""Versions of installed packages."""


def version_of(package: str, missing: str) -> str:
    """Return the version of a package; `missing` if it is not installed."""
    # This module is slow to import, and seldom needed.
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return missing
