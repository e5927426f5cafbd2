"""Tables of renderers by name: their fits, trainings and speed, each from the file of one benchmark."""

from collections.abc import Iterator
from statistics import fmean, stdev
from typing import Any


def renderers(result: Any) -> Iterator[list[str]]:
    """Reconstruction error of scenes optimised with each renderer, by effect, mean over seeds."""
    cells = result["cells"]
    names = list(dict.fromkeys(one["renderer"] for one in cells))
    yield ["effect in the images; L1 with", *names]
    for effect in dict.fromkeys(one["effect"] for one in cells):
        means = []
        for name in names:
            errors = [one["l1"] for one in cells if (one["effect"], one["renderer"]) == (effect, name)]
            means.append(f"{sum(errors) / len(errors):.4f}" if errors else "")
        yield [effect, *means]


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
    for effect, name in [pair for pair in groups if "lambert" not in pair[1:] and pair[0] != "none"]:
        normals = (spread([one["normal_deg"] for one in groups[effect, own]], 1) for own in (name, "lambert"))
        plain, hit = ("none", "lambert"), (effect, "lambert")
        pairs = (((effect, name), hit), (("none", name), plain), (hit, plain))
        yield [f"{effect}: {name}", *normals, *(spread(_ratios(groups, *pair), 2) for pair in pairs)]


def _ratios(groups: Any, upper: tuple[str, str], lower: tuple[str, str]) -> list[float]:
    """The albedo error of one effect and renderer over that of another, for each seed."""
    errors = {one["seed"]: one["albedo"] for one in groups[lower]}
    return [one["albedo"] / errors[one["seed"]] for one in groups[upper]]


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
