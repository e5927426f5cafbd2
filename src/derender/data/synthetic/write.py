"""Write synthetic pictures in the layout of the rendered data sets, truth maps included.

``images/NNNNNN.jpg`` (JPEG quality 92, 4:4:4), ``params.csv`` (degrees), ``identities.csv``, and with truth
``depth/`` (16 bit, z = 0.8 + value/65535*0.4, 0 = background), ``normal/`` (round((n+1)/2*255)),
``albedo/`` and ``mask/`` as PNG. The column ``expr_weights`` of the morphable-model sets has no counterpart
here.
"""

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from numpy import ndarray
from PIL import Image

from derender.data.synthetic.synthetic_set import SyntheticSet, camera_rotation_and_light

DEPTH_LOW, DEPTH_SPAN = 0.8, 0.4


def write(synthetic: SyntheticSet, folder: Path | str, truth: bool = True) -> Path:
    """Write the set into ``folder`` (made if missing, refused if it holds a set) and return that folder."""
    folder = Path(folder)
    if (folder / "params.csv").exists():
        raise ValueError(f"{folder} already holds a set (params.csv): choose another folder or delete it")
    maps = ("depth", "normal", "albedo", "mask") if truth else ()
    for name in ("images", *maps):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for i in range(len(synthetic)):
        picture = Image.fromarray(synthetic.images[i].transpose(1, 2, 0))
        picture.save(folder / "images" / f"{i:06d}.jpg", quality=92, subsampling=0)
        if truth:
            mask = synthetic.mask[i]
            encoded = {
                "depth": encode_depth(synthetic.depth[i]),
                "normal": encode_normal(synthetic.normal[i]) * mask[..., None],
                "albedo": synthetic.albedo[i].transpose(1, 2, 0),
                "mask": mask.astype(np.uint8) * 255,
            }
            for name, pixels in encoded.items():
                Image.fromarray(np.ascontiguousarray(pixels)).save(folder / name / f"{i:06d}.png")
    _write_table(folder / "params.csv", [_parameters(synthetic, i) for i in range(len(synthetic))])
    _write_table(folder / "identities.csv", _identities(synthetic))
    return folder


def encode_depth(depth: Float32[ndarray, "*shape"]) -> UInt16[ndarray, "*shape"]:
    """16-bit code of z in 0.8..1.2; 0 stays 0 and means background."""
    code = np.round((depth.astype(np.float64) - DEPTH_LOW) / DEPTH_SPAN * 65535)
    return np.where(depth > 0, np.clip(code, 1, 65535), 0).astype(np.uint16)


def encode_normal(normal: Float32[ndarray, "*shape 3"]) -> UInt8[ndarray, "*shape 3"]:
    """8-bit code of unit vectors."""
    return np.round((normal.astype(np.float64) + 1.0) / 2.0 * 255).astype(np.uint8)


def _parameters(synthetic: SyntheticSet, i: int) -> dict[str, str]:
    ambient, diffuse, light_pitch, light_yaw = synthetic.light[i].astype(float)
    pitch, yaw, roll, tx, ty, _ = synthetic.camera[i].astype(float)
    rotation, direction = camera_rotation_and_light(synthetic.camera[i : i + 1], synthetic.light[i : i + 1])
    seen, light = direction[0], rotation[0].T @ direction[0]
    degrees = {
        "light_pitch": light_pitch, "light_yaw": light_yaw,
        "lx": light[0], "ly": light[1], "lz": light[2],
        "light_pitch_cam": np.arctan2(seen[1], seen[2]), "light_yaw_cam": np.arctan2(seen[0], seen[2]),
        "lx_cam": seen[0], "ly_cam": seen[1], "lz_cam": seen[2],
        "pitch": pitch, "yaw": yaw, "roll": roll, "tx": tx, "ty": ty,
    }  # fmt: skip
    angles = {"light_pitch", "light_yaw", "light_pitch_cam", "light_yaw_cam", "pitch", "yaw", "roll"}
    return {
        "file": f"images/{i:06d}.jpg",
        "identity": str(int(synthetic.identity[i])),
        "expression": str(synthetic.expression[i]),
        "strength": f"{synthetic.strength[i]:.4f}",
        "ambient": f"{ambient:.6f}",
        "diffuse": f"{diffuse:.6f}",
        **{name: f"{np.rad2deg(value) if name in angles else value:.6f}" for name, value in degrees.items()},
    }


def _identities(synthetic: SyntheticSet) -> list[dict[str, str]]:
    numbers, rows = np.unique(synthetic.identity, return_index=True)
    traits = synthetic.identity_traits
    return [
        {"identity": str(int(n)), **{name: f"{values[i]:.5f}" for name, values in traits.items()}}
        for n, i in zip(numbers, rows, strict=True)
    ]


def _write_table(path: Path, rows: list[dict[str, str]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
