"""What every perceptual feature extractor shares: a frozen convolutional net that takes pictures in 0..1.

It normalises its input, runs ``features``, and divides by one number found on a calibration batch, so that
confidence terms mean the same whichever weights are used. Leaves out the loss (perceptual.py) and where
weights come from.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn


class PerceptualFeatures(nn.Module):
    """A frozen net from pictures in 0..1 to feature maps; always in evaluation mode, never trained further.

    Attributes:
        kind: the name under which ``build_perceptual`` makes it.
        stride: pixels per feature location.
        channels: channels of the feature map.
    """

    kind: str
    stride: int
    channels: int
    scale: Tensor
    image_mean: Tensor
    image_std: Tensor

    def __init__(self, features: nn.Sequential, image_mean: tuple[float, ...], image_std: tuple[float, ...]):
        super().__init__()
        self.features = features
        self.register_buffer("scale", torch.ones(()))
        self.register_buffer("image_mean", torch.tensor(image_mean).view(1, 3, 1, 1))
        self.register_buffer("image_std", torch.tensor(image_std).view(1, 3, 1, 1))
        self.requires_grad_(False)
        self.eval()

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n c fh fw"]:
        """Calibrated features, with gradient to the pictures (never to the weights)."""
        return self.features((images - self.image_mean) / self.image_std) * self.scale

    @torch.no_grad()
    def target(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n c fh fw"]:
        """The same without gradient, for the pictures that a rendering is compared with."""
        return self(images)

    @torch.no_grad()
    def calibrate_(self, images: Float[Tensor, "n 3 h w"]) -> "PerceptualFeatures":
        """Set the scale so that on these pictures the features' spread about each channel's mean is 1.

        The spread is pooled over channels (one number for all), so relations between channels stay, and two
        unrelated places differ by a mean square of about 2. A few hundred pictures are enough.
        """
        self.scale.fill_(1.0)
        count = 0
        total = square = torch.zeros(self.channels, dtype=torch.float64, device=images.device)
        for batch in images.split(16):
            found = self(batch).double()
            count += found.numel() // self.channels
            total = total + found.sum(dim=(0, 2, 3))
            square = square + found.square().sum(dim=(0, 2, 3))
        spread = (square / count - (total / count).square()).clamp(min=0).mean().sqrt().item()
        if not 1e-8 < spread < float("inf"):
            raise ValueError(
                f"the perceptual features do not vary over {len(images)} calibration pictures "
                f"(spread {spread:g}); give pictures that differ, or check the weights"
            )
        self.scale.fill_(1.0 / spread)
        return self

    def train(self, mode: bool = True) -> "PerceptualFeatures":
        """Stay in evaluation mode, whatever the model around it does."""
        return super().train(False)
