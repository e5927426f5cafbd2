"""A photograph under other lighting and from other viewpoints, in its own detail.

A model sees 64 or 128 pixels; a photograph has more. Geometry and light vary slowly, so they are drawn on a
coarse grid and enlarged: where each point of the new image lies in the photograph, and by how much its
shading changes. The photograph is looked up there at its own resolution. Its own light and viewpoint give it
back. A point that it does not show is taken from its mirror image where that is seen. Elsewhere it is the
model's albedo, moved to the photograph's colours; the three blend. Around the model's maps the surface
continues into a plane through the object's centre: hair, neck and background follow and come to rest.
New light falls on the object alone, whose outline GrabCut (Rother et al., SIGGRAPH 2004) finds by colour.
The more shading or view change, the more the model's colours weigh, after a change of shading in their smooth
part: what it explained wrongly would otherwise stay in the surface. Shading multiplies coded values, as in
training: with a display's gamma that is linear light times the ratio of linear shadings; sRGB's own curve
gives nearly the same (lab/log.md). Highlights and haze that the renderer knows are taken off and drawn anew;
what they cannot explain stays. Over-exposed skin darkens in the colour of the skin around it.
"""

from math import atan, degrees, radians, tan
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from derender.photo.frame import look_up, sampled
from derender.render import Rendering, warp
from derender.renderers import Renderer
from derender.scene import Scene
from derender.scene.camera import OBJECT_CENTRE, project, to_camera, unproject
from derender.scene.enlarge import at_size

GRID = 256  # largest side of the grid on which geometry and shading are drawn
FACING = (0.20, 0.45)  # cosine between surface and ray: below, a photograph tells nothing, above, all
MOVED = (0.01, 0.03)  # shares of the side: if nothing moves more than the first, all is the photograph's
LIT = (0.10, 0.25)  # shading, as FACING
LEAST_SHADING, LARGEST_RATIO = 0.05, 20.0
DISTRUST = 4.0  # detail weighs 1 / (1 + DISTRUST m²): mean squared log ratio, or most shift in half sides
DETAIL_SHARE = 0.03  # of the side: reach of what a change of light leaves of the photograph
HIDDEN_BEHIND = 0.01  # scene units that a point may lie behind what is seen there
FEATHER_SHARE = 1 / 30  # width of the blends, of the image's width
COLOUR_SHARE = 1 / 12  # reach of the colours carried over to what is not seen
COLOUR_MARGIN = 0.25  # of the canonical map, left out of what colours are carried over from
RIM_SHARE = 0.04  # of the side: the rim of the model's maps, where depth ends in a wall
REACH_SHARE = 1 / 4  # of the side: how far the surface goes on around them, at least
FADE_SHARE = 1 / 3  # reach of new shading around them
SMOOTH_SHARE = 0.012  # of the side: reach of the box filters over the depth that is shaded
SURE = 0.65  # of half the side: radius within which what faces the camera is the object
LIKELY = (0.80, 0.60)  # of half the side: radius, and column, in which the search for its outline starts
DARKEST = 1e-3
CLIPPED = (0.96, 0.99)  # as FACING: up to the first a channel is well exposed, from the second it is not
BRIGHT = (0.7, 0.9)  # of the colours around: below, what is over-exposed is another thing, as an eye's white
DARKER = 0.9  # ratio of shading from which on over-exposed skin shows its colour in full
FEW = 0.02  # weight of the object's mean colour among those around an over-exposed pixel
LAMBERT = Renderer("lambert")


