"""How sharp reconstructions at 128 pixels are: a model grown to that size beside the one it grew from.

Images are 250 of the test half of the grown model's test part. The smaller model sees them reduced to 64
pixels; its scene is drawn at 128, or its rendering enlarged. The control is the image itself, reduced and
enlarged. Distances of features are means of squared differences (`perceptual_loss`): of a network that this
command trains on the training part, and of VGG16. The gradient ratio is the mean length of the gradient of
grey values over that of the image. All inside the grown model's mask.

    python benchmarks/sharpness.py utkface128.zip --vgg16 vgg16.npz --json benchmarks/results/sharpness.json
"""

from collections.abc import Callable

import torch
from machine import parser, publish
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

import derender
from derender.data.layouts.layout import in_test_half
from derender.evaluation.pixels import masked_ssim
from derender.inputs import as_images
from derender.objectives.perceptual import load_vgg16, perceptual_loss
from derender.objectives.self_features import train_self_features
from derender.scene.enlarge import at_size

COUNT, BATCH = 250, 25


def slopes(images: Tensor) -> Tensor:
    """Length of the gradient of grey values, without the last row and column."""
    grey = images.mean(dim=1)
    return torch.hypot(grey[:, :-1, 1:] - grey[:, :-1, :-1], grey[:, 1:, :-1] - grey[:, :-1, :-1])


def enlarged(images: Tensor) -> Tensor:
    return interpolate(images, scale_factor=2, mode="bicubic", align_corners=False).clamp(0, 1)


@torch.no_grad()
def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("images", help="UTKFace at 128 pixels")
    asks.add_argument("--grown", default="faces-128")
    asks.add_argument("--smaller", default="faces-64")
    asks.add_argument("--vgg16", help="weights; by default in torch hub's cache")
    asks.add_argument("--steps", type=int, default=1500, help="training of the features")
    options = asks.parse_args()
    grown, smaller = (derender.load(name) for name in (options.grown, options.smaller))
    read = as_images(options.images, grown.image_size, part="test", model=options.grown)
    rows = [place for place, file in enumerate(read.files) if in_test_half(file)][:COUNT]
    images = torch.from_numpy(read.images[rows]).float() / 255
    known = torch.from_numpy(as_images(options.images, 128, part="train", model=options.grown).images)
    with torch.enable_grad():
        own = train_self_features(known, seed=0, steps=options.steps)
    features = {"learned features": own, "VGG16": load_vgg16(options.vgg16).calibrate_(images)}

    def at_128(batch: Tensor) -> Tensor:
        return smaller.render(at_size(smaller.decompose(avg_pool2d(batch, 2)), grown.image_size)).image

    methods: dict[str, Callable[[Tensor], Tensor]] = {
        f"`{options.grown}`": lambda batch: grown.reconstruct(batch).image,
        f"`{options.smaller}`, scene drawn at 128": at_128,
        f"`{options.smaller}`, rendering enlarged": lambda b: enlarged(
            smaller.reconstruct(avg_pool2d(b, 2)).image
        ),
        "image reduced to 64 and enlarged (control)": lambda batch: enlarged(avg_pool2d(batch, 2)),
    }
    sums: dict[str, dict[str, float]] = {name: {} for name in methods}
    for batch in images.split(BATCH):
        mask = grown.reconstruct(batch).mask
        weight, area = mask[:, None], 3 * mask.sum()
        for name, method in methods.items():
            drawn = method(batch)
            shown = torch.where(weight > 0, drawn, batch)
            scores = {
                "L1": float(((drawn - batch).abs() * weight).sum() / area),
                "SSIM": float(masked_ssim(drawn, batch, mask).mean()),
            }
            for key, net in features.items():
                scores[key] = float(perceptual_loss(net(shown), net(batch), mask, None))
            steep, true = (float((slopes(one) * mask[:, :-1, :-1]).sum()) for one in (drawn, batch))
            scores["gradient ratio"] = steep / true
            for key, value in scores.items():
                sums[name][key] = sums[name].get(key, 0.0) + value * len(batch) / len(images)
    for name, row in sums.items():
        print(name, {key: round(value, 4) for key, value in row.items()})
    publish({"benchmark": "sharpness", "images": len(images), "rows": sums}, options.json)


if __name__ == "__main__":
    main()
