"""Renderers by name: the built-in ones, their combinations, and those of a user's own module.

A name is that of a file here and of the function in it, with settings in parentheses, and + between those
that combine: ``phong(gamma=2.2)+lambert-shadow+haze``. ``package.module:thing`` is the ``Renderer`` called
thing there.
"""

import importlib
import inspect
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from derender.data import suggestion
from derender.render import Rendering
from derender.renderers.renderer import Renderer
from derender.scene import Scene
from derender.storage.bounded import parse_yaml
from derender.storage.places import bundled_renderers

__all__ = [
    "RENDERERS", "Render", "Renderer", "as_renderer", "brings_code", "recorded_renderer", "renderer_named",
]  # fmt: skip

Render = Callable[[Scene, float], Rendering]  # of scenes and a horizontal field of view in degrees

RENDERERS: dict[str, Callable[..., Renderer]] = {
    name: getattr(importlib.import_module(f"{__name__}.{file}"), file)
    for name, file in bundled_renderers().items()
}
_PART = re.compile(r"\s*(?P<name>\w[\w.-]*(:\w+)?)\s*(\((?P<settings>[^()]*)\))?\s*")


def brings_code(name: str) -> bool:
    """Whether a renderer's name is that of a user's module, which is imported to find it."""
    return ":" in name


def renderer_named(name: str) -> Renderer:
    """The renderer of that name; imports a user's own module.

    Raises:
        ValueError: an unknown name or setting (names the nearest), a value out of range, or renderers that
            cannot be combined.
    """
    parts = [_PART.fullmatch(part) for part in name.split("+")]
    if not all(parts):
        raise ValueError(f"cannot read the renderer {name!r}: write NAME, NAME(setting=value) or NAME+NAME")
    made = [_one(part["name"], part["settings"]) for part in parts if part is not None]
    return sum(made[1:], made[0])


def as_renderer(given: str | Render | None, stored: str) -> Renderer:
    """A renderer by name or itself, by default the ``stored`` one; a function is called as it is."""
    if given is None or isinstance(given, str):
        return renderer_named(given or stored)
    return given if isinstance(given, Renderer) else Renderer(stored, function=given)


def recorded_renderer(stored: str, given: str | Render | None, source: str | Path) -> Renderer:
    """What draws the scenes of a saved model: as it records (``stored``), or as the user gives it.

    A ValueError: it was made with another renderer, or was downloaded and wants a user's module imported.
    """
    if isinstance(given, Renderer) and brings_code(stored) and given.name.partition("(")[0] not in RENDERERS:
        return replace(given, name=stored)  # a user's own value, which knows no module
    asked = given.name if isinstance(given, Renderer) else given
    if isinstance(asked, str) and asked != stored:
        fix = "leave the renderer out, or train a model with it"
        raise ValueError(f"{source} was made with the renderer {stored!r}, not {asked!r}: {fix}")
    if brings_code(stored) and given is None and not Path(source).exists():  # of no bundled model either
        fix = f"if you trust that code, use derender.load({str(source)!r}, renderer={stored!r})"
        raise ValueError(f"{source} was downloaded and wants the code of the renderer {stored!r}: {fix}")
    return as_renderer(given, stored)


def _one(name: str, settings: str | None) -> Renderer:
    text = name if settings is None else f"{name}({settings})"
    if brings_code(name):
        return _imported(name, settings)
    if name not in RENDERERS:
        fix = f"choose one of {', '.join(RENDERERS)}, or package.module:thing"
        raise ValueError(f"no renderer {name!r}{suggestion(name, RENDERERS)}: {fix}")
    make, given = RENDERERS[name], dict[str, Any]()
    known = inspect.signature(make).parameters
    for item in filter(str.strip, (settings or "").split(",")):
        key, equals, value = (part.strip() for part in item.partition("="))
        if not equals or key not in known:
            has = f"it has {', '.join(known)}" if known else "it has none"
            raise ValueError(f"renderer {name!r} has no setting {key!r}{suggestion(key, known)}: {has}")
        given[key] = parse_yaml(value)
        kind = known[key].annotation
        if kind is float and type(given[key]) is int:
            given[key] = float(value)  # a number too large for a float is infinite
        if type(given[key]) is not kind:
            raise ValueError(f"renderer {name!r}: {key} must be a {kind.__name__}, got {value!r}")
    return replace(make(**given), name=text)


def _imported(name: str, settings: str | None) -> Renderer:
    module, _, thing = name.partition(":")
    if settings is not None:
        raise ValueError(f"renderer {name!r} takes no settings here: set them where it is made")
    if module.partition(".")[0] in sys.stdlib_module_names or ".__main__" in module:  # a stranger's
        raise ValueError(f"no renderer {name!r}: it names a module of Python itself or a program")
    try:
        result = getattr(importlib.import_module(module), thing)
    except (Exception, SystemExit) as error:  # whatever a module does when it is imported
        fix = f"put the folder of {module.partition('.')[0]} on PYTHONPATH, or install it"
        raise ValueError(f"no renderer {name!r} ({error!r}): {fix}") from error
    if not isinstance(result, Renderer):
        raise ValueError(f"{name!r} is a {type(result).__name__}, not a derender.renderers.Renderer")
    return replace(result, name=name)
