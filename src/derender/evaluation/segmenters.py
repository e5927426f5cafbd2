"""What is compared in face segmentation: divided images with masks, networks and their training, controls.

Source: Klinghoffer et al., ECCV 2022, Sec. 4.7 and Table 3: Adam 2e-4 with betas 0.5 and 0.999, 20 epochs.
Neither the loss nor the batch size is stated: cross-entropy, and 64, or fewer of few images. Two fresh
encoders stand beside the paper's control, a single one. A pre-trained encoder keeps its BatchNorm statistics
while its weights learn. Leaves out augmentation, class weights and early stopping.

Controls without a network learn from the training images only. Faces are aligned, so the most frequent class
at a place already draws a face; principal components also hold its pose.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from derender.baselines.controls import flat_pixels
from derender.data import ImageSet, split_indices
from derender.data.source import evenly_spaced
from derender.evaluation.pixels import COMPONENT_IMAGES, component_count
from derender.features import chosen, map_batches
from derender.features.extract import as_batch
from derender.networks.encoders import UNetDecoder, UNetEncoder
from derender.settings import Settings
from derender.training.process import freed_memory_kept

TEST_FRACTION = 0.2
LARGEST_BATCH, SMALLEST_BATCH, STEPS_AN_EPOCH = 64, 2, 320
LEVELS_KEPT = 2  # finest first, whose BatchNorm keeps its statistics beside a learnt decoder
_CHUNK = 512


@dataclass(frozen=True)
class SegmentationData:
    """(N, 3, S, S) RGB images with (N, S, S) masks of class numbers, and the names of the classes.

    ``train`` rows are learned from, ``test`` rows scored and no others ever. ``split`` is the rule in words;
    ``source`` and ``layout`` are of the data set.
    """

    images: UInt8[np.ndarray, "n 3 s s"]
    masks: UInt8[np.ndarray, "n s s"]
    classes: tuple[str, ...]
    train: Int64[np.ndarray, " l"]
    test: Int64[np.ndarray, " t"]
    split: str
    source: str = ""
    layout: str = ""

    def shares(self, rows: Int64[np.ndarray, " k"]) -> np.ndarray:
        """(C,) share of the pixels of these rows that each class has; adds up to 1."""
        counted = np.bincount(self.masks[rows].ravel(), minlength=len(self.classes))
        return counted / counted.sum()


def divide(
    images: ImageSet, masks: UInt8[np.ndarray, "n s s"], classes: Sequence[str], *,
    test_fraction: float = TEST_FRACTION, split_seed: int = 0, labelled: int | None = None,
) -> SegmentationData:  # fmt: skip
    """Choose training and test images of what ``read_masks`` gave.

    Where the data bring a partition, its "test" rows are tested, and its "train" rows (all others, where it
    has no "train") learn. Otherwise files are ordered by a hash of their name and ``split_seed``, and the
    last ``test_fraction`` of that order are tested. ``labelled`` limits the training images. ValueError:
    nothing to learn from or to test, more requested than there is, or a single class.
    """
    owners = images.partition
    if owners is not None and (owners == "test").any():
        test = np.flatnonzero(owners == "test")
        train = np.flatnonzero(owners == "train" if (owners == "train").any() else owners != "test")
        rule = "the data's own partition"
    else:
        split = split_indices(images.files, (1 - test_fraction, 0.0, test_fraction), seed=split_seed)
        train, test, rule = split.train, split.test, f"a hash of the files' names, seed {split_seed}"
    if len(train) < 2 or not len(test):
        what = f"{images.source} leaves {len(train)} images to learn from and {len(test)} to test on"
        raise ValueError(f"{what}: bring more images, or another test_fraction")
    if labelled is not None:
        if not 2 <= labelled <= len(train):
            what = f"labelled={labelled:,} training images, but there are {len(train):,}"
            raise ValueError(f"{what}: choose 2 to that many")
        train = np.sort(np.random.default_rng(split_seed).permutation(train)[:labelled])
    seen = np.unique(masks[train])
    if len(seen) < 2:
        where, only = f"masks to learn from in {images.source}", classes[int(seen[0])]
        what = f"the {len(train):,} {where} show one class only ({only})"
        raise ValueError(f"{what}: segmentation needs two or more")
    about = (rule, images.source, images.layout)
    return SegmentationData(images.images, masks, tuple(classes), train, test, *about)


@dataclass(frozen=True)
class Variant:
    """One row of the table, by its title: encoders of these factors, joined in this order, ``pretrained`` or
    fresh, ``frozen`` or learning; ``decoder``: it, too, begins with the model's weights (all but its last
    layer).
    """

    title: str
    factors: tuple[str, ...]
    pretrained: bool
    frozen: bool
    decoder: bool = False


_ONE, _BOTH = ("geometry",), ("geometry", "albedo")
VARIANTS: Mapping[str, Variant] = {  # by name on the command line
    "joint-whole": Variant("joint, decoder too", _BOTH, True, False, decoder=True),
    "joint": Variant("joint encoders", _BOTH, True, False),
    "geometry": Variant("geometry encoder", _ONE, True, False),
    "albedo": Variant("albedo encoder", ("albedo",), True, False),
    "joint-frozen": Variant("joint encoders, frozen", _BOTH, True, True),
    "random": Variant("random start", _ONE, False, False),
    "joint-random": Variant("random start, joint", _BOTH, False, False),
}


class SegmentSettings(Settings):
    """Training of a network; without a batch size, ``batch_for`` chooses one."""

    learning_rate: float = Field(default=2e-4, gt=0)
    betas: tuple[float, float] = (0.5, 0.999)
    epochs: int = Field(default=20, ge=1)
    batch_size: int | None = Field(default=None, ge=2)

    def batch_for(self, images: int) -> int:
        """Images a step: 64, but fewer (2 at least) where an epoch would have less than 320 steps."""
        return self.batch_size or min(LARGEST_BATCH, max(SMALLEST_BATCH, images // STEPS_AN_EPOCH))


def chosen_variants(model: Any, names: Sequence[str] | None = None) -> dict[str, Variant]:
    """Variants by name, or all that the model allows: a U-Net decoder is needed by some.

    Raises:
        ValueError: an unknown name (with a suggestion), or the model lacks an encoder or decoder.
    """
    own_decoder = getattr(model, "unet_decoder", None) is not None
    if names is None:
        names = [name for name, variant in VARIANTS.items() if own_decoder or not variant.decoder]
    variants = {name: VARIANTS[name] for name in chosen(names, VARIANTS, "variant")}
    for factor in sorted({factor for variant in variants.values() for factor in variant.factors}):
        encoder = getattr(model.nets[factor], "encoder", None) if factor in model.nets else None
        if not isinstance(encoder, UNetEncoder):
            what = f"the model has no U-Net encoder for {factor}, and segmentation needs its skip features"
            fix = "make one with derender unet, or train one with derender train --set encoder=unet"
            raise ValueError(f"{what}: {fix}")
    if any(variant.decoder for variant in variants.values()) and not own_decoder:
        raise ValueError("the model has no U-Net decoder: make a copy that has with derender unet")
    return variants


class SegmentationNet(nn.Module):
    """Images in 0..1 to one logit a class and pixel, from U-Net encoders and a decoder over all of them.

    ``frozen`` encoders never change. With ``kept_statistics`` their BatchNorm keeps its statistics. Beside a
    learnt ``decoder``, of which all but the last layer is taken, only the two finest levels of either do.
    """

    def __init__(
        self, encoders: Sequence[UNetEncoder], outputs: int, *, frozen: bool = False,
        kept_statistics: bool = False, decoder: UNetDecoder | None = None,
    ):  # fmt: skip
        super().__init__()
        self.frozen, self.encoders = frozen, nn.ModuleList(encoders).requires_grad_(not frozen)
        # parts whose BatchNorm keeps its statistics
        self._fixed: list[nn.Module] = [self.encoders] if frozen or kept_statistics else []
        for encoder in encoders:
            encoder.to_code.requires_grad_(False)  # the code takes no part here
        if decoder is None:
            self.decoder = UNetDecoder(encoders[0].widths, len(encoders), outputs)
        else:
            self.decoder = copy.deepcopy(decoder).requires_grad_(True)
            last = decoder.to_outputs
            self.decoder.to_outputs = nn.Conv2d(last.in_channels, outputs, 1, device=last.weight.device)
            levels = [encoder.levels[:LEVELS_KEPT] for encoder in encoders]
            self._fixed = [*levels, self.decoder.convolve[-LEVELS_KEPT:]]

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def train(self, mode: bool = True) -> "SegmentationNet":
        super().train(mode)
        for part in self._fixed:
            part.eval()
        return self

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n outputs h w"]:
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            levels = zip(*(encoder.skips(images) for encoder in self.encoders), strict=True)  # pyrefly: ignore[not-callable]
            joined = [torch.cat(level, dim=1) for level in levels]
        return self.decoder(joined)


def build_variant(model: Any, variant: Variant, data: SegmentationData, seed: int) -> SegmentationNet:
    """A network to train; the model stays as it was, and so does torch's global generator.

    The seed makes the decoder and fresh encoders. Variants of equal shape start from the same decoder.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoders = [copy.deepcopy(model.nets[factor].encoder) for factor in variant.factors]
        decoder_seed = int(torch.randint(2**31, ()))
        for module in nn.ModuleList(encoders).modules() if not variant.pretrained else ():
            if isinstance(module, nn.Conv2d | nn.BatchNorm2d):
                module.reset_parameters()
        torch.manual_seed(decoder_seed)
        how = {"frozen": variant.frozen, "kept_statistics": variant.pretrained}
        decoder = model.unet_decoder if variant.decoder else None
        return SegmentationNet(encoders, len(data.classes), decoder=decoder, **how).to(model.device)


