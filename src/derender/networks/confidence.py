"""Per-pixel uncertainty of the reconstruction; used in training only.

Source: unsup3d, Sec. 3.2. The network predicts, from the image alone, where its rendering cannot be trusted.
"""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from derender.networks.decoders import NarrowConv2d, doubling
from derender.networks.encoders import Encoder, NetworkSettings
from derender.scene.enlarge import doubled


@dataclass(frozen=True)
class Confidence:
    """Standard deviations, positive, of the reconstruction and of its flipped twin.

    ``photometric`` are of colours, (N, 1, H, W), ``perceptual`` of perceptual features, (N, 1, H/4, W/4).
    """

    photometric: Float[Tensor, "n 1 h w"]
    photometric_flip: Float[Tensor, "n 1 h w"]
    perceptual: Float[Tensor, "n 1 h4 w4"]
    perceptual_flip: Float[Tensor, "n 1 h4 w4"]


class ConfidenceNet(nn.Module):
    """Image to four maps of uncertainty."""

    def __init__(self, settings: NetworkSettings):
        super().__init__()
        width, code = settings.width, settings.confidence_code_size
        self.encoder = Encoder(settings, width, code, normalised=True)
        previous = 8 * width
        upsampling: list[nn.Module] = [nn.ConvTranspose2d(code, previous, 4, bias=False), nn.ReLU()]
        for stage in range(settings.stages - 2):
            channels = max(4 * width // 2**stage, 2 * width)
            upsampling += doubling(previous, channels)
            previous = channels
        self.trunk = nn.Sequential(*upsampling)
        self.photometric_head = nn.Sequential(
            *doubling(previous, width), *doubling(width, width), NarrowConv2d(width, 2)
        )
        self.perceptual_head = nn.Conv2d(previous, 2, 3, padding=1, bias=False)
        self.doublings = settings.doublings

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Confidence:
        trunk = self.trunk(self.encoder(images)[:, :, None, None])
        maps = [self.photometric_head(trunk).float(), self.perceptual_head(trunk).float()]
        for _ in range(self.doublings):
            maps = [doubled(one, "smooth") for one in maps]
        photometric, perceptual = map(softplus, maps)
        return Confidence(photometric[:, :1], photometric[:, 1:], perceptual[:, :1], perceptual[:, 1:])
