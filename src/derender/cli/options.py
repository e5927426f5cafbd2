"""Commands, and the options that several of them share, each declared once.

Groups of options are dataclasses. A command that asks for such a dataclass is shown to typer with the fields
in its place, and called with the value. What typer shows of a field or an argument is its annotation or an
``option`` (``report/options.py``). A group knows how to do what its options ask for: a new option of every
command that reads images is one field here, used in one method here.
"""

import functools
from collections.abc import Callable
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from derender import learn
from derender.cli.console import notice, progress_bar, refuse_existing, report_images, result, write_json
from derender.cli.runs import DryRun, dry_run_shown
from derender.report.options import ImageOptions, option, single_suffix
from derender.storage import places

if TYPE_CHECKING:
    from derender.data import ImageSet
    from derender.model import Derenderer
    from derender.report.editing import Edited
    from derender.report.opening import ImageOpener, OpenedImage

BUNDLED = ", ".join(places.bundled_models())
MODELS = f"Run folder, saved model, Hugging Face Hub id, or a bundled model: {BUNDLED}."
IMAGES = "Folder, zip, .tar shards or Hugging Face id; ADDRESS::PART for a part of it."
JSON = "Also write the numbers as JSON; - is standard output."
HALF = "all, or the development or test half, by a hash of identity, model or file."
LIMIT = "Read at most N images: evenly spaced, or the first of a stream."
BATCH = "Images per batch; changes speed and memory only."
PART = "all, or the train, validation or test part of the model's training split."
SEED = "Seed of every random choice: sampling, splits, initial weights."
FIT = "Optimise each scene against its image by rendering, in N steps (20, say; slow)."
OUT_IMAGES = "Folder to write to; or, of one image, a single .png, .jpg, .gif, .mp4 or .glb."
SETTING = "Change one setting; may be repeated. The reference of settings lists all."
Model = Annotated[str, typer.Option("--model", "-m", help=MODELS, metavar="MODEL")]
Images = Annotated[str | None, typer.Argument(help=IMAGES, metavar="IMAGES", show_default=False)]
Dataset = Annotated[str, typer.Option(help="Layout of the images, if it is not recognised.", metavar="NAME")]
Json = Annotated[str | None, typer.Option("--json", help=JSON, metavar="FILE")]
Limit = Annotated[int | None, typer.Option("--limit", min=1, metavar="N", help=LIMIT)]
BatchSize = Annotated[int, typer.Option("--batch-size", min=1, metavar="N", help=BATCH)]
Seed = Annotated[int, typer.Option("--seed", min=0, metavar="N", help=SEED)]
Force = Annotated[bool, typer.Option("--force", help="Replace existing output.")]
OutFolder = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.", metavar="DIR")]
OutImages = Annotated[Path, typer.Option("--out", "-o", help=OUT_IMAGES, metavar="DIR|FILE")]
OutModel = Annotated[Path, typer.Option("--out", "-o", help="Folder of the new model.", metavar="DIR")]
Device = Annotated[str, typer.Option("--device", help="cpu, cuda, or auto.", metavar="NAME")]
FitSteps = Annotated[int | None, typer.Option("--fit-steps", min=0, max=10_000, metavar="N", help=FIT)]
Settings = Annotated[list[str] | None, typer.Option("--set", help=SETTING, metavar="KEY=VALUE")]


def command(name: str, example: str) -> Callable[[Callable[..., None]], Any]:
    """Decorate a ``gathered`` command: it gets ``register``, which puts it under its name into an app."""

    def decorated(function: Callable[..., None]) -> Callable[..., None]:
        run: Any = gathered(function)
        run.register = lambda app: app.command(name, epilog=f"Example: derender {example}")(run)
        return run

    return decorated


