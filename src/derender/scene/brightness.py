"""How bright an object is and how bright its light: one image only shows their product.

Stated prior: a light is as bright whatever colour it falls on. Then the part of the product that an albedo's
chroma explains, over a set of images, is the albedo's: dark skin, say, has another hue than light skin. Of
the rest a fixed share is the albedo's. Only the scale moves between both; a scene's rendering stays.
"""

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from derender.scene.scene import Scene
from derender.settings import Settings

FACING = 0.6  # mean cosine of a surface's normals and a light within 45 degrees
LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709
_LEAST = 1e-3


class BrightnessPrior(Settings):
    """Linear in log chroma (red, blue over green): log luminance of an albedo, and of albedo times light."""

    red: float
    blue: float
    albedo: float
    product: float
    share: float = Field(default=0.2, ge=0, le=1)  # albedo's, of the product above its expectation

    @classmethod
    def of(cls, cues: Float[Tensor, "n 4"]) -> "BrightnessPrior":
        """Least squares over the ``brightness_cues`` of a set of images; the mean luminance stays."""
        cues = cues.double()  # in float32 the last digits depend on where the numbers lie in memory
        luminance, light, chroma = cues[:, 0], cues[:, 1], cues[:, 2:]
        product, centre = luminance + light, chroma.mean(dim=0)
        weights = torch.linalg.lstsq(chroma - centre, (product - product.mean())[:, None]).solution[:, 0]
        means = torch.stack([luminance.mean(), product.mean()]) - weights @ centre
        red, blue, own, both = torch.cat([weights, means]).float().tolist()
        return cls(red=red, blue=blue, albedo=own, product=both)

    def __call__(self, scene: Scene) -> Scene:
        """The scene with the same rendering, whose albedo is as bright as expected."""
        luminance, light, red, blue = brightness_cues(scene).unbind(dim=1)
        explained = self.red * red + self.blue * blue
        rest = luminance + light - explained - self.product
        factor = (explained + self.albedo + self.share * rest - luminance).exp()
        brightest = scene.albedo.flatten(1).amax(dim=1).clamp(min=_LEAST)
        factor = torch.minimum(factor, (1 / brightest).clamp(min=1))[:, None]
        intensity, direction = scene.light.split(2, dim=1)
        light = torch.cat([intensity / factor, direction], dim=1)
        return scene.with_parameters(albedo=scene.albedo * factor[..., None, None], light=light)


def brightness_cues(scene: Scene) -> Float[Tensor, "n 4"]:
    """Logarithms: luminance of the mean albedo, total light, and the albedo's red and blue over its green.

    The mean is weighted by a Hann window over the canonical map, whose middle is the object's.
    """
    along, across = (
        torch.hann_window(size + 2, periodic=False).to(scene.albedo)[1:-1] for size in scene.albedo.shape[-2:]
    )
    window = along[:, None] * across
    colour = ((scene.albedo * window).sum(dim=(2, 3)) / window.sum()).clamp(min=_LEAST)
    light = scene.light[:, 0] + FACING * scene.light[:, 1]
    luminance = colour @ torch.tensor(LUMINANCE).to(colour)
    red, blue = ((colour[:, channel] / colour[:, 1]).log() for channel in (0, 2))
    return torch.stack([luminance.log(), light.clamp(min=_LEAST).log(), red, blue], dim=1)
