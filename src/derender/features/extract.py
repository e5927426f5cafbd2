"""From a model and images to a FeatureTable."""

import hashlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

import derender
from derender.data import ImageSet, Progress, as_float
from derender.features.table import FeatureTable
from derender.training.process import evaluating

T = TypeVar("T")


def model_fingerprint(model: nn.Module) -> str:
    """16 hexadecimal digits that change when a weight or a buffer, its name or its shape changes."""
    digest = hashlib.sha256()
    for name, value in sorted({**model.state_dict(), **dict(model.named_buffers())}.items()):
        array = value.detach().cpu().contiguous()
        digest.update(f"{name} {array.dtype} {tuple(array.shape)}".encode())
        digest.update(array.reshape(-1).view(torch.uint8).numpy())  # pyrefly: ignore[bad-argument-type]
    return digest.hexdigest()[:16]


def map_batches(
    function: Callable[[Tensor], T], model: Any, images: np.ndarray, *, batch_size: int,
    progress: Progress | None = None,
) -> list[T]:  # fmt: skip
    """Results of a function of images in 0..1 on the model's device, batch by batch, without gradients.

    The model is in evaluation mode meanwhile, then as it was. Images are (N, 3, H, W), uint8 or float.
    """
    if batch_size < 1:
        raise ValueError(f"batch_size must be 1 or more, got {batch_size}")
    if len(images) == 0:
        raise ValueError("there are no images")
    results = []
    with evaluating(model), torch.inference_mode():
        for start in range(0, len(images), batch_size):
            results.append(function(as_batch(images[start : start + batch_size], model.device)))
            if progress is not None:
                progress(min(start + batch_size, len(images)), len(images))
    return results


def as_batch(images: np.ndarray, device: torch.device) -> Tensor:
    """Images, uint8 or float in 0..1, as a float32 tensor of 0..1 on a device, channels last for speed."""
    tensor = torch.from_numpy(np.array(images)).to(device)
    batch = as_float(tensor) if tensor.dtype == torch.uint8 else tensor.float()
    return batch.contiguous(memory_format=torch.channels_last)


def factor_codes(model: Any, batch: Tensor) -> dict[str, np.ndarray]:
    """A batch's features by factor, each (n, D) float32."""
    return {name: code.float().cpu().numpy() for name, code in model.embed(batch).items()}


def embed_images(
    model: Any, images: np.ndarray, *, batch_size: int = 256, progress: Progress | None = None
) -> dict[str, np.ndarray]:
    """Features of images (N, 3, H, W), uint8 or float in 0..1, by factor: each (N, D) float32."""
    parts = map_batches(partial(factor_codes, model), model, images, batch_size=batch_size, progress=progress)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def embed_image_set(
    model: Any, images: ImageSet, *, batch_size: int = 256, progress: Progress | None = None,
    origin: Mapping[str, Any] | None = None,
) -> FeatureTable:  # fmt: skip
    """Run a model's encoders over an image set of its size; labels and the owners' split go into the table.

    ``model`` has ``embed(images in 0..1) -> {factor: (N, D)}``, ``device`` and ``image_size``. Facts in
    ``origin``, such as the model's path, win over those found here.
    """
    check_size(model, images.images)
    factors = embed_images(model, images.images, batch_size=batch_size, progress=progress)
    facts = {**model_facts(model, images.source, images.layout), **(origin or {})}
    return FeatureTable(images.files, factors, table_labels(images), facts)


def check_size(model: Any, images: np.ndarray, *, rendered: bool = False) -> None:
    """Images (N, 3, H, W) of another size than the model's are an error; a ``rendered`` set has one size."""
    size, (height, width) = model.image_size, images.shape[-2:]
    if (height, width) != (size, size):
        how = f"render the set at that size (derender synth ... --image-size {size}), or give another model"
        how = how if rendered else f"read them with image_size={size}"
        raise ValueError(f"the images are {height}x{width}, the model takes {size}x{size}: {how}")


def model_facts(model: Any, source: str, layout: str) -> dict[str, Any]:
    """What a table's origin says: version, model, weights, data."""
    facts: dict[str, Any] = {"derender": derender.__version__, "model": type(model).__name__}
    facts |= {"weights": model_fingerprint(model), "data": source, "layout": layout}
    if getattr(model, "fitting", None) is not None:
        facts["fit_steps"] = model.fitting.settings.steps
    if hasattr(model, "settings"):
        facts["settings"] = model.settings.model_dump(mode="json")
    return facts


def table_labels(images: Any) -> dict[str, np.ndarray]:
    """An image set's labels, and the owners' split as one more label ``partition`` where there is one."""
    return ({} if images.partition is None else {"partition": images.partition}) | dict(images.labels)