def train_segmenter(
    net: SegmentationNet, data: SegmentationData, seed: int, settings: SegmentSettings,
    progress: Callable[[int, float], object] | None = None,
) -> list[float]:  # fmt: skip
    """Train in place on the training rows; the mean loss of each epoch.

    The seed orders the images; ``progress`` is called with (images seen, loss) after every step.
    """
    net.to(memory_format=torch.channels_last).train()  # pyrefly: ignore[no-matching-overload]
    learning = [parameter for parameter in net.parameters() if parameter.requires_grad]
    optimiser = torch.optim.Adam(learning, lr=settings.learning_rate, betas=settings.betas, fused=True)
    generator, seen, means = torch.Generator().manual_seed(seed), 0, []
    batch_size = settings.batch_for(len(data.train))
    with freed_memory_kept(net.device):
        for _ in range(settings.epochs):
            order = data.train[torch.randperm(len(data.train), generator=generator).numpy()]
            total = 0.0
            for rows in np.split(order, range(batch_size, len(order), batch_size)):
                truth = torch.from_numpy(data.masks[rows]).to(net.device).long()
                loss = cross_entropy(net(as_batch(data.images[rows], net.device)), truth)
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                value = loss.item()
                total, seen = total + value * len(rows), seen + len(rows)
                if progress is not None:
                    progress(seen, value)
            means.append(total / len(order))
    return means


