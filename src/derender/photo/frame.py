"""The square part of a photograph that a model is given: cut out at any size, and put back.

Leaves out finding it (faces.py, scene/crop.py).
"""

from dataclasses import dataclass
from math import ceil, cos, radians, sin

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor
from torch.nn.functional import grid_sample

Pixels = UInt8[np.ndarray, "h w 3"]  # a photograph
BORDER_SHARE = 1 / 16  # width over which an edited crop fades into its photograph, of the crop's side
GONE = 0.05  # change from which a moved thing's fine detail is gone from where it was
BESIDE = 4  # pixels around what is visible that are drawn, too; in such steps, for threads to share


@dataclass(frozen=True)
class Frame:
    """A square in a photograph, perhaps turned, perhaps reaching beyond it.

    Attributes:
        x, y: its centre in pixels from the photograph's upper left corner.
        side: in pixels.
        roll_deg: clockwise turn of its upright direction, as seen.
    """

    x: float
    y: float
    side: float
    roll_deg: float = 0.0

    @classmethod
    def centred(cls, width: int, height: int) -> "Frame":
        """The largest upright square in the middle."""
        side = min(width, height)
        left, top = (width - side) // 2, (height - side) // 2
        return cls(left + side / 2, top + side / 2, side)

    @property
    def upright(self) -> bool:
        """Whether it is not turned."""
        return abs(self.roll_deg) < 1e-6

    def snapped(self) -> "Frame":
        """Moved to whole pixels where it is upright: cut out at its own side, nothing is resampled."""
        if not self.upright:
            return self
        side = max(1, round(self.side))
        return Frame(round(self.x - side / 2) + side / 2, round(self.y - side / 2) + side / 2, side)

    def widened(self, share: float) -> "Frame":
        """Larger by ``share`` of the side, in whole pixels, in every direction."""
        return Frame(self.x, self.y, self.side + 2 * round(share * self.side), self.roll_deg)

    def part(self, across: float, down: float, side: float) -> "Frame":
        """A smaller square in this one: its centre from -1 to 1, its side as a share."""
        return Frame(self.x + across * self.side / 2, self.y + down * self.side / 2, side * self.side)

    def within(self, other: "Frame") -> dict[str, float]:
        """Side as a share of another frame's, and centre from -1 to 1 across and down it."""
        place = {"side": self.side, "across": 2 * (self.x - other.x), "down": 2 * (self.y - other.y)}
        return {name: round(value / other.side, 6) for name, value in place.items()}

    def corners(self) -> list[tuple[float, float]]:
        """Upper left, upper right, lower right, lower left, in pixels."""
        c, s, half = cos(radians(self.roll_deg)), sin(radians(self.roll_deg)), self.side / 2
        signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        return [(self.x + half * (c * u - s * v), self.y + half * (s * u + c * v)) for u, v in signs]

    def visible(self, width: int, height: int, size: int) -> tuple[slice, slice]:
        """Rows and columns, and few more, where this part at ``size`` x ``size`` shows the photograph."""
        c, s = cos(radians(self.roll_deg)), sin(radians(self.roll_deg))
        ends = [(x - self.x, y - self.y) for x in (0, width) for y in (0, height)]
        places = np.array([(c * y - s * x, c * x + s * y) for x, y in ends]) / self.side + 0.5
        low = np.floor(places.min(axis=0) * size / BESIDE - 1) * BESIDE
        high = np.ceil(places.max(axis=0) * size / BESIDE + 1) * BESIDE
        first = np.clip(low, 0, size - BESIDE).astype(int).tolist()
        last = np.clip(high, BESIDE, size).astype(int).tolist()
        return slice(first[0], last[0]), slice(first[1], last[1])

    def cut(self, photo: Pixels, size: int) -> UInt8[np.ndarray, "3 size size"]:
        """The part at ``size`` x ``size``, antialiased; beyond the photograph its border is continued."""
        angle = radians(self.roll_deg)
        around = self.side if self.upright else self.side * (abs(cos(angle)) + abs(sin(angle)) + 6 / size)
        box = [self.x - around / 2, self.y - around / 2, self.x + around / 2, self.y + around / 2]
        height, width = photo.shape[:2]
        margins = [ceil(max(0, beyond)) for beyond in (-box[0], -box[1], box[2] - width, box[3] - height)]
        left, top, right, bottom = margins
        if any(margins):
            photo = np.pad(photo, ((top, bottom), (left, right), (0, 0)), mode="edge")
        part = (box[0] + left, box[1] + top, box[2] + left, box[3] + top)
        large = size if self.upright else round(size * around / self.side)
        image = Image.fromarray(photo).resize((large, large), Image.Resampling.LANCZOS, box=part)
        if not self.upright:
            image = image.rotate(self.roll_deg, Image.Resampling.BICUBIC)
            first = (large - size) // 2
            image = image.crop((first, first, first + size, first + size))
        return np.ascontiguousarray(np.asarray(image).transpose(2, 0, 1))

    def beyond(self, width: int, height: int, size: int) -> Float[Tensor, "size size"]:
        """How far each pixel of the part at ``size`` x ``size`` lies outside the photograph, in its sides."""
        c, s = cos(radians(self.roll_deg)), sin(radians(self.roll_deg))
        along = ((torch.arange(size) + 0.5) / size - 0.5) * self.side
        x, y = self.x + c * along - s * along[:, None], self.y + s * along + c * along[:, None]
        outside = torch.maximum((x - width / 2).abs() - width / 2, (y - height / 2).abs() - height / 2)
        return outside.clamp(min=0) / self.side

    def paste(
        self, photo: Pixels, before: Float[Tensor, "3 s s"], after: Float[Tensor, "3 s s"],
        moved: bool = False,
    ) -> Pixels:  # fmt: skip
        """The photograph with an edited crop (0..1): what changed is added, so the rest keeps its pixels.

        Detail finer than the crop stays where it is; where things ``moved``, it goes with what is changed.
        """
        height, width = photo.shape[:2]
        across, down = zip(*self.corners(), strict=True)
        left, top = max(0, int(min(across))), max(0, int(min(down)))
        right, bottom = min(width, ceil(max(across))), min(height, ceil(max(down)))
        if left >= right or top >= bottom:
            return photo
        centres = (torch.arange(after.shape[-1]) + 0.5) / after.shape[-1]
        rise = (torch.minimum(centres, 1 - centres) / BORDER_SHARE).clamp(0, 1).to(after)
        change = (after - before) * (rise * rise[:, None])  # which fades to 0 at the border
        c, s, half = cos(radians(self.roll_deg)), sin(radians(self.roll_deg)), self.side / 2
        u = (torch.arange(left, right) + 0.5 - self.x)[None] / half
        v = (torch.arange(top, bottom) + 0.5 - self.y)[:, None] / half
        grid = torch.stack((c * u + s * v, c * v - s * u), dim=-1)[None].float()
        both = sampled(torch.cat((change, before))[None].cpu(), grid, padding_mode="zeros")
        added, old = both.split(3, dim=1)
        region = torch.from_numpy(photo[top:bottom, left:right].astype(np.float32) / 255).permute(2, 0, 1)
        if moved:
            most = cv2.dilate(added[0].abs().amax(dim=0).numpy(), np.ones((3, 3)))
            gone = (torch.from_numpy(most) / GONE).clamp(0, 1)
            added = added + gone * (old - region)
        edited = (255 * (region + added[0])).round().clamp(0, 255)
        pasted = photo.copy()
        pasted[top:bottom, left:right] = edited.permute(1, 2, 0).to(torch.uint8).numpy()
        return pasted


