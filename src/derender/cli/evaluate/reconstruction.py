"""`derender evaluate reconstruction`: how well are pictures rendered again?"""

from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import bar, say
from derender.cli.gathered import gathered


def register(group: typer.Typer) -> None:
    group.command(
        "reconstruction",
        epilog="Example: derender evaluate reconstruction --model runs/faces --data photos/ --part test",
    )(reconstruction)


@gathered
def reconstruction(
    model: options.Model,
    data: options.Data,
    published: scoring.Published,
    dataset: options.Dataset = "auto",
    part: options.Part = "all",
    limit: options.Limit = None,
    batch_size: options.BatchSize = 64,
    store: Annotated[
        bool,
        typer.Option(
            "--store",
            help="Keep the errors with the model, to tell odd pictures: give pictures it did not see.",
        ),
    ] = False,
    device: options.Device = "auto",
) -> None:
    """How well are pictures rendered again? L1, PSNR and SSIM inside the mask, beside the mean picture."""
    published.check()
    from derender.cli.models import open_model, part_of
    from derender.data import read_pictures
    from derender.evaluation import evaluate_reconstruction, mean_picture
    from derender.model import model_folder
    from derender.report.score_table import reconstruction_table
    from derender.training.held_out_errors import errors_of, write_errors

    net = open_model(model, device)
    with bar("reading") as report:
        pictures = read_pictures(data, net.image_size, dataset=dataset, limit=limit, progress=report)
    chosen = part_of(pictures, part, model)
    mean = mean_picture((pictures if part == "all" else part_of(pictures, "train", model)).images)
    with bar("rendering") as report:
        found = evaluate_reconstruction(net, chosen.images, mean=mean, batch_size=batch_size, progress=report)
    scores = reconstruction_table(found, len(chosen))
    values = {"pictures": len(chosen), "part": part, "reconstruction": found}
    published.show([scores], values, [f"the model is {scores.verdict(0)}"])
    if store:
        kept = write_errors(model_folder(model), errors_of(net, chosen.images, batch_size))
        say(f"errors of {len(chosen):,} pictures kept in {kept}")
