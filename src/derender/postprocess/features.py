"""How features are made of encoder activations: one frozen value, with which a model is loaded or not."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from derender.postprocess.fitting import Fitting, coordinates_of
from derender.postprocess.whitening import Whitening
from derender.storage.places import FITTING_FILE, WHITENING_FILE


@dataclass(frozen=True)
class Features:
    """Post-processing of encoder activations: without whitening a feature is the encoder output (the code).

    Coordinates of scenes that the fitting finds follow, unless it makes 0 steps.
    """

    whitening: Whitening | None = None
    fitting: Fitting | None = None

    @property
    def fits_scenes(self) -> bool:
        """Whether features hold coordinates of fitted scenes."""
        return self.fitting is not None and self.fitting.settings.steps > 0

    def mirrors(self, factor: str) -> bool:
        """Whether a factor's feature is made of an image and of its mirror image."""
        return self.whitening is not None and factor in self.whitening.mirrored

    def __call__(
        self, codes: Mapping[str, Float[Tensor, "n code"]], activations: Mapping[str, Float[Tensor, "n _"]]
    ) -> dict[str, Float[Tensor, "n _"]]:
        """Features by factor, of encoder outputs and activations; codes alone may be a ValueError."""
        features = {**codes, **(self.whitening(activations) if self.whitening is not None else {})}
        if self.fitting is not None:
            for name in [name for name in features if coordinates_of(name) in activations]:
                fitted = self.fitting.features(activations[coordinates_of(name)])
                features[name] = torch.cat([features[name], fitted], dim=1)
        return features

    def required_fitting(self, model: str = "this model") -> Fitting:
        """The fitting, or an error that names how to get one."""
        if self.fitting is None:
            name = model if model != "this model" else "MODEL"
            raise ValueError(
                f"{model} cannot optimise scenes per image yet: derender whiten --model {name} IMAGES --out "
                "NEW makes a copy that can"
            )
        return self.fitting

    def with_steps(self, steps: int) -> "Features":
        """The same with so many steps of fitting per image; 0: features are feed-forward only."""
        if steps < 0:
            raise ValueError(f"fit_steps must be 0 or more, got {steps}")
        return replace(self, fitting=None if self.fitting is None else self.fitting.with_steps(steps))

    def tensors(self) -> dict[str, Tensor]:
        """All tensors that ``save`` writes, by name."""
        parts = (part for part in (self.whitening, self.fitting) if part is not None)
        return {name: value for part in parts for name, value in part.named_buffers()}

    def save(self, folder: Path) -> None:
        """Write a file for each part there is into a saved model's folder."""
        if self.whitening is not None:
            self.whitening.save(folder / WHITENING_FILE)
        if self.fitting is not None:
            self.fitting.save(folder / FITTING_FILE)

    @classmethod
    def load(cls, folder: Path, image_size: int) -> "Features":
        """Read the parts in a saved model's folder; damage or maps of another size are a ValueError."""
        whitening, fitting = folder / WHITENING_FILE, folder / FITTING_FILE
        return cls(
            Whitening.load(whitening) if whitening.is_file() else None,
            Fitting.load(fitting, image_size) if fitting.is_file() else None,
        )
