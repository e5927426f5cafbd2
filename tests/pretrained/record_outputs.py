"""Outputs of the shipped models on generated images; run as a script, it records them.

Record again only where a shipped model is exchanged on purpose: test_outputs.py compares every change of the
code with the recorded files. Maps are stored at every fourth pixel.
"""

from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file

import derender
from derender.data.synthetic import cars, faces

FOLDER = Path(__file__).with_name("outputs")
PICTURES = dict.fromkeys(("faces-64", "faces-128", "rendered-faces-64", "rendered-faces-128"), faces.generate)
PICTURES["cars-64"] = cars.generate
COUNT, SEED, STRIDE, FIT_STEPS = 3, 7, 4, 2
ENCODED = {"rendered-faces-64": 192}  # columns of features before the coordinates of fitted scenes


def pictures_of(name: str) -> torch.Tensor:
    """(3, 3, S, S) in 0..1: generated images of the model's kind of object, at its size."""
    images = PICTURES[name](COUNT, int(name.rsplit("-")[-1]), seed=SEED).images
    return torch.from_numpy(np.ascontiguousarray(images)).float() / 255


def outputs_of(name: str) -> dict[str, np.ndarray]:
    """Codes, features, scene, renderings and a short fit of one shipped model, by name."""
    model = derender.load(name)
    images = pictures_of(name)
    scene = model.decompose(images)
    relit = scene.with_parameters(light=scene.light.flip(0), camera=scene.camera.flip(0))
    result = {f"code.{key}": value for key, value in model.encode(images).items()}
    # Coordinates of fitted scenes are left out: 60 steps magnify rounding.
    plain = model.with_features(model.features.with_steps(0))
    result |= {f"feature.{key}": value[:, : ENCODED.get(name)] for key, value in plain.embed(images).items()}
    result |= {f"scene.{key}": _thinned(value) for key, value in scene.parameters.items()}
    for what, one in (("rendered", scene), ("moved", relit)):
        drawn = model.render(one)
        maps = {key: getattr(drawn, key).float() for key in ("image", "depth", "mask")}
        result |= {f"{what}.{key}": _thinned(value) for key, value in maps.items()}
    if model.fitting is not None:
        fitted = model.fit_scenes(images, FIT_STEPS)
        result |= {f"fitted.{key}": _thinned(value) for key, value in fitted.scene.parameters.items()}
    return {key: np.ascontiguousarray(value.detach().numpy(), np.float32) for key, value in result.items()}


def _thinned(value: torch.Tensor) -> torch.Tensor:
    return value[..., ::STRIDE, ::STRIDE] if value.ndim > 2 else value


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name in PICTURES:
        save_file({"pictures": pictures_of(name).numpy()[..., ::8, ::8].copy(), **outputs_of(name)},
                  FOLDER / f"{name}.safetensors")  # fmt: skip
