"""Tables of renderers by name: their fits, trainings and speed, each from the file of one benchmark."""

from collections.abc import Iterator
from statistics import fmean, stdev
from typing import Any


def renderers(result: Any) -> Iterator[list[str]]:
    """Errors of scenes optimised with the renderer of an effect, beside ``lambert``: mean, deviation."""
    yield [
        *("effect, renderer", "L1 / lambert's", "normals, degrees", "of lambert"),
        *("albedo error / lambert's", "the same without the effect"),
    ]
    groups = _trained(result)
    for effect, name in _knowing(groups):
        reconstructed = spread(_ratios(groups, (effect, name), (effect, "lambert"), "l1"), 2)
        yield [f"{effect}: {name}", reconstructed, *_compared(groups, effect, name)]


def renderer_speed(result: Any) -> Iterator[list[str]]:
    yield ["renderer", "forward, ms", "with gradients, ms", "with gradients / lambert"]
    for one in result["cells"]:
        cells = (("forward_ms", 1), ("forward_and_backward_ms", 1), ("forward_and_backward_over_lambert", 2))
        yield [one["renderer"], *(f"{one[key]:.{digits}f}" for key, digits in cells)]


def renderers_trained(result: Any) -> Iterator[list[str]]:
    """Errors of models trained with the renderer of an effect, beside ``lambert``: mean, deviation."""
    yield [
        "effect, renderer",
        *("normals, degrees", "of lambert"),
        *("albedo error / lambert's", "the same without the effect", "lambert's with / without the effect"),
    ]
    groups = _trained(result)
    for effect, name in _knowing(groups):
        hit = spread(_ratios(groups, (effect, "lambert"), ("none", "lambert")), 2)
        yield [f"{effect}: {name}", *_compared(groups, effect, name), hit]


def _knowing(groups: Any) -> list[tuple[str, str]]:
    """Effects with the renderers that know them."""
    return [pair for pair in groups if "lambert" not in pair[1:] and pair[0] != "none"]


def _compared(groups: Any, effect: str, name: str) -> list[str]:
    """Normals of a renderer and of ``lambert``; ratios of albedo errors with the effect and without."""
    normals = (spread([one["normal_deg"] for one in groups[effect, own]], 1) for own in (name, "lambert"))
    pairs = (((where, name), (where, "lambert")) for where in (effect, "none"))
    return [*normals, *(spread(_ratios(groups, *pair), 2) if pair[0] in groups else "" for pair in pairs)]


def _ratios(
    groups: Any, upper: tuple[str, str], lower: tuple[str, str], score: str = "albedo"
) -> list[float]:
    """An error of one effect and renderer over that of another, for each seed."""
    errors = {one["seed"]: one[score] for one in groups[lower]}
    return [one[score] / errors[one["seed"]] for one in groups[upper]]


def _trained(result: Any) -> dict[tuple[str, str], list[Any]]:
    """Cells of every seed by effect and renderer, in the order of a table."""
    groups: dict[tuple[str, str], list[Any]] = {}
    order = ["none", "shadows", "gloss", "lamps", "haze"]
    for one in sorted(result["cells"], key=lambda one: (order.index(one["effect"]), one["seed"])):
        groups.setdefault((one["effect"], one["renderer"]), []).append(one)
    return groups


def spread(values: list[float], digits: int) -> str:
    text = f"{fmean(values):.{digits}f}"
    return text if len(values) < 2 else f"{text} ± {stdev(values):.{digits}f}"
