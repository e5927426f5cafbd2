"""Options of the image commands: how images are read and drawn, and what sweeps become.

Each field is an option of every command that takes the class (``cli/options.py``). Nothing heavy is imported
here: the command line needs these classes for its help.
"""

from dataclasses import MISSING, dataclass, field, replace
from pathlib import Path
from typing import Any

from derender.storage.places import require_known

SIZE = (
    "Side of the output: 384, of whole photographs and textures of meshes at most 1,024, of decompositions "
    "the model's."
)
DETAIL = "photo: the image's own pixels. model: the model's albedo. Decompositions default to model."
FIT = "Optimise each scene against its image in N steps; by default 10 for edits, else 0."
FRAME = (
    "face: the largest face. auto: the part that the model reconstructs best. none: the middle square. "
    "By default face for models of faces, else none."
)
FILM = "Kinds of film: gif, mp4, both with a comma between, or none."
CHOICES = {"detail": ("photo", "model"), "frame": ("face", "auto", "none")}
OLD_TEXTURES = {"original": "photo", "model": "model"}
OLD_CROPS = {"whole": "none", "auto": "auto"}
FILM_KINDS, MESH_FORMATS = ("gif", "mp4"), ("glb", "obj")
STILL_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
EDIT_SIZE, WHOLE_SIZE, MESH_SIZE, TEXTURE_SIZE = 384, 1024, 128, 1024
"""Default sides in pixels: of edits, of whole photographs at most, of a mesh's grid and texture."""


def single_suffix(out: Path) -> str:
    """The suffix by which ``out`` asks for one file, in lower case; empty where it is a folder."""
    suffix = out.suffix.lower()
    known = (*STILL_SUFFIXES, *(f".{kind}" for kind in (*FILM_KINDS, *MESH_FORMATS)))
    return suffix if suffix in known and not out.is_dir() else ""


def option(default: Any, help: str | None, *names: str, **shown: Any) -> Any:
    """A field, or a command's argument, that is an option; ``...`` where it must be given.

    ``shown`` are further words of typer (``min``).
    """
    metadata = {"help": help, "names": names, **shown}
    return field(default=MISSING if default is ... else default, metadata=metadata)


@dataclass(frozen=True)
class ImageOptions:
    """How an image is read and its scene drawn."""

    size: int | None = option(None, SIZE, min=8, max=4096)
    detail: str | None = option(None, DETAIL, metavar="photo|model")
    texture: str | None = option(None, "Old spelling of detail.", hidden=True)
    fit_steps: int | None = option(None, FIT, min=0, max=10_000)
    frame: str | None = option(None, FRAME, metavar="face|auto|none")
    crop: str | None = option(None, "Old spelling of frame: whole or auto.", hidden=True)
    only_frame: bool = option(False, "Draw the frame only, not the whole photograph around it.")
    batch_size: int = option(64, "Images per batch; changes speed and memory only.", min=1, metavar="N")

    def __post_init__(self) -> None:
        for old, name, known in (("texture", "detail", OLD_TEXTURES), ("crop", "frame", OLD_CROPS)):
            if (value := getattr(self, old)) is not None:
                require_known(old, value, tuple(known))
                object.__setattr__(self, name, known[value])
        object.__setattr__(self, "frame", OLD_CROPS.get(self.frame or "", self.frame))
        for name, known in CHOICES.items():
            if (value := getattr(self, name)) is not None:
                require_known(name, value, known)


@dataclass(frozen=True)
class FilmOptions:
    """What a sweep is drawn as: a strip of stills and a film that goes there and back."""

    stills: int = option(7, "Number of images in the strip.", min=2, max=64, metavar="N")
    film: str = option("gif,mp4", FILM, metavar="KINDS")
    frames: int = option(48, "Number of frames of the film.", min=2, max=1000, metavar="N")
    hold: bool = option(False, "Hold a video's light or view at --reach, instead of going there and back.")
    seconds: float = option(4.0, "Length of the film in seconds.", min=0.1, max=60)

    def __post_init__(self) -> None:
        for kind in self.kinds:
            require_known("kind of film", kind, (*FILM_KINDS, "none"))

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of film by name; none for "none"."""
        kinds = tuple(dict.fromkeys(kind.strip().lower() for kind in self.film.split(",")))
        return () if kinds == ("none",) else kinds

    def single(self, suffix: str) -> "FilmOptions":
        """The same, but no more than a file of that suffix shows (``single_suffix``)."""
        if suffix in STILL_SUFFIXES:
            return replace(self, film="none", stills=2)
        return replace(self, film=suffix[1:]) if suffix[1:] in FILM_KINDS else self
