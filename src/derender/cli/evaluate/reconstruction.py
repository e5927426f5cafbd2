"""`derender evaluate reconstruction`: how well are pictures rendered again?"""

import typer

from derender.cli import options
from derender.cli.console import bar, say, show_scores, write_json


def register(group: typer.Typer) -> None:
    group.command(
        "reconstruction",
        epilog="Example: derender evaluate reconstruction --model runs/faces --data photos/ --part test",
    )(reconstruction)


def reconstruction(
    model: options.Model,
    data: options.Data,
    dataset: options.Dataset = "auto",
    part: options.Part = "all",
    limit: options.Limit = None,
    batch_size: options.BatchSize = 64,
    device: options.Device = "auto",
    json_file: options.Json = None,
) -> None:
    """How well are pictures rendered again? L1, PSNR and SSIM inside the mask, beside the mean picture."""
    from derender.cli.models import open_model, part_of
    from derender.data import read_pictures
    from derender.evaluation import evaluate_reconstruction, mean_picture
    from derender.report.score_table import reconstruction_table

    net = open_model(model, device)
    with bar("reading") as report:
        pictures = read_pictures(data, net.image_size, dataset=dataset, limit=limit, progress=report)
    chosen = part_of(pictures, part, model)
    mean = mean_picture((pictures if part == "all" else part_of(pictures, "train", model)).images)
    with bar("rendering") as report:
        found = evaluate_reconstruction(net, chosen.images, mean=mean, batch_size=batch_size, progress=report)
    scores = reconstruction_table(found, len(chosen))
    show_scores(scores, json_file)
    say(f"the model is {scores.verdict(0)}")
    write_json(json_file, {"pictures": len(chosen), "part": part, "reconstruction": found})
