"""Picture to factors: encoders, decoders, the declared rows, and the confidence net."""

from derender.networks.factors import FACTORS, Factor, FactorNet
from derender.networks.settings import NetworkSettings

__all__ = ["FACTORS", "Factor", "FactorNet", "NetworkSettings"]