def gathered(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the fields of its dataclass parameters in their place, all given by name."""
    groups: dict[str, type] = {}
    shown: list[Parameter] = []

    def show(name: str, kind: Any, default: Any) -> None:
        if isinstance(default, Field):
            if words := dict(default.metadata):
                kind = Annotated[kind, typer.Option(*words.pop("names"), **words)]
            default = Parameter.empty if default.default is MISSING else default.default
        shown.append(Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=kind))

    for name, parameter in signature(command).parameters.items():
        kind = parameter.annotation
        if isinstance(kind, type) and is_dataclass(kind):
            groups[name] = kind
            for field in fields(kind):
                show(field.name, field.type, field)
        else:
            show(name, kind, parameter.default)

    @functools.wraps(command)
    def run(**given: Any) -> None:
        taken = {
            name: group(**{field.name: given.pop(field.name) for field in fields(group)})
            for name, group in groups.items()
        }
        command(**given, **taken)

    run.__signature__ = Signature(shown)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in shown}
    return run


@dataclass(frozen=True)
class Output:
    """Where numbers go, and whether existing files are replaced."""

    force: Force = False
    json_file: Json = None

    def result(self, text: str) -> None:
        """Print one line of result."""
        result(text, self.json_file)

    def write(self, values: dict[str, Any]) -> None:
        """Write what --json requests."""
        write_json(self.json_file, values)


@dataclass(frozen=True)
class ImageOutput(Output):
    """The same for commands that draw images."""

    force: bool = option(False, "Replace existing output; draw images that do not suit the model.", "--force")


@dataclass(frozen=True)
class DataOptions:
    """The images of a command: one data set, by address."""

    images: Images = None
    data: str | None = option(None, None, "--data", "-d", hidden=True, metavar="IMAGES")
    dataset: Dataset = "auto"
    limit: Limit = None
    half: Literal["all", "development", "test"] = option("all", HALF)

    @property
    def optional_address(self) -> str | None:
        """The address that was given, with its half, or None."""
        if self.images is not None and self.data is not None:
            raise ValueError(f"two sets of images were given, {self.images} and {self.data}: give one")
        address = self.images if self.data is None else self.data
        if address is None or self.half == "all":
            return address
        place, separator, part = address.partition("::")
        return f"{place}?half={self.half}{separator}{part}"

    @property
    def address(self) -> str:
        """The address that was given; none is an error."""
        if (address := self.optional_address) is None:
            raise ValueError("give the images: a folder, a zip or another data set")
        return address

    @property
    def how(self) -> dict[str, Any]:
        """How the address is read: keywords of library calls (`derender.inputs.as_images`)."""
        return {"dataset": self.dataset, "limit": self.limit}

    def read(self, image_size: int, **how: Any) -> "ImageSet":
        """The decoded images, with a progress bar and a line on what was read and left out."""
        from derender.inputs import as_images

        with progress_bar("reading") as report:
            images = as_images(self.address, image_size, **self.how, **how, progress=report)
        report_images(images)
        return images


@dataclass(frozen=True)
class PartOfImages(DataOptions):
    """The images of a command, or one part of a training split."""

    part: str = option("all", PART)

    def __post_init__(self) -> None:
        if (address := self.optional_address) is not None and self.dataset == "auto":
            places.require_images(address)

    @property
    def how(self) -> dict[str, Any]:
        return {**super().how, "part": self.part}


@dataclass(frozen=True)
class TrainedModel:
    """The trained model of a command."""

    model: Model
    device: Device = "auto"

    def __post_init__(self) -> None:
        places.require_known("device", self.device, places.DEVICES)
        if not places.hub_id(self.model):
            places.model_folder(self.model)

    def open(self) -> "Derenderer":
        """Load it."""
        from derender.inputs import as_model

        return as_model(self.model, device=self.device)


@dataclass(frozen=True)
class ImageModel(TrainedModel):
    """The trained model of a command for photographs."""

    model: Model = "faces-64"

    def opener(self, how: ImageOptions, default_size: int = 0, **more: Any) -> "ImageOpener":
        """What opens images: the loaded model with the options."""
        from derender.report.opening import ImageOpener, held_out_errors

        held_out = held_out_errors(self.model)
        return ImageOpener(self.open(), how, default_size=default_size, held_out=held_out, **more)


@dataclass(frozen=True)
class Copying:
    """How a copy of a model is made."""

    settings: Settings = None
    seed: Seed = 0
    dry_run: DryRun = False

    def make(
        self, make: Callable[..., Any], doing: str, images: PartOfImages, model: TrainedModel, out: Path,
        output: Output,
    ) -> dict[str, Any]:  # fmt: skip
        """Make and report it by a call of `derender.learn`; gives its measurements by name."""
        settings = self.settings or ()
        if self.dry_run:
            dry_run_shown(learn.copy_settings(make.__name__, settings), output.json_file)
            raise typer.Exit
        refuse_existing(out, output.force)
        with progress_bar(doing) as report:
            made = make(
                model.model, images.address, out=out, settings=settings, seed=self.seed, device=model.device,
                overwrite=output.force, **images.how, on_images=report_images, progress=report,
            )  # fmt: skip
        output.result(f"model {made.folder}")
        output.write(made.values())
        return made.scores


@dataclass(frozen=True)
class GeneratedOptions:
    """The options of both kinds of generated images."""

    out: OutFolder
    count: int | None = option(None, "Number of images (1000).", "--count", "-n", min=1)
    image_size: int = option(64, "Width and height in pixels.", min=16, max=1024)
    seed: Seed = 0
    light: str = option("usual", "Range of lighting: usual, wide, frontal.")
    view: str = option("usual", "Range of viewpoints: usual, wide, frontal.")
    truth: bool = option(True, "Write the maps of ground truth too.")
    benchmark: bool = option(False, "Write the fixed sets of published scores.", "--benchmark")
    overrides: Settings = None
    json_file: Json = None


@dataclass(frozen=True)
class ImageFiles:
    """Image files, and the folder for what is made of them."""

    images: Annotated[
        list[Path], typer.Argument(help="Image files, videos, or folders of them.", metavar="IMAGE...")
    ]
    out: OutImages
    resume: bool = option(False, "Leave out images that are done.", "--resume")

    def __post_init__(self) -> None:
        places.require_image(self.images)

    @property
    def suffix(self) -> str:
        """Of ``--out`` where it names one file; else empty."""
        return single_suffix(self.out)

    def edit(
        self, opener: "ImageOpener", edit: "Callable[[OpenedImage], Edited]", output: ImageOutput, **how: Any
    ) -> None:
        """Edit, write and report every image; exit code 2 where one that was named cannot be read.

        ``how`` are further keywords of ``write_images``.
        """
        from derender.report.editing import write_image_file, write_images

        write = write_image_file if self.suffix else write_images
        how |= {"force": output.force, "resume": self.resume}
        with progress_bar("drawing", "images") as report:
            try:
                written = write(opener, self.images, self.out, edit, **how, progress=report)
            except KeyboardInterrupt:
                raise KeyboardInterrupt(
                    "stopped by Ctrl-C; finished images are kept: --resume continues"
                ) from None
        notice(*written.notes())
        output.result(f"{places.counted(len(written.images), 'images')} in {self.out}")
        output.write(written.values())
        if set(written.refused) & set(self.images):  # of a folder others were used
            raise typer.Exit(2)
