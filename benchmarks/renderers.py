"""Renderers that know an effect beside ``lambert``, which does not: on generated faces and Extended Yale B.

    python benchmarks/renderers.py fit --json benchmarks/results/renderers_fit.json
    python benchmarks/renderers.py train --json benchmarks/results/renderers_train.json
    python benchmarks/renderers.py yale --zip yaleb.zip --json benchmarks/results/renderers_yaleb.json

For each effect (cast shadows, gloss, three lamps, haze) there is a set of generated faces with it and one
without. ``train`` trains ``small`` on each with ``lambert`` and with the renderer that knows the effect, on
the same images, from the same seed, and scores people whom it has not seen. ``fit`` needs no training: scenes
are fitted per image, within the morphable maps of the bundled ``rendered-faces-64``. Scores: normals
(degrees), albedo (mean absolute error over the mean, after one scale per image; the same of chromaticity),
reconstruction (masked L1), and the effect's own numbers (Spearman correlation; median error, also after the
best line, and of the best constant). ``yale`` fits real faces within ``faces-64``: residual by the angle of
the light, and the light's azimuth and elevation. ``speed`` takes processor time of each renderer. A cell that
the file holds is not computed again; it is written after each.
"""

import argparse
import json
import math
import re
import tempfile
import time
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import parser, publish
from PIL import Image
from scipy.stats import spearmanr

import derender
from derender.data import ImageSet
from derender.data.synthetic import FaceSettings, faces
from derender.model import Derenderer
from derender.networks import Factor, NetworkSettings
from derender.objectives.reconstruction import masked_l1
from derender.renderers import Renderer, renderer_named
from derender.scene import Scene
from derender.scene.camera import rotation_matrix
from derender.scene.light import light_direction
from derender.scene.normals import normals_from_depth
from derender.training.config import resolve
from derender.training.derender_task import train

MAPS = ("depth", "albedo")
LIGHT = {"yaw_deg": [-60, 60], "pitch_deg": [-30, 45], "ambient": [0.1, 0.3], "diffuse": [0.6, 0.9]}
EFFECTS: dict[str, tuple[str, dict[str, Any]]] = {
    "none": ("lambert", {}),
    "shadows": ("lambert-shadow", {"shadows": True}),
    "gloss": ("phong", {"gloss": [0.0, 0.5], "exponent": [4, 64]}),
    "lamps": ("sh", {"lamps": 3}),
    "haze": ("haze", {"haze": [0.3, 4.0], "airlight": [0.5, 1.0]}),
}
NUMBERS = {
    "gloss": ("specular", ("gloss_strength", "gloss_exponent")),
    "haze": ("haze", ("haze_beta", "haze_airlight")),
}
"""The factor that holds an effect's numbers, and the labels that they have in a generated set."""


def cells(protocol: str, seeds: int) -> list[tuple[int, str, str]]:
    """Seed, effect in the set, renderer; all renderers on the set without effects, too."""
    knowing = [name for name, _ in EFFECTS.values()]
    results = []
    for seed in range(seeds):
        for effect, (name, _) in EFFECTS.items():
            results += [(seed, effect, one) for one in (knowing if effect == "none" else ["lambert", name])]
    if protocol == "train":  # a fit has no such term
        results += [(seed, "gloss", "phong(mean_diffuse=1.0)") for seed in range(seeds)]
    return results


def generated(effect: str, seed: int, count: int, size: int, first: int) -> Any:
    """Generated faces with one effect; ``first`` is the number of the first person."""
    settings = {"effects": EFFECTS[effect][1], "light": LIGHT, "first_identity": first}
    return faces.generate(count, size, seed, FaceSettings.model_validate(settings))