class PhotoDetail:
    """Draws scenes of one photograph in its own detail; called like a renderer.

    Args:
        photo: (3, S, S) in 0..1: the crop that the scene was made of, at any size from the scene's on.
        scene: what the model found in it, one scene.
        fov_deg: horizontal field of view.
        margin: how far the photograph reaches beyond that crop on every side, in shares of the crop's side.
        renderer: whose diffuse light multiplies the surface.
        visible: rows and columns of the photograph that are drawn; the rest of it stays as it is.
    """

    def __init__(
        self, photo: Float[Tensor, "3 s s"], scene: Scene, fov_deg: float, margin: float = 0.0,
        renderer: Renderer = LAMBERT, visible: tuple[slice, slice] = (slice(None), slice(None)),
    ):  # fmt: skip
        if len(scene) != 1 or photo.ndim != 3 or photo.shape[-1] < scene.depth.shape[-1]:
            got = f"{tuple(photo.shape)} and {len(scene)} scenes of {scene.depth.shape[-1]} pixels"
            needed = "a photograph (3, S, S) and its one scene are needed, S no smaller than the scene"
            raise ValueError(f"{needed}; got {got}")
        self.photo, self.fov_deg, self.model_size = photo.to(scene.depth), fov_deg, scene.depth.shape[-1]
        self.size, self.span, self.visible = photo.shape[-1], 1 + 2 * margin, visible
        self.grid = min(max(GRID, self.model_size), self.size)
        self.rim = round(margin * self.grid)
        self.reach = max(self.rim, round(REACH_SHARE * self.grid))
        self.wide = self.grid + 2 * self.reach
        self.wide_fov = 2 * degrees(atan(tan(radians(fov_deg) / 2) * (self.wide - 1) / (self.grid - 1)))
        along = torch.arange(self.wide) + 0.5 - self.reach + self.rim
        along = torch.minimum(along, along.flip(0)) / self.rim if self.rim else torch.ones_like(along)
        rise = along.clamp(0, 1).to(self.photo)  # 1 in the crop, 0 at the border of the photograph around it
        self._inward = rise * rise[:, None]
        own = self._widened(scene.detach())
        points = to_camera(unproject(own.depth, self.wide_fov), own.camera)
        self._place = project(points, self.wide, self.wide, self.wide_fov).permute(0, 3, 1, 2)
        self._pixels = _square(torch.arange(self.wide).to(self.photo)).permute(0, 3, 1, 2)
        self.renderer = renderer
        self._shading, self._veil = self._light(own), renderer.veil(own, self.wide_fov)
        self._lost = _over_exposed(self.photo[None], self.span)
        self._seen = self._visible(own, points) * _ramp(self._shading, *LIT)
        self._colours, self._object = self._completed(own), self._found_object(own, points)
        at_home = self._warped(self._place, own)
        off = (at_home.image - self._pixels) * at_home.mask[:, None]
        self._off = off * (off.norm(dim=1, keepdim=True) < 1)  # what rounding leaves; more is hidden surface

    def __call__(self, scene: Scene) -> Rendering:
        """Images (N, 3, S, S) of scenes that differ from the photograph's in light, camera or depth.

        Albedo is the photograph's, whatever they hold. The mask is 1: around the surface is the photograph.
        """
        scene = self._widened(scene)
        count, shading, veil = len(scene), self._light(scene), self.renderer.veil(scene, self.wide_fov)
        own = torch.cat((self._place, self._seen, self._shading, self._veil, self._object), dim=1)
        edge = -RIM_SHARE - FEATHER_SHARE / 2
        reach = self._around(edge - FEATHER_SHARE, edge)
        maps = torch.cat((own, own.flip(-1), self._colours, reach), dim=1).expand(count, -1, -1, -1)
        view = self._warped(torch.cat((maps, shading, veil), dim=1), scene)
        sizes = (own.shape[1], own.shape[1], 3, 1, 1, veil.shape[1])
        own, mirrored, colours, inside, shading, veil = view.image.split(sizes, dim=1)
        covered = view.mask[:, None]
        place = own[:, :2] - look_up(self._off.expand(count, -1, -1, -1), own[:, :2])
        shift, mirror_shift = place - self._pixels, mirrored[:, :2] - self._pixels
        moved = (inside * shift)[..., ::4, ::4].norm(dim=1).amax(dim=(1, 2))[:, None, None, None] / self.grid
        seen = 1 - inside * (1 - torch.maximum(own[:, 2:3], 1 - _ramp(moved, *MOVED)))
        mirror_seen = inside * (1 - seen) * mirrored[:, 2:3] * mirrored[:, -1:]
        ratio, mirror_ratio = _ratio(shading, own[:, 3:4]), _ratio(shading, mirrored[:, 3:4])
        change = (ratio.log().square() * inside).sum(dim=(2, 3)) / inside.sum(dim=(2, 3)).clamp(min=1)
        changes = torch.cat((change[:, :, None, None], 2 * moved), dim=1).square()
        lit = own[:, -1:]
        doubts = inside * lit * (1 - 1 / (1 + DISTRUST * changes))
        shift = _filled(shift * covered, covered) * self._inward
        veils = (inside * one for one in (own[:, 4:-1], mirrored[:, 4:-1], veil))
        mask = (inside > 0.99).to(inside)
        near = torch.maximum(mask, _ramp(_blurred(mask, FADE_SHARE * self.grid), 0.02, 0.25))
        faded = (_filled(ratio.log() * mask, mask) * near**2).exp() ** lit  # to 1 around the model's maps
        drawn = colours * shading
        fields = (shift, mirror_shift, seen, mirror_seen, faded, mirror_ratio, drawn, *veils)
        image, depth = self._composed(fields, doubts), self.photo.new_zeros(count, self.size, self.size)
        depth[:, *self.visible] = self._enlarged(view.depth[:, None])[0][:, 0]
        return Rendering(image, depth, torch.ones_like(depth))

    def _widened(self, scene: Scene) -> Scene:
        """On the wide grid. The surface continues around the model's maps into a plane at the centre."""
        scene, edge = at_size(scene, self.grid), round(RIM_SHARE * self.grid)
        inner = scene.depth[:, None, edge:-edge, edge:-edge]
        level = pad(inner, (edge + self.reach,) * 4, mode="replicate")[:, 0]
        near = self._around(-RIM_SHARE, self.reach / self.grid)[:, 0]
        depth = OBJECT_CENTRE[2] + near * (level - OBJECT_CENTRE[2])
        albedo = pad(scene.albedo, (self.reach,) * 4, mode="replicate")
        return scene.with_parameters(depth=depth, albedo=albedo)

    def _warped(self, maps: Tensor, scene: Scene) -> Rendering:
        return warp(maps, scene.depth, scene.camera, self.wide_fov)

    def _around(self, full: float, none: float) -> Float[Tensor, "1 1 w w"]:
        """1 up to so far outside the model's maps (shares of the side, negative inside), falling to 0."""
        along = (torch.arange(self.wide) - (self.wide - 1) / 2).abs() / self.grid - 0.5
        return _ramp(-torch.maximum(along, along[:, None]), -none, -full)[None, None].to(self.photo)

    def _light(self, scene: Scene) -> Float[Tensor, "n 1 h w"]:
        """Shading of the smoothed surface: what is finer in a model's depth is often not there."""
        depth, reach = scene.depth[:, None], round(SMOOTH_SHARE * self.grid)
        scene = scene.with_parameters(depth=_averaged(depth, reach)[:, 0])
        return self.renderer.shading(scene, self.wide_fov).mean(dim=1, keepdim=True)

    def albedo(self) -> Float[Tensor, "1 3 s s"]:
        """The texture of the canonical view: the photograph without its shading, completed."""
        bare = 1 / self._shading.clamp(min=LIT[0])
        shift, mirror_shift = (place - self._pixels for place in (self._place, self._place.flip(-1)))
        weights = (self._seen, (1 - self._seen) * self._seen.flip(-1))
        fields = (shift, mirror_shift, *weights, bare, bare.flip(-1), self._colours)
        fields += (self._veil, self._veil.flip(-1), 0 * self._veil)
        return self._composed(fields, torch.zeros(1, 2, 1, 1))

    def _composed(self, fields: tuple[Tensor, ...], doubts: Float[Tensor, "n 2 h w"]) -> Tensor:
        """Images at the photograph's size, from fields on the wide grid.

        Fields are shifts into the photograph and into its mirror image, weights of both, factors of both, the
        model's colours, and veils: of both, and the new one. Doubts weigh those colours against the
        photograph: their smooth part, where light changed, and all of them, where things moved.
        """
        shift, mirror_shift, seen, mirror_seen, ratio, mirror_ratio, drawn, veil, mirror_veil, new = fields
        doubts = doubts.expand(-1, -1, *seen.shape[2:])
        shown = self._enlarged(shift, ratio, drawn, doubts, seen, veil, new)
        shift, ratio, drawn, doubts, seen, veil, new = shown
        drawn = drawn.clamp(DARKEST, 1)
        image = seen * self._detailed(shift, ratio, drawn, doubts, veil, new)
        if bool((unseen := (seen < 0.999).any(dim=0)[0]).any()):
            part = (..., *(slice(int(at.min()), int(at.max()) + 1) for at in unseen.nonzero().T))
            mirrored = self._enlarged(mirror_shift, mirror_ratio, mirror_seen, mirror_veil, part=part)
            shift, ratio, weight, veil = mirrored
            drawn, doubts, seen, new = (field[part] for field in (drawn, doubts, seen, new))
            other = self._detailed(shift, ratio, drawn, doubts, veil, new, part)
            image[part] += weight * other + (1 - seen - weight) * _veiled(drawn, new)
        whole = self.photo.repeat(len(image), 1, 1, 1)
        whole[..., *self.visible] = image.clamp(0, 1)
        return whole

    def _detailed(
        self, shift: Tensor, ratio: Tensor, drawn: Tensor, doubts: Tensor, veil: Tensor, new: Tensor,
        part: tuple[Any, ...] = (...,),
    ) -> Tensor:  # fmt: skip
        """The photograph looked up at shifted places, its shading changed, and its veil to the new one."""
        unit = 2 * (self.model_size - 1) / (self.grid - 1) / self.model_size / self.span  # a grid pixel
        own = self._square_seen((torch.arange(self.size) + 0.5) * 2 / self.size - 1, part)
        places = own + (unit * shift).permute(0, 2, 3, 1)
        lost = (self._lost,) if bool(self._lost.any()) else ()
        photo = torch.cat((self.photo[None], *lost), dim=1).expand(len(shift), -1, -1, -1)
        result = sampled(photo, places, mode="bicubic", padding_mode="border")
        result, lost = result[:, :3], result[:, 3:]
        if lost.shape[1]:
            result = result + lost * _ramp(-ratio, -1, -DARKER)
        kept, beyond = result, 0.0
        if veil.shape[1]:
            clear = _cleared(result, veil)
            kept = clear.clamp(0, 1)
            beyond = _veiled(clear, veil) - _veiled(kept, veil)
        edited, (lit, moved) = (kept * ratio).clamp(DARKEST, 1).log(), doubts.split(1, dim=1)
        wrong = drawn.log() - edited
        surface = edited + torch.lerp(lit * smooth(wrong, lit, DETAIL_SHARE * self.size), wrong, moved)
        return _veiled(surface.clamp(max=0).exp(), new) + beyond

    def _enlarged(self, *fields: Tensor, part: tuple[Any, ...] = (...,)) -> tuple[Tensor, ...]:
        """Fields of the wide grid at the photograph's visible pixels, or a part of these."""
        places = ((torch.arange(self.size) + 0.5) / self.size - 0.5) * self.span * self.model_size
        across = places / (self.model_size - 1) * (self.grid - 1)  # from the middle, in grid pixels
        joined = torch.cat(fields, dim=1)
        centres = self._square_seen(across * 2 / (self.wide - 1), part).expand(len(joined), -1, -1, -1)
        enlarged = sampled(joined, centres, padding_mode="border", align_corners=True)
        return enlarged.split([field.shape[1] for field in fields], dim=1)

    def _square_seen(self, along: Tensor, part: tuple[Any, ...]) -> Float[Tensor, "1 r c 2"]:
        return _square(along.to(self.photo))[:, *self.visible][(*part, slice(None))]

    def on_grid(
        self, image: Float[Tensor, "1 3 s s"], size: int, spread: float = 1.0
    ) -> Float[Tensor, "1 3 size size"]:
        """What covers the photograph, on ``spread`` times the square of the model's pixel centres."""
        side = round(size * self.span / spread)
        if side < image.shape[-1]:
            image = interpolate(image, (side, side), mode="bilinear", antialias=True)
        edge = spread * (1 - 1 / self.model_size) / self.span
        centres = _square(torch.linspace(-edge, edge, size)).to(image)
        return sampled(image, centres, mode="bicubic", padding_mode="border").clamp(0, 1)

    def _completed(self, own: Scene) -> Float[Tensor, "1 3 g g"]:
        """The model's albedo in the photograph's colours, as far as those reach."""
        photo = self.on_grid(self.photo[None], self.grid) + self.on_grid(self._lost, self.grid)
        photo = look_up(photo, self._place - self.reach)
        bare = (_cleared(photo, self._veil) / self._shading.clamp(min=LIT[0])).clamp(0, 1)
        inner = self._seen * self._around(-COLOUR_MARGIN - FEATHER_SHARE, -COLOUR_MARGIN)
        weight, mirror_weight = inner, (1 - inner) * inner.flip(-1)
        known = weight + mirror_weight
        difference = weight * bare + mirror_weight * bare.flip(-1) - known * own.albedo
        reach = COLOUR_SHARE * self.grid
        return (own.albedo + _blurred(difference, reach) / _blurred(known, reach).clamp(min=0.05)).clamp(0, 1)

    def _visible(self, own: Scene, points: Tensor) -> Float[Tensor, "1 1 g g"]:
        """How well the photograph shows each canonical point, 0..1."""
        view = self._warped(own.albedo[:, :1], own)
        front = look_up(view.depth[:, None], self._place, "nearest")
        start = self.reach - self.rim
        inside = ((self._place >= start) & (self._place < self.wide - start)).all(dim=1, keepdim=True)
        visible = inside & (points[..., 2][:, None] <= front + HIDDEN_BEHIND) & (front > 0)
        share = visible * _ramp(_facing(points), *FACING)[:, None]
        reach = max(1, round(FEATHER_SHARE * self.grid))
        least = cv2.erode(share[0, 0].cpu().numpy(), np.ones((2 * reach + 1, 2 * reach + 1)))
        share = torch.from_numpy(least).to(share)[None, None]
        return avg_pool2d(share, 2 * reach + 1, stride=1, padding=reach, count_include_pad=False)

    def _found_object(self, own: Scene, points: Tensor) -> Float[Tensor, "1 1 w w"]:
        """How surely each canonical point is the object and not what is behind it, 0..1."""
        size = self.wide // 2
        photo = self.on_grid(self.photo[None], size, (self.wide - 1) / (self.grid - 1))
        pixels = np.ascontiguousarray((255 * photo[0]).byte().permute(1, 2, 0).cpu().numpy())
        across = (torch.arange(self.wide) - (self.wide - 1) / 2).to(photo) / (self.grid / 2)
        radius, column = torch.hypot(across, across[:, None]), across.abs().expand(self.wide, -1)
        sure = (radius < SURE) & (_facing(points)[0] > FACING[1])
        start = torch.stack((sure, (radius < LIKELY[0]) | (column < LIKELY[1])))[None].to(photo)
        sure, likely = (interpolate(self._warped(start, own).image, (size, size)) > 0.5)[0].cpu().numpy()
        labels = np.select((sure, likely), (cv2.GC_FGD, cv2.GC_PR_FGD), cv2.GC_PR_BGD).astype(np.uint8)
        if sure.any() and not likely.all():
            cv2.setRNGSeed(0)
            back, front = np.zeros((2, 1, 65))  # of GrabCut's own
            cv2.grabCut(pixels, labels, (0, 0, 1, 1), back, front, 3, cv2.GC_INIT_WITH_MASK)
        result = torch.from_numpy(labels & 1).to(photo)[None, None]
        result = _ramp(avg_pool2d(result, 5, stride=1, padding=2, count_include_pad=False), 0.3, 0.8)
        return look_up(interpolate(result, (self.wide,) * 2, mode="bilinear"), self._place)


