"""Trains the network that tells how far a face is turned to the side (derender.photo.faces), and scores it.

Generated heads from -89 to 89 degrees, under ordinary and strong light, are cut out in the boxes of MTCNN;
of LFW come the crops of the development half, with the yaw of a face mesh (``--lfw``, ``--points``). Scored
are heads of other people and LFW's other half, both as ``derender.photo.face_candidates`` finds them.

    .venv/bin/python benchmarks/yaw.py --lfw lfw128.zip --points lfw128_facemesh.npz \\
        --json benchmarks/results/yaw.json [--weights src/derender/photo/yaw.safetensors]
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import parser, publish
from torch import Tensor
from torch.nn.functional import affine_grid, avg_pool2d, grid_sample, interpolate, smooth_l1_loss

from derender.data import open_source
from derender.data.image import decode_whole
from derender.data.layouts.layout import in_test_half
from derender.data.synthetic import FaceSettings, faces
from derender.photo import Frame, face_candidates
from derender.photo.faces import (
    PROFILE_DEG,
    YAW_CROP,
    YAW_CROP_SIDE,
    YAW_SCALE_DEG,
    _detected,
    standardised,
    yaw_network,
)
from derender.storage.tensors import write_tensors

WIDE = 1.5  # crops that views are drawn from, over the network's
MARGIN = 40  # pixels of continued border around a crop
BATCH, REAL = 64, 16
STRONG = {
    "light": {"yaw_deg": [-75, 75], "pitch_deg": [-60, 60], "ambient": [0.05, 0.7], "diffuse": [0.2, 0.9]},
    "effects": {"gloss": [0, 0.4], "shadows": True},
}


def heads(count: int, seed: int, size: int, yaw_deg: Sequence[float], **light: Any) -> Iterator[tuple]:
    """Generated photographs (H, W, 3) of as many people, with their yaw in degrees."""
    view = {"yaw_deg": list(yaw_deg), "yaw_sd_deg": None, "pitch_deg": [-25, 25], "pitch_sd_deg": 10}
    settings = {"view": view, "pictures_per_identity": 1, "first_identity": 1000 * seed, **light}
    made = faces.generate(count, size, seed, FaceSettings.model_validate(settings))
    for pixels, camera in zip(made.images, made.camera, strict=True):
        yield bordered(pixels.transpose(1, 2, 0)), float(np.degrees(camera[1]))


def bordered(pixels: np.ndarray) -> np.ndarray:
    return np.pad(pixels, ((MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0)), mode="edge")


def people(lfw: Path, points: Path, test: bool) -> Iterator[tuple]:
    """LFW's crops of one half of the people, with the yaw of a face mesh in degrees."""
    mesh, source = np.load(points), open_source(lfw)
    yaws = {Path(str(name)).name: float(yaw) for name, yaw in zip(mesh["name"], mesh["yaw"], strict=True)}
    for file in source.files:
        name = Path(file)
        if name.name in yaws and in_test_half(name.parent.name) == test:
            yield bordered(decode_whole(source.read(file))), yaws[name.name]


def cut(photographs: Iterator[tuple]) -> tuple[Tensor, Tensor]:
    """Crops of the surest faces, wider than the network's, and their yaws; pictures without are left out."""
    crops, yaws = [], []
    for pixels, yaw in photographs:
        face = max(_detected(pixels), key=lambda face: face.confidence, default=None)
        if face is not None:
            left, top, right, bottom = face.box
            side = WIDE * YAW_CROP_SIDE * max(right - left, bottom - top)
            frame = Frame((left + right) / 2, (top + bottom) / 2, side)
            crops.append(frame.cut(pixels, round(WIDE * YAW_CROP)))
            yaws.append(yaw)
    return torch.from_numpy(np.stack(crops)), torch.tensor(yaws)


