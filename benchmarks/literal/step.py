"""One training step as the official program does it: float32, NCHW, five networks, five optimisers.

Differences from derender's step are exactly these: VGG runs to relu4_3 although relu3_3 is used; the input
goes through it twice, with gradient; every network has an Adam of its own that loops over its tensors; memory
is NCHW. Leaves out LOOCC. As in derender, and so that both compute the same number, uncovered pixels show the
input to VGG and sigma has a floor of 1e-3; neither costs time worth measuring.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad

from derender.render import render
from literal.networks import ConfidenceNet, Vgg16, map_net, vector_net

SIGMA_FLOOR = 1e-3
NETS = ("geometry", "albedo", "light", "camera", "confidence")


class LiteralStep(nn.Module):
    """Networks, optimisers and the loss; call ``step`` once per batch of images in 0..1."""

    def __init__(self) -> None:
        super().__init__()
        self.geometry, self.albedo = map_net(1), map_net(3)
        self.light, self.camera = vector_net(4), vector_net(6)
        self.confidence = ConfidenceNet()
        self.vgg = Vgg16()
        self.optimisers = [
            torch.optim.Adam(
                getattr(self, name).parameters(), lr=1e-4, weight_decay=5e-4, foreach=False, fused=False
            )
            for name in NETS
        ]

    def step(self, images: Tensor) -> float:
        loss = self.loss(images)
        for optimiser in self.optimisers:
            optimiser.zero_grad()
        loss.backward()
        for optimiser in self.optimisers:
            optimiser.step()
        return loss.item()

    def loss(self, images: Tensor) -> Tensor:
        """Reconstruction by the scene plus half of that by its flipped twin."""
        pictures = images * 2 - 1
        raw = self.geometry(pictures).squeeze(1)
        depth = 1 + 0.1 * (raw - raw.mean(dim=(1, 2), keepdim=True)).tanh()
        depth = pad(depth[:, :, 2:-2], (2, 2), value=0.7 * 1.1 + 0.3 * 0.9)
        albedo = self.albedo(pictures).tanh() / 2 + 0.5
        light = self.light(pictures)
        light = torch.cat([light[:, :2] / 2 + 0.5, light[:, 2:].atan()], dim=1)
        camera = self.camera(pictures) * images.new_tensor([math.radians(60)] * 3 + [0.1, 0.1, 0.0])
        colours, features = self.confidence(pictures)

        count = len(images)
        both = render(
            torch.cat([depth, depth.flip(2)]), torch.cat([albedo, albedo.flip(3)]),
            torch.cat([light, light]), torch.cat([camera, camera]),
        )  # fmt: skip
        mask = (both.mask[:count] * both.mask[count:])[:, None]
        total = images.new_zeros(())
        for half, weight in ((0, 1.0), (1, 0.5)):
            rebuilt = both.image[half * count : (half + 1) * count]
            total = total + weight * self._photometric(rebuilt, images, mask, colours[:, half : half + 1])
            filled = torch.where(mask > 0, rebuilt, images)
            total = total + weight * self._perceptual(filled, images, mask, features[:, half : half + 1])
        return total

    @staticmethod
    def _photometric(rebuilt: Tensor, images: Tensor, mask: Tensor, sigma: Tensor) -> Tensor:
        sigma = (sigma**2 + SIGMA_FLOOR**2).sqrt()
        likelihood = (rebuilt - images).abs() * math.sqrt(2) / sigma + sigma.log()
        mask = mask.expand_as(likelihood)
        return (likelihood * mask).sum() / mask.sum()

    def _perceptual(self, rebuilt: Tensor, images: Tensor, mask: Tensor, sigma: Tensor) -> Tensor:
        rebuilt, wanted = self.vgg(torch.cat([rebuilt, images])).chunk(2)
        sigma = (sigma**2 + SIGMA_FLOOR**2).sqrt()
        likelihood = (rebuilt - wanted) ** 2 / (2 * sigma**2) + sigma.log()
        mask = avg_pool2d(mask, mask.shape[-1] // rebuilt.shape[-1]).expand_as(likelihood)
        return (likelihood * mask).sum() / mask.sum()