def _square(along: Tensor) -> Float[Tensor, "1 k k 2"]:
    """Points (across, down) of a square grid."""
    return torch.stack(torch.meshgrid(along, along, indexing="xy"), dim=-1)[None]


def _ratio(shading: Tensor, before: Tensor) -> Tensor:
    """New shading over old, kept within bounds."""
    ratio = shading.clamp(min=LEAST_SHADING) / before.clamp(min=LEAST_SHADING)
    return ratio.clamp(1 / LARGEST_RATIO, LARGEST_RATIO)


def _veiled(image: Tensor, veil: Tensor) -> Tensor:
    """A surface's image behind what `Renderer.veil` found, if anything."""
    return image * (1 - veil[:, :1]) + veil[:, 1:] if veil.shape[1] else image


def _cleared(image: Tensor, veil: Tensor) -> Tensor:
    return (image - veil[:, 1:]) / (1 - veil[:, :1]).clamp(min=DARKEST) if veil.shape[1] else image


def _facing(points: Float[Tensor, "n h w 3"]) -> Float[Tensor, "n h w"]:
    """Cosine between the moved surface and the ray to it; negative where it is seen from behind."""
    along_u, along_v = torch.gradient(points, dim=2)[0], torch.gradient(points, dim=1)[0]
    normal = torch.linalg.cross(along_u, along_v)
    return (normal * points).sum(dim=-1) / (normal.norm(dim=-1) * points.norm(dim=-1)).clamp(min=1e-12)


