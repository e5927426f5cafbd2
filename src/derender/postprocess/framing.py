"""Where in an image the object is: the crop in which a model's training images would show it.

Features change with the crop of an image, by more than two people differ. A small convolutional network,
trained on crops of the training images (training/framing.py), sees an image in any light. It estimates how
far the image is from their framing and how sure that is, then once more in that crop. Where it is not sure
the image stays as it is: the positive-part James-Stein estimator (Efron and Morris, JASA 1973).
"""

import math
from collections.abc import Mapping
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, conv2d, linear, relu

from derender.scene.crop import crop_images, parameters_of, similarities, within

SIDE = 64  # in pixels, at which images are looked at
STRIDES, WIDTHS, HIDDEN = (2, 2, 1, 2, 2), (24, 48, 48, 96, 96), 128
"""Steps and channels of convolutions of 3 x 3, and channels between the two linear layers that follow."""
ROUNDS = 2
UNIT = 0.1  # of an answer: logarithm of scale, roll in radians, centre across and down in half sides
_SHAPES = (
    *((after, before, 3, 3) for before, after in pairwise((3, *WIDTHS))),
    *((HIDDEN, WIDTHS[-1] * (SIDE // math.prod(STRIDES)) ** 2), (8, HIDDEN)),
)
DOUBT = 100.0  # an image stays where its squared answers over their variances add up to less
_LEAST_DEVIATION = 0.05  # of an image's pixels, by which they are divided


Answers = Float[Tensor, "n 4"]


class Framing(nn.Module):
    """Finds the crops of images in which a model expects its object.

    ``tensors`` are "weight0", "bias0" and so on; a missing one, or another shape, is a ValueError.
    """

    def __init__(self, tensors: Mapping[str, Tensor]):
        super().__init__()
        for layer, shape in enumerate(_SHAPES):
            for name, size in ((f"weight{layer}", shape), (f"bias{layer}", shape[:1])):
                if name not in tensors or tensors[name].shape != size:
                    raise ValueError(f"a framing network has a {name!r} of {size}, and this one has not")
                self.register_buffer(name, tensors[name].float(), persistent=False)

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
        """Images in 0..1 in the crops that are found for them, at their own size."""
        return crop_images(images, self.crops(images))

    @torch.no_grad()
    def crops(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 2 3"]:
        """The crop of each image (scene/crop.py): a similarity, the same of an image in any batch."""
        small = adaptive_avg_pool2d(images, SIDE)
        crops, mirror = similarities(images.new_zeros(len(images), 4)), images.new_tensor([1.0, -1, -1, 1])
        error = crops.new_ones(())
        for _ in range(ROUNDS):
            seen = crop_images(small, crops)
            (answer, error), (mirrored, other) = self.answers(seen), self.answers(seen.flip(-1))
            crops, error = within(similarities((answer + mirror * mirrored) / 2), crops), (error + other) / 2
        parameters = parameters_of(crops)
        doubt = DOUBT / (parameters / error).square().sum(dim=1, keepdim=True)
        return similarities(parameters * (1 - doubt).clamp(min=0))

    def answers(self, images: Float[Tensor, "n 3 64 64"]) -> tuple[Answers, Answers]:
        """Parameters of the `similarities` that frame each image, looked at once, and their deviations."""
        seen = standardised(images)
        for layer, stride in enumerate(STRIDES):
            seen = relu(conv2d(seen, *self._layer(layer), stride=stride, padding=1))
        seen = relu(linear(seen.flatten(1), *self._layer(len(STRIDES))))
        answer, error = linear(seen, *self._layer(len(STRIDES) + 1)).chunk(2, dim=1)
        return UNIT * answer, UNIT * limited(error).exp()

    def _layer(self, layer: int) -> tuple[Tensor, Tensor]:
        return self.get_buffer(f"weight{layer}"), self.get_buffer(f"bias{layer}")


def limited(error: Answers) -> Answers:
    """Logarithms of deviations that are neither next to nothing nor next to infinite."""
    return error.clamp(-4, 2)


def standardised(images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Each image with mean 0 and about unit variance."""
    images = images - images.mean(dim=(1, 2, 3), keepdim=True)
    return images / (images.std(dim=(1, 2, 3), keepdim=True) + _LEAST_DEVIATION)
