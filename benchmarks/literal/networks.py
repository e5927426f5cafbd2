"""The five networks at 64x64, layer by layer, each a module of its own with weights in NCHW.

Leaves out every setting: sizes are the paper's.
"""

from torch import Tensor, nn

CODE = 256


def down(channels_in: int, channels_out: int) -> nn.Conv2d:
    return nn.Conv2d(channels_in, channels_out, 4, stride=2, padding=1, bias=False)


def up(channels_in: int, channels_out: int) -> nn.ConvTranspose2d:
    return nn.ConvTranspose2d(channels_in, channels_out, 4, stride=2, padding=1, bias=False)


def same(channels_in: int, channels_out: int, kernel: int) -> nn.Conv2d:
    return nn.Conv2d(channels_in, channels_out, kernel, padding=kernel // 2, bias=False)


def map_encoder(code: int) -> list[nn.Module]:
    layers: list[nn.Module] = []
    for shallow, deep, groups in ((3, 64, 16), (64, 128, 32), (128, 256, 64)):
        layers += [down(shallow, deep), nn.GroupNorm(groups, deep), nn.LeakyReLU(0.2)]
    layers += [down(256, 512), nn.LeakyReLU(0.2)]
    return [*layers, nn.Conv2d(512, code, 4, bias=False), nn.ReLU()]


def map_net(channels: int) -> nn.Sequential:
    """Geometry (one raw channel) or albedo (three)."""
    layers = map_encoder(CODE)
    layers += [nn.ConvTranspose2d(CODE, 512, 4, bias=False), nn.ReLU(), same(512, 512, 3), nn.ReLU()]
    for wide, narrow, groups in ((512, 256, 64), (256, 128, 32), (128, 64, 16)):
        layers += [up(wide, narrow), nn.GroupNorm(groups, narrow), nn.ReLU()]
        layers += [same(narrow, narrow, 3), nn.GroupNorm(groups, narrow), nn.ReLU()]
    layers += [nn.Upsample(scale_factor=2, mode="nearest")]
    for kernel in (3, 5):
        layers += [same(64, 64, kernel), nn.GroupNorm(16, 64), nn.ReLU()]
    return nn.Sequential(*layers, same(64, channels, 5))


def vector_net(numbers: int) -> nn.Sequential:
    """Light (four numbers) or camera (six)."""
    layers: list[nn.Module] = []
    for shallow, deep in ((3, 32), (32, 64), (64, 128), (128, 256)):
        layers += [down(shallow, deep), nn.ReLU()]
    layers += [nn.Conv2d(256, CODE, 4, bias=False), nn.ReLU(), nn.Conv2d(CODE, numbers, 1, bias=False)]
    return nn.Sequential(*layers, nn.Flatten(), nn.Tanh())


class ConfidenceNet(nn.Module):
    """Two maps for the colours at 64x64, two for the perceptual features at 16x16."""

    def __init__(self) -> None:
        super().__init__()
        layers = [*map_encoder(128), nn.ConvTranspose2d(128, 512, 4, bias=False), nn.ReLU()]
        for wide, narrow, groups in ((512, 256, 64), (256, 128, 32)):
            layers += [up(wide, narrow), nn.GroupNorm(groups, narrow), nn.ReLU()]
        self.trunk = nn.Sequential(*layers)
        colours: list[nn.Module] = []
        for wide in (128, 64):
            colours += [up(wide, 64), nn.GroupNorm(16, 64), nn.ReLU()]
        self.colours = nn.Sequential(*colours, same(64, 2, 5), nn.Softplus())
        self.features = nn.Sequential(same(128, 2, 3), nn.Softplus())

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        trunk = self.trunk(images)
        return self.colours(trunk), self.features(trunk)


class Vgg16(nn.Module):
    """VGG16 to relu4_3, of which only relu3_3 is used."""

    def __init__(self) -> None:
        super().__init__()
        blocks = self._block(3, 64, 2) + self._block(64, 128, 2) + self._block(128, 256, 3)
        self.to_relu3_3 = nn.Sequential(*blocks[:-1])
        self.to_relu4_3 = nn.Sequential(nn.MaxPool2d(2), *self._block(256, 512, 3)[:-1])
        self.requires_grad_(False)

    def forward(self, images: Tensor) -> Tensor:
        mean = images.new_tensor((0.485, 0.456, 0.406)).view(1, 3, 1, 1)
        spread = images.new_tensor((0.229, 0.224, 0.225)).view(1, 3, 1, 1)
        features = self.to_relu3_3((images - mean) / spread)
        self.to_relu4_3(features)
        return features

    @staticmethod
    def _block(channels_in: int, channels_out: int, convolutions: int) -> list[nn.Module]:
        layers: list[nn.Module] = []
        for _ in range(convolutions):
            layers += [nn.Conv2d(channels_in, channels_out, 3, padding=1), nn.ReLU()]
            channels_in = channels_out
        return [*layers, nn.MaxPool2d(2)]
