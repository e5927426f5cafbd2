"""Commands, and the options that several of them share, each declared once.

Groups of options are dataclasses. A command that asks for such a dataclass is shown to typer with the fields
in its place, and called with the value. What typer shows of a field or an argument is its annotation or an
``option`` (``report/options.py``). A group knows how to do what its options ask for: a new option of every
command that reads images is one field here, used in one method here.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from derender import learn
from derender.cli.console import notice, progress_bar, report_images, result, write_json
from derender.cli.runs import DryRun, dry_run_shown
from derender.report.options import ImageOptions, option, single_suffix
from derender.storage import places

if TYPE_CHECKING:
    from derender.data import ImageSet
    from derender.model import Derenderer
    from derender.report.opening import ImageOpener

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
Images = Annotated[str | None, typer.Argument(help=IMAGES, metavar="IMAGES", show_default=False)]
Dataset = Annotated[str, typer.Option(help="Layout of the images, if it is not recognised.", metavar="NAME")]
Json = Annotated[str | None, typer.Option("--json", help=JSON, metavar="FILE")]
Limit = Annotated[int | None, typer.Option("--limit", min=1, metavar="N", help=LIMIT)]
BatchSize = Annotated[int, typer.Option("--batch-size", min=1, metavar="N", help=BATCH)]
Seed = Annotated[int, typer.Option("--seed", min=0, metavar="N", help=SEED)]
OutFolder = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.", metavar="DIR")]
OutModel = Annotated[Path, typer.Option("--out", "-o", help="Folder of the new model.", metavar="DIR")]
Device = Annotated[str, typer.Option("--device", help="cpu, cuda, or auto.", metavar="NAME")]
FitSteps = Annotated[int | None, typer.Option("--fit-steps", min=0, max=10_000, metavar="N", help=FIT)]
Out = Path | str | None
Settings = Annotated[list[str] | None, typer.Option("--set", help=SETTING, metavar="KEY=VALUE")]
app = typer.Typer(
    name="derender",
    help="Decompose images into geometry, albedo, light and camera. Start with: derender demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def command(name: str, example: str, group: typer.Typer = app) -> Callable[[Callable[..., None]], Any]:
    """Put a function into a group of commands, with the fields of its dataclass parameters in their place."""

    def decorated(function: Callable[..., None]) -> Callable[..., None]:
        kinds: dict[str, type] = {}
        shown: list[Parameter] = []
        for word, parameter in signature(function).parameters.items():
            kind, options = parameter.annotation, [(word, parameter.annotation, parameter.default)]
            if isinstance(kind, type) and is_dataclass(kind):
                kinds[word], options = kind, [(one.name, one.type, one) for one in fields(kind)]
            for key, type_, default in options:
                if isinstance(default, Field):
                    if words := dict(default.metadata):
                        type_ = Annotated[type_, typer.Option(*words.pop("names"), **words)]  # pyrefly: ignore[not-a-type]
                    default = Parameter.empty if default.default is MISSING else default.default
                    if isinstance(default, Path):
                        default = Path(f"{default}-{name}")
                shown.append(Parameter(key, Parameter.KEYWORD_ONLY, default=default, annotation=type_))

        @functools.wraps(function)
        def run(**given: Any) -> None:
            groups = {}
            for word, kind in kinds.items():
                groups[word] = kind(**{one.name: given.pop(one.name) for one in fields(kind)})
            function(**given, **groups)

        run.__signature__ = Signature(shown)  # pyrefly: ignore[missing-attribute]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in shown}
        return group.command(name, epilog=f"Example: derender {example}")(run)

    return decorated


@dataclass(frozen=True)
class Output:
    """Where numbers go, and whether existing files are replaced."""

    force: bool = option(False, "Replace existing output.", "--force")
    json_file: Json = None

    def check(self, *files: Out, ends: Sequence[str] = (), folder: bool = False, force: bool = False) -> None:
        """Refuse what exists, without ``force``; folders, unless one is meant; and files with other ends."""
        for path in (Path(file) for file in files if file is not None and file != "-"):
            if ends and path.suffix.lower() not in ends:
                raise ValueError(f"--out {path} must end in {', '.join(ends)}: the kind of drawing")
            if path.is_dir() and not folder:
                raise IsADirectoryError(f"{path} is a folder: name a file to write")
            if path.exists() and not (self.force or force):
                fix = "choose another name, or add --force to replace it"
                raise FileExistsError(f"{path} exists already: {fix}")

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

    model: str = option(..., MODELS, "--model", "-m", metavar="MODEL")
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

    model: str = option("faces-64", MODELS, "--model", "-m", metavar="MODEL")

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
        output.check(out, folder=True)
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

    images: Annotated[list[Path], typer.Argument(help="Images, videos or their folders.", metavar="IMAGE...")]
    out: Path = option(Path("derender"), OUT_IMAGES, "--out", "-o", metavar="DIR|FILE")
    resume: bool = option(False, "Leave out images that are done.", "--resume")

    def __post_init__(self) -> None:
        places.require_image(self.images)

    @property
    def suffix(self) -> str:
        """Of ``--out`` where it names one file; else empty."""
        return single_suffix(self.out)

    def edit(self, opener: "ImageOpener", edit: Callable[..., Any], output: ImageOutput, **how: Any) -> None:
        """Edit, write and report every image; exit code 2 where one that was named cannot be read."""
        from derender.report.editing import write_image_file, write_images

        write = write_image_file if self.suffix else write_images
        how |= {"force": output.force, "resume": self.resume}
        with progress_bar("drawing", "images") as report:
            try:
                written = write(opener, self.images, self.out, edit, **how, progress=report)
            except KeyboardInterrupt:
                raise KeyboardInterrupt("stopped; finished images are kept: --resume continues") from None
        notice(*written.notes())
        count = places.counted(len(written.images), "images")
        output.result(f"wrote {self.out}" if self.suffix and written.images else f"{count} in {self.out}")
        output.write(written.values())
        if set(written.refused) & set(self.images):  # of a folder others were used
            raise typer.Exit(2)