def _over_exposed(photo: Float[Tensor, "1 3 s s"], span: float) -> Float[Tensor, "1 3 s s"]:
    """By how much channels would exceed 1, in the object's colours around, where they are over-exposed.

    What is left of a pixel's channels says how bright that colour is; where none is, it is the least that
    explains them. The crop that the model was given is the middle 1 / ``span`` of the photo's side.
    """
    clipped = _ramp(photo, *CLIPPED)
    if not bool(clipped.any()):
        return clipped
    across = torch.linspace(-span, span, photo.shape[-1]).to(photo)
    weight = _ramp(-torch.hypot(across, across[:, None]), -2 * SURE, -SURE)
    weight = weight * (1 - clipped.amax(dim=1, keepdim=True)) * photo.mean(dim=1, keepdim=True) ** 3
    mean = (weight * photo).sum(dim=(2, 3), keepdim=True) / weight.sum().clamp(min=DARKEST)
    near = _blurred(torch.cat((weight * photo, weight), dim=1), COLOUR_SHARE * photo.shape[-1] / span)
    colour = ((near[:, :3] + FEW * mean) / (near[:, 3:] + FEW)).clamp(min=DARKEST)
    brightest = colour.amax(dim=1, keepdim=True)
    brighter = colour * (photo / colour).amax(dim=1, keepdim=True)
    return clipped * _ramp(brightest, *BRIGHT) * (brighter - photo).clamp(0, 1)


