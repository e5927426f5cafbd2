"""Tables of renderers by name: their fits, trainings and speed, each from the file of one benchmark."""

from collections.abc import Iterator
from statistics import fmean, stdev
from typing import Any

SCORES = {"normals": "normal_deg", "albedo": "albedo", "chromaticity": "albedo_chroma", "image": "l1"}
NUMBERS = ("gloss_strength", "gloss_exponent", "haze_beta", "haze_airlight")


def renderers(result: Any) -> Iterator[list[str]]:
    """Errors with the renderer of an effect over those with ``lambert``: mean, deviation over seeds."""
    yield ["effect, renderer", *SCORES, "albedo without the effect"]
    groups = _trained(result)
    for effect, name in _knowing(groups):
        ratios = [_ratios(groups, effect, name, score) for score in SCORES.values()]
        if ("none", name) in groups:
            ratios.append(_ratios(groups, "none", name, "albedo"))
        cells = [spread(one, 2) for one in ratios]
        yield [f"{effect}: {name}", *cells, *[""] * (5 - len(cells))]


def renderer_numbers(result: Any) -> Iterator[list[str]]:
    """How well an effect's own numbers are predicted, where it is: mean, deviation over seeds."""
    kinds = ("spearman", "median_error", "median_error_of_line", "median_error_of_constant")
    yield ["number, renderer", "rank correlation", "median error", "after the best line", "of a constant"]
    groups = _trained(result)
    for number in NUMBERS:
        for pair in _knowing(groups):
            if f"{number}_spearman" in (cells := groups[pair])[0]:
                shown = (spread([one[f"{number}_{kind}"] for one in cells], 2) for kind in kinds)
                yield [f"{number}: {pair[1]}", *shown]


def renderers_yale(result: Any) -> Iterator[list[str]]:
    """Residual inside the mask by the angle of the light; correlation and mean error of its angles."""
    yield ["renderer", "up to 25°", "up to 50°", "up to 77°", "azimuth", "elevation"]
    for one in result["cells"]:
        residuals = (f"{one[f'residual_{band}']:.4f}" for band in ("0_25", "25_50", "50_78"))
        angles = (
            f"r {one[f'{kind}_correlation']:.2f}, {one[f'{kind}_mean_error_deg']:.1f}°"
            for kind in ("azimuth", "elevation")
        )
        yield [one["renderer"], *residuals, *angles]


def renderer_speed(result: Any) -> Iterator[list[str]]:
    yield ["renderer", "forward, ms", "with gradients, ms", "with gradients / lambert"]
    for one in result["cells"]:
        cells = (("forward_ms", 1), ("forward_and_backward_ms", 1), ("forward_and_backward_over_lambert", 2))
        yield [one["renderer"], *(f"{one[key]:.{digits}f}" for key, digits in cells)]


def _knowing(groups: Any) -> list[tuple[str, str]]:
    """Effects with the renderers that know them."""
    return [pair for pair in groups if "lambert" not in pair[1:] and pair[0] != "none"]


def _ratios(groups: Any, effect: str, name: str, score: str) -> list[float]:
    """An error of a renderer over that of ``lambert``, for each seed."""
    errors = {one["seed"]: one[score] for one in groups[effect, "lambert"]}
    return [one[score] / errors[one["seed"]] for one in groups[effect, name]]


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