def views(crops: Tensor) -> Tensor:
    """Of each crop a part of another scale, place, roll and contrast, noisy, and some of them blurred."""
    count = len(crops)
    scale = (1 + 0.12 * torch.randn(count).clamp(-2, 2)) / WIDE
    roll, moved = 0.12 * torch.randn(count).clamp(-2, 2), 0.06 * torch.randn(count, 2)
    across, down = scale * roll.cos(), scale * roll.sin()
    rows = torch.stack([across, -down, moved[:, 0], down, across, moved[:, 1]], dim=1).view(-1, 2, 3)
    grid = affine_grid(rows, [count, 3, YAW_CROP, YAW_CROP], align_corners=False)
    result = grid_sample(crops.float() / 255, grid, align_corners=False, padding_mode="border")
    if torch.rand(1) < 0.3:
        result = interpolate(avg_pool2d(result, 2), scale_factor=2, mode="bilinear")
    result = result.clamp(1e-3, 1) ** torch.exp(0.4 * torch.randn(count, 1, 1, 1))
    result = result + 0.04 * torch.rand(count, 1, 1, 1) * torch.randn_like(result[:, :1])
    return (255 * result.clamp(0, 1)).byte()


def trained(sets: list[tuple[Tensor, Tensor]], sizes: list[int], steps: int) -> torch.nn.Sequential:
    """The network after so many steps, each on ``sizes`` crops of every set."""
    torch.manual_seed(0)
    network = yaw_network()
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-2)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = 1e-3 * min(1, (step + 1) / 200) * (1 + np.cos(np.pi * step / steps))
        chosen = [torch.randint(len(yaws), (size,)) for (_, yaws), size in zip(sets, sizes, strict=True)]
        pairs = list(zip(sets, chosen, strict=True))
        crops = torch.cat([crops[rows] for (crops, _), rows in pairs])
        yaws = torch.cat([yaws[rows] for (_, yaws), rows in pairs]) / YAW_SCALE_DEG
        mirrored = torch.rand(len(yaws)) < 0.5
        crops = torch.where(mirrored[:, None, None, None], crops.flip(-1), crops)
        predicted = network(standardised(views(crops)))[:, 0]
        loss = smooth_l1_loss(predicted, torch.where(mirrored, -yaws, yaws), beta=0.15)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step % 500 == 0:
            print(f"step {step:,} of {steps:,}: {loss.item():.4f}", flush=True)
    return network


def scored(photographs: Iterator[tuple]) -> dict[str, Any]:
    """Errors of yaw of the largest candidates, and the share that counts as profiles or as no face."""
    rows = []
    for pixels, yaw in photographs:
        face = next(iter(face_candidates(pixels)), None)
        rows.append((yaw, np.nan if face is None or face.rejected else face.yaw_deg))
    yaws, measured = np.array(rows).T
    errors = np.abs(measured - yaws)
    return {
        "pictures": len(rows),
        "no_face": float(np.isnan(measured).mean()),
        "profile": float((np.abs(measured) > PROFILE_DEG).mean()),
        "error_deg": float(np.nanmean(errors)) if np.isfinite(errors).any() else None,
        "error_90_deg": float(np.nanquantile(errors, 0.9)) if np.isfinite(errors).any() else None,
    }


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--lfw", type=Path, required=True)
    options.add_argument("--points", type=Path, required=True)
    options.add_argument("--weights", type=Path, help="train, and write the weights here")
    options.add_argument("--heads", type=int, default=18_000, help="generated for training")
    options.add_argument("--steps", type=int, default=8_000)
    options.add_argument("--people", type=int, default=60, help="heads for each score")
    chosen = options.parse_args()
    if chosen.weights is not None:
        lights = [{}, STRONG]
        numbers = range(200, 200 + chosen.heads // 200)
        made = (head for seed in numbers for head in heads(200, seed, 128, (-89, 89), **lights[seed % 2]))
        sets = [cut(made), cut(people(chosen.lfw, chosen.points, test=False))]
        print(f"{len(sets[0][1]):,} generated crops, {len(sets[1][1]):,} of LFW", flush=True)
        network = trained(sets, [BATCH, REAL], chosen.steps)
        write_tensors({name: value.half() for name, value in network.state_dict().items()}, chosen.weights)
    result = {}
    for at in range(0, 90, 15):
        sides = [(900 + at, at - 3, at + 3), (901 + at, -at - 3, -at + 3)]
        made = (head for seed, *ends in sides for head in heads(chosen.people // 2, seed, 256, ends))
        result[f"heads at {at} degrees"] = scored(made)
    result["LFW, test half"] = scored(people(chosen.lfw, chosen.points, test=True))
    for name, row in result.items():
        print(name, row)
    publish(result, chosen.json)


if __name__ == "__main__":
    main()
