"""Encoder activations to features: whitening, and coordinates of scenes fitted per image at test time."""

from derender.postprocess.embedding import Features

__all__ = ["Features"]
