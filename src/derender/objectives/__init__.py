"""What the networks are trained for: explain the image (reconstruction, perceptual), keep factors apart."""

from derender.objectives.loocc import loocc_loss, nt_xent
from derender.objectives.perceptual import PerceptualFeatures, Vgg16Features, load_vgg16, perceptual_loss
from derender.objectives.reconstruction import depth_smoothness, masked_l1, photometric_loss
from derender.objectives.self_features import SelfFeatures, load_self_features, train_self_features

__all__ = [
    "PerceptualFeatures", "SelfFeatures", "Vgg16Features", "depth_smoothness", "load_self_features",
    "load_vgg16", "loocc_loss", "masked_l1", "nt_xent", "perceptual_loss", "photometric_loss",
    "train_self_features",
]  # fmt: skip