def _ramp(value: Tensor, low: float, high: float) -> Tensor:
    return ((value - low) / (high - low)).clamp(0, 1)


def _blurred(maps: Tensor, reach: float) -> Tensor:
    """Three box filters of so many pixels to either side, on a quarter of the resolution."""
    return interpolate(_averaged(_small(maps), max(1, round(reach / 4))), maps.shape[-2:], mode="bilinear")


def smooth(maps: Tensor, weight: Float[Tensor, "n 1 h w"], reach: float) -> Tensor:
    """The weighted mean around each pixel, as ``_blurred``."""
    known = _small(weight)
    sums = _averaged(torch.cat((known * _small(maps), known), dim=1), max(1, round(reach / 4)))
    return interpolate(sums[:, :-1] / sums[:, -1:].clamp(min=DARKEST), maps.shape[-2:], mode="bilinear")


def _small(maps: Tensor) -> Tensor:
    return interpolate(maps, [max(1, side // 4) for side in maps.shape[-2:]], mode="area")


def _averaged(maps: Tensor, reach: int) -> Tensor:
    """Three box filters of so many pixels to either side."""
    for _ in range(3):
        maps = avg_pool2d(pad(maps, (reach,) * 4, mode="replicate"), (2 * reach + 1, 1), stride=1)
        maps = avg_pool2d(maps, (1, 2 * reach + 1), stride=1)
    return maps


def _filled(maps: Tensor, known: Float[Tensor, "n 1 h w"]) -> Tensor:
    """Maps times what is known of them (0..1), the rest filled smoothly from coarser and coarser averages."""
    if min(maps.shape[-2:]) < 4:
        return maps / known.clamp(min=1e-6)
    coarse, coarse_known = (interpolate(field, scale_factor=0.5, mode="area") for field in (maps, known))
    scale = coarse_known.clamp(min=1e-6)
    coarse = _filled(coarse / scale * (coarse_known > 0), (coarse_known > 0).to(maps))
    return maps + (1 - known) * interpolate(coarse, maps.shape[-2:], mode="bilinear")
