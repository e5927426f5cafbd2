"""What the networks are trained for: explain the picture (reconstruction, perceptual), keep factors apart."""

from derender.objectives.frozen import PerceptualFeatures
from derender.objectives.loocc import loocc_loss, nt_xent
from derender.objectives.perceptual import PERCEPTUAL_KINDS, PerceptualKind, build_perceptual, perceptual_loss
from derender.objectives.reconstruction import depth_smoothness, masked_l1, photometric_loss
from derender.objectives.self_features import SelfFeatures, load_self_features
from derender.objectives.self_training import SelfTraining, train_self_features
from derender.objectives.vgg import Vgg16Features, load_vgg16

__all__ = [
    "PERCEPTUAL_KINDS",
    "PerceptualFeatures",
    "PerceptualKind",
    "SelfFeatures",
    "SelfTraining",
    "Vgg16Features",
    "build_perceptual",
    "depth_smoothness",
    "load_self_features",
    "load_vgg16",
    "loocc_loss",
    "masked_l1",
    "nt_xent",
    "perceptual_loss",
    "photometric_loss",
    "train_self_features",
]
