"""A factor and a renderer of one's own: the white balance of a camera, learnt from unlabelled images.

    python examples/05_new_factor.py --out made          # minutes on a CPU; --images 64000 learns more

A renderer is a ``Renderer`` with the factors it adds and the stages it changes. It is chosen by the name of
this file and of the value, which the model records; keep the file's folder on PYTHONPATH for later commands.
"""

import argparse
from pathlib import Path

import torch

import derender
from derender.data.synthetic import FaceSettings, faces, write
from derender.networks.factors import Number, numbers_factor
from derender.render import Rendering
from derender.renderers import Renderer
from derender.report.decomposition import decompose_images

NAME = "05_new_factor:BALANCE"
WHITE = numbers_factor("white", Number("red", 0.7, 1.4, log=True), Number("blue", 0.7, 1.4, log=True))


def balanced(rendering: Rendering, scene: derender.Scene) -> Rendering:
    """The rendering with the red and the blue channel brighter or darker."""
    red, blue = scene.extra["white"].unbind(1)
    gains = torch.stack([red, red * 0 + 1, blue], dim=1)[:, :, None, None]
    return Rendering(rendering.image * gains, rendering.depth, rendering.mask)


BALANCE = Renderer("balance", (WHITE,), atmosphere=balanced)


def main() -> None:
    parser = argparse.ArgumentParser(description="Train, embed, score and draw with a factor of one's own.")
    parser.add_argument("--out", type=Path, default=Path("made"))
    parser.add_argument("--count", type=int, default=1000, help="generated images")
    parser.add_argument("--images", type=int, default=16_000, help="images seen in training")
    parser.add_argument("--size", type=int, default=64, help="side of the images, pixels")
    given = parser.parse_args()

    write(faces.generate(given.count, given.size, 0, FaceSettings()), given.out / "data")
    settings = {"image_size": given.size, "images": given.images, "perceptual": "none"}  # sooner done
    run = given.out / "run"
    derender.train(
        given.out / "data", out=run, preset="small", renderer=NAME, loocc="light+white", settings=settings
    )
    table = derender.embed(given.out / "data", run)
    print({name: values.shape for name, values in table.factors.items()})
    print(derender.evaluate.disentangle(run, given.out / "data", seeds=[0]).to_markdown())
    model = derender.load(run)
    files = sorted((given.out / "data" / "images").iterdir())[:4]
    decompose_images(model, derender.data.as_batch(files, given.size)).sheet().save(given.out / "sheet.png")
    print(model.decompose(files).extra["white"])


if __name__ == "__main__":
    main()
