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


def renderers_trained(result: Any, clear: bool = False) -> Iterator[list[str]]:
    """Errors of models trained with each renderer, by effect or of ``clear`` images: mean, deviation."""
    digits = {"normal_deg": 1, "albedo": 3, "albedo_chroma": 4, "l1": 4}
    titles = ("normals, degrees", "albedo error", "chroma error", "L1", "albedo / lambert", "seeds")
    yield ["effect in the images: renderer", *titles]
    groups = _trained(result)
    for effect, name in [pair for pair in groups if (pair[0] == "none") == clear]:
        ones = groups[effect, name]
        means = [spread([one[key] for one in ones], n) for key, n in digits.items()]
        plain = {one["seed"]: one["albedo"] for one in groups[effect, "lambert"]}
        ratio = spread([one["albedo"] / plain[one["seed"]] for one in ones], 2)
        yield [f"{effect}: {name}", *means, ratio, ", ".join(str(one["seed"]) for one in ones)]


def effect_numbers(result: Any) -> Iterator[list[str]]:
    """Rank correlation and median errors of an effect's own numbers in trained models."""
    yield ["number, renderer", "rank correlation", "median error", "after the best line", "of a constant"]
    ends = ("spearman", "median_error", "median_error_of_line", "median_error_of_constant")
    for (_, name), ones in _trained(result).items():
        for number in [key.removesuffix("_spearman") for key in ones[0] if key.endswith("_spearman")]:
            means = (spread([one[f"{number}_{end}"] for one in ones], 2) for end in ends)
            yield [f"{number.replace('_', ' ')}: {name}", *means]


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


def renderers_yale(result: Any) -> Iterator[list[str]]:
    """Residuals by the light's angle, and its azimuth and elevation, of scenes fitted to Extended Yale B."""
    residuals = {"L1 to 25°": "0_25", "25° to 50°": "25_50", "50° to 77°": "50_78"}
    yield ["renderer", *residuals, *(f"{what}: r, error" for what in ("azimuth", "elevation"))]
    for one in result["cells"]:
        shown = [f"{one[f'residual_{span}']:.4f}" for span in residuals.values()]
        for what in ("azimuth", "elevation"):
            shown.append(f"{one[f'{what}_correlation']:.3f}, {one[f'{what}_mean_error_deg']:.1f}°")
        yield [one["renderer"], *shown]
