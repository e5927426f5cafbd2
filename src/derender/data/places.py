"""Where things that can be made again are kept."""

import os
import sys
from pathlib import Path


def cache_folder() -> Path:
    """``$DERENDER_CACHE``, or derender's folder in the place this system has for caches."""
    if "DERENDER_CACHE" in os.environ:
        return Path(os.environ["DERENDER_CACHE"])
    if sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "derender"
