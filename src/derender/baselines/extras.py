"""Packages that only some baselines need: imported when asked for, named with their extra when missing."""

import importlib
from types import ModuleType


def optional(package: str, needed_for: str) -> ModuleType:
    """The package, or an error that says how to get it.

    Raises:
        ValueError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ValueError(
            f"{needed_for} needs the package {package.split('.')[0]}, which is not here ({error}): "
            "pip install 'derender[baselines]'"
        ) from error