def trained(effect: str, renderer: str, seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """Train one cell and score it on people whom it has not seen."""
    made = generated(effect, seed, given.count, given.size, 0)
    images = ImageSet(made.images, tuple(f"{index:05d}.png" for index in range(given.count)))
    config = resolve(
        "small", [f"images={given.images}", f"seed={seed}", f"image_size={given.size}", "perceptual=none",
                  f"validate_every={given.images}", f"sample_every={given.images * 9}", "keep=last",
                  f"checkpoint_every={given.images}", "whitening.pictures=0", "fitting.examples=0",
                  "watch=false"],
        model__renderer=renderer,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        train(config, images, Path(folder) / "run", accelerator="cpu")
        model = derender.load(Path(folder) / "run")
    truth = generated(effect, seed, given.unseen, given.size, 100_000)
    with torch.inference_mode():
        scene = model.decompose(torch.from_numpy(truth.images).float() / 255)
    return scores(scene, model.renderer, truth, effect)


def fitted_cell(effect: str, renderer: str, seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """Fit scenes to generated faces, and score them."""
    model, drawn = derender.load("rendered-faces-64"), renderer_named(renderer)
    truth = generated(effect, seed, given.unseen, 64, 100_000)
    images = torch.from_numpy(truth.images).float() / 255
    result = Scene.joined([fitted(model, drawn, batch, given.steps) for batch in images.split(32)])
    return scores(result, drawn, truth, effect)


@torch.inference_mode()
def scores(scene: Scene, drawn: Renderer, truth: Any, effect: str) -> dict[str, float]:
    """Errors of normals, albedo and reconstruction, means over images, inside the true mask."""
    images = torch.from_numpy(truth.images).float() / 255
    shown, white = drawn(scene, 10.0), torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(len(images), 4)
    plain = derender.render.render(scene.depth, scene.albedo, white, scene.camera)
    both = plain.mask * torch.from_numpy(truth.mask)
    normal = normals_from_depth(torch.where(plain.mask > 0, plain.depth, 1.1), 10.0)
    cosine = (normal * torch.from_numpy(truth.normal)).sum(dim=-1).clamp(-1, 1)
    inner = -torch.nn.functional.max_pool2d(-both[:, None], 3, 1, 1)[:, 0]
    results, true, weight = plain.image, torch.from_numpy(truth.albedo).float() / 255, both[:, None]
    scale = (results * true * weight).sum((1, 2, 3)) / (results.square() * weight).sum((1, 2, 3)).clamp(
        min=1e-6
    )
    albedo = _mean((scale[:, None, None, None] * results - true).abs().mean(1), both) / _mean(
        true.mean(1), both
    )
    chroma = [value / value.sum(1, keepdim=True).clamp(min=0.05) for value in (results, true)]
    result = {
        "normal_deg": float(_mean(torch.rad2deg(cosine.acos()), inner).mean()),
        "albedo": float(albedo.mean()),
        "albedo_chroma": float(_mean((chroma[0] - chroma[1]).abs().mean(1), both).mean()),
        "l1": float(masked_l1(shown.image, images, shown.mask)),
    }
    if effect in NUMBERS and NUMBERS[effect][0] in scene.extra:
        factor, labels = NUMBERS[effect]
        for name, values in zip(labels, scene.extra[factor].T.numpy(), strict=True):
            wanted = truth.labels[name].astype(float)
            line = np.polynomial.Polynomial.fit(values, wanted, 1)(values) if np.ptp(values) > 0 else values
            result[f"{name}_spearman"] = float(spearmanr(values, wanted).statistic)
            for kind, guess in (("", values), ("_of_line", line), ("_of_constant", np.median(wanted))):
                result[f"{name}_median_error{kind}"] = float(np.median(np.abs(guess - wanted)))
    return result


def _mean(values: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    return (values * weight).sum(dim=(1, 2)) / weight.sum(dim=(1, 2)).clamp(min=1)


def yale(renderer: str, given: argparse.Namespace) -> dict[str, Any]:
    """Fit scenes of the bundled face model, drawn by a renderer, to faces under known lights."""
    name, images, lights = re.compile(r"yaleB\d+_P00A([+-]\d+)E([+-]\d+)"), [], []
    with zipfile.ZipFile(given.zip) as archive:
        for member in [one for one in sorted(archive.namelist()) if name.search(one)][:: given.every]:
            grey = np.asarray(Image.open(BytesIO(archive.read(member))).convert("L"))
            square = Image.fromarray(np.pad(grey, ((14, 14), (20, 20)), mode="edge"))
            images.append(np.asarray(square.resize((64, 64), Image.Resampling.LANCZOS)))
            match = name.search(member)
            assert match is not None
            lights.append([float(part) for part in match.groups()])
    pixels = torch.from_numpy(np.stack(images)).float()[:, None].expand(-1, 3, -1, -1) / 255
    model, drawn = derender.load("faces-64"), renderer_named(renderer)
    scene = Scene.joined([fitted(model, drawn, batch, given.steps) for batch in pixels.split(32)])
    again = drawn(scene, model.fov_deg)
    error = _mean((again.image - pixels).abs().mean(dim=1), again.mask).numpy()
    direction = (rotation_matrix(scene.camera[:, :3]) @ light_direction(scene.light)[:, :, None])[..., 0]
    x, y, z = direction.numpy().T
    (azimuth, elevation), results = np.array(lights).T, np.degrees([np.arctan2(x, z), np.arcsin(y)])
    angle = np.degrees(np.arccos(np.cos(np.radians(azimuth)) * np.cos(np.radians(elevation))))
    result: dict[str, Any] = {"images": len(error)}
    for low, high in ((0, 25), (25, 50), (50, 77.5)):
        rows = (angle >= low) & (angle < high)
        result |= {f"residual_{low}_{high:.0f}": float(error[rows].mean()), f"n_{low}": int(rows.sum())}
    rows = angle < 77.5
    for kind, wanted, values in (("azimuth", azimuth, results[0]), ("elevation", elevation, results[1])):
        result[f"{kind}_correlation"] = float(np.corrcoef(values[rows], wanted[rows])[0, 1])
        result[f"{kind}_mean_error_deg"] = float(np.abs(values - wanted)[rows].mean())
    return result


def fitted(model: Derenderer, drawn: Renderer, images: torch.Tensor, steps: int) -> Scene:
    """Scenes fitted by so many Adam steps: maps within the model's morphable ones, all the rest freely."""
    maps, start = model.features.required_fitting().maps, model.decompose(images)
    moved = {name: maps.coordinates(name, start.parameters[name]).clamp(-2.5, 2.5) for name in MAPS}
    moved |= {"light": start.light.clone(), "rotation": start.camera[:, :3], "shift": start.camera[:, 3:]}
    moved |= {row.name: torch.zeros(len(images), row_size(row)) for row in drawn.factors}
    rates = {"depth": 0.1, "albedo": 0.1, "light": 0.03, "rotation": 0.01, "shift": 0.003}
    moved = {name: value.clone().requires_grad_() for name, value in moved.items()}
    optimiser = torch.optim.Adam(
        [{"params": [value], "lr": rates.get(name, 0.05)} for name, value in moved.items()], betas=(0.9, 0.95)
    )

    def scene() -> Scene:
        depth, albedo = (maps.maps(name, moved[name]) for name in MAPS)
        values = {"depth": depth, "albedo": albedo.clamp(0, 1), "light": moved["light"]}
        values["camera"] = torch.cat([moved["rotation"], moved["shift"]], dim=1)
        for row in drawn.factors:
            values[row.parameter] = row.to_parameter(moved[row.name].tanh(), model.settings.ranges)
        if "environment" in values:
            del values["light"]
        return Scene.from_parameters(values)

    for step in range(steps):
        if step == round(0.6 * steps):
            for group in optimiser.param_groups:
                group["lr"] *= 0.3
        again = drawn(scene(), model.fov_deg)
        error = _mean((again.image - images).abs().mean(dim=1), again.mask)
        usual = moved["depth"].square().mean(dim=1) + moved["albedo"].square().mean(dim=1)
        optimiser.zero_grad()
        (error / 0.03 + 0.1 * usual).sum().backward()
        optimiser.step()
        with torch.no_grad():
            if not any(row.name == "light" for row in drawn.factors):
                moved["light"][:, :2].clamp_(0.0, 1.2)
                moved["light"][:, 2:].clamp_(-math.radians(80), math.radians(80))
    return scene().detach()


def row_size(row: Factor) -> int:
    """How many raw numbers a factor's network gives."""
    return row.build(NetworkSettings(image_size=32, width=4, light_width=1)).decoder.linear.out_features


def speed(renderer: str, given: argparse.Namespace) -> dict[str, float]:
    """Processor time of 64 scenes of 64 pixels (best of 40), and its median ratio to ``lambert`` in turn."""
    model, drawn = derender.load("faces-64"), (renderer_named("lambert"), renderer_named(renderer))
    start = model.decompose(torch.from_numpy(generated("none", 0, 64, 64, 0).images).float() / 255)
    values = {name: value.clone().requires_grad_() for name, value in start.parameters.items()}
    for row in drawn[1].factors:
        values[row.parameter] = row.to_parameter(torch.zeros(64, row_size(row)), model.settings.ranges)
    scene, times = Scene.from_parameters(values), np.empty((40, 2, 2))
    for turn in times:
        for one, taken in zip(drawn, turn, strict=True):
            began = time.process_time()
            image = one(scene, model.fov_deg).image
            taken[0] = time.process_time() - began
            image.square().sum().backward()
            taken[1] = time.process_time() - began
    best, ratio = 1e3 * times[:, 1].min(axis=0), np.median(times[:, 1] / times[:, 0], axis=0)
    return {
        f"{part}_{what}": round(float(value), 2)
        for what, both in (("ms", best), ("over_lambert", ratio))
        for part, value in zip(("forward", "forward_and_backward"), both, strict=True)
    }


def main() -> None:
    given = parser(__doc__)
    given.add_argument("protocol", choices=("fit", "train", "yale", "speed"))
    given.add_argument("--zip", type=Path, help="yale: the file of CroppedYale")
    given.add_argument("--seeds", type=int, default=3)
    given.add_argument("--effects", nargs="*", help="only these sets; by default all")
    given.add_argument("--size", type=int, default=32, help="train: side of the images, pixels")
    given.add_argument("--count", type=int, default=2000, help="train: generated images of a set")
    given.add_argument("--images", type=int, default=16_000, help="train: images seen, repeats counted")
    given.add_argument("--unseen", type=int, default=96, help="generated images that are scored")
    given.add_argument("--every", type=int, default=6, help="yale: take one image in so many")
    given.add_argument("--steps", type=int, default=80, help="Adam steps of a fit")
    given.add_argument("--minutes", type=float, default=60.0, help="start no cell after so many")
    options = given.parse_args()
    torch.set_num_threads(1)
    began, rows = time.monotonic(), []
    left_out = ("json", "minutes", "seeds", "zip", "effects")
    settings = {name: value for name, value in vars(options).items() if name not in left_out}
    if options.json and options.json.is_file():
        stored = json.loads(options.json.read_text())
        if stored["settings"] != settings:
            raise SystemExit(f"{options.json} was made with {stored['settings']}: choose another file")
        rows = stored["cells"]
    names = ("lambert", "lambert-shadow", "phong", "phong+lambert-shadow", "sh", "haze")
    single = {"yale": (yale, names[:4]), "speed": (speed, names)}.get(options.protocol)
    wanted = cells(options.protocol, options.seeds)
    if single is not None:
        wanted = [(0, options.protocol, name) for name in single[1]]
    for seed, effect, renderer in wanted:
        key = {"seed": seed, "effect": effect, "renderer": renderer}
        if options.effects and effect not in options.effects:
            continue
        if any(key.items() <= row.items() for row in rows) or time.monotonic() - began > options.minutes * 60:
            continue
        before = time.process_time()
        if single is not None:
            done = single[0](renderer, options)
        else:
            done = (trained if options.protocol == "train" else fitted_cell)(effect, renderer, seed, options)
        rows.append({**key, **done, "seconds_cpu": round(time.process_time() - before, 1)})
        print(json.dumps(rows[-1]), flush=True)
        publish({"settings": settings, "cells": rows}, options.json)


if __name__ == "__main__":
    main()
