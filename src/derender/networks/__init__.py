"""Image to factors: encoders, decoders, the declared rows, and the confidence net."""

from derender.networks.encoders import NetworkSettings
from derender.networks.factors import FACTORS, Factor, FactorNet

__all__ = ["FACTORS", "Factor", "FactorNet", "NetworkSettings"]