def answer(net: SegmentationNet, images: np.ndarray) -> np.ndarray:
    """(N, S, S) uint8: the likeliest class of every pixel of (N, 3, S, S) uint8 images."""

    def likeliest(batch: Tensor) -> np.ndarray:
        return net(batch).argmax(dim=1).to(torch.uint8).cpu().numpy()

    return np.concatenate(map_batches(likeliest, net, images, batch_size=128))


def most_frequent_at_place(data: SegmentationData) -> np.ndarray:
    """(T, S, S): the class that most training masks have at this place; of two even ones the lower."""
    learned = data.masks[data.train]
    counts = np.stack([(learned == number).sum(axis=0) for number in range(len(data.classes))])
    return np.tile(counts.argmax(axis=0).astype(np.uint8), (len(data.test), 1, 1))


def by_components(data: SegmentationData) -> np.ndarray:
    """(T, S, S): the best class of a linear regression from the image's principal components at each place.

    64 components (a quarter of the training images, where that is fewer) of at most 2,000 training images.
    Scaling them would change nothing. Of two even classes the lower.
    """

    from sklearn.decomposition import PCA

    def described(rows: np.ndarray) -> np.ndarray:
        parts = np.array_split(rows, max(1, len(rows) // _CHUNK))
        codes = [pca.transform(flat_pixels(data.images[part])) for part in parts]
        return np.column_stack((np.ones(len(rows)), np.concatenate(codes)))

    fitted = flat_pixels(data.images[data.train[evenly_spaced(len(data.train), COMPONENT_IMAGES)]])
    pca = PCA(component_count(len(data.train)), random_state=0).fit(fitted)
    learned = data.masks[data.train].reshape(len(data.train), -1)
    solver, tested = np.linalg.pinv(described(data.train)), described(data.test)
    best = np.zeros((len(data.test), learned.shape[1]), np.uint8)
    most = np.full(best.shape, -np.inf)
    for number in np.unique(learned).tolist():
        parts = (slice(start, start + _CHUNK) for start in range(0, len(learned), _CHUNK))
        favour = tested @ np.sum([solver[:, part] @ (learned[part] == number) for part in parts], axis=0)
        better = favour > most + 1e-9
        best[better], most[better] = number, favour[better]
    return best.reshape(len(best), *data.masks.shape[1:])


CONTROLS: Mapping[str, Callable[[SegmentationData], np.ndarray]] = {  # by row name
    "each place's class": most_frequent_at_place,
    "PCA": by_components,
}
