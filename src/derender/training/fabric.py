"""Lightning Fabric, without torchmetrics, which it imports to read a version number.

Only its detection of spikes computes with torchmetrics, imports it then, and is not used here.

With torchmetrics come SciPy's signal processing and models of text: more than two of the six seconds of
processor time that importing Fabric takes on a small machine, in every process of a training.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from types import ModuleType


@contextmanager
def _known_by_version(package: str) -> Iterator[None]:
    """While this lasts, a package that nobody has imported is there with its version and nothing else."""
    if package in sys.modules:
        yield
        return
    stand_in = ModuleType(package)
    stand_in.__dict__["__version__"] = version(package)
    sys.modules[package] = stand_in
    try:
        yield
    finally:
        sys.modules.pop(package)


with _known_by_version("torchmetrics"):
    from lightning_fabric import Fabric
    from lightning_fabric.strategies.ddp import DDPStrategy

__all__ = ["DDPStrategy", "Fabric"]