def resized(photo: Pixels, side: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The photograph with its longer side of so many pixels, antialiased."""
    height, width = photo.shape[:2]
    share = side / max(height, width)
    size = max(1, round(width * share)), max(1, round(height * share))
    return np.asarray(Image.fromarray(photo).resize(size, Image.Resampling.LANCZOS))


def sampled(
    maps: Float[Tensor, "n c h w"], places: Float[Tensor, "n r k 2"], align_corners: bool = False, **how: str
) -> Float[Tensor, "n c r k"]:
    """`torch.nn.functional.grid_sample`, whose threads share images: of a single one each takes some rows."""
    threads, rows = torch.get_num_threads(), places.shape[1]
    if len(maps) > 1 or rows % threads:
        return grid_sample(maps, places, align_corners=align_corners, **how)
    bands, maps = places.unflatten(1, (threads, -1))[0], maps.expand(threads, -1, -1, -1)
    return grid_sample(maps, bands, align_corners=align_corners, **how).transpose(0, 1).flatten(1, 2)[None]


def look_up(
    maps: Float[Tensor, "n c h w"], place: Float[Tensor, "n 2 r k"], mode: str = "bilinear"
) -> Float[Tensor, "n c r k"]:
    """Square maps at pixel coordinates (across, down), as ``sampled`` does it."""
    grid = place.permute(0, 2, 3, 1) * 2 / (maps.shape[-1] - 1) - 1
    return sampled(maps, grid, mode=mode, padding_mode="border", align_corners=True)
