"""`derender models` and `pack`: the models that are bundled, and one of your own in fewer bytes."""

from derender.cli.console import notice, progress_bar, result, write_json
from derender.cli.options import Json, OutModel, Output, PartOfImages, TrainedModel, command, option


@command("models", "models --json models.json")
def models(json_file: Json = None) -> None:
    """List the bundled models: their names, sizes, and what each was trained on."""
    from derender.storage.places import bundled, bundled_models

    rows = [bundled(name) for name in bundled_models()]
    for row in rows:
        about = f"{row['image_size']} pixels, {row['megabytes']} MB. {row['about']}"
        result(f"{row['name']:<20}{about}", json_file)
    write_json(json_file, {"models": rows})


@command("pack", "pack photos/ --model runs/mine --out mine")
def pack(
    images: PartOfImages, model: TrainedModel, out: OutModel, output: Output,
    maps: str = option("bytes", "Storage of the large maps of features: bytes or float16.", metavar="KIND"),
) -> None:  # fmt: skip
    """Write a copy of a model in fewer bytes: weights in float16, large maps in bytes or float16.

    Card, held-out errors and split are copied. With images, the loss of quality is measured on them.
    """
    from derender.evaluation.scenes import copy_cost
    from derender.inputs import as_model, copy_split
    from derender.storage.sharing import pack_model

    output.check(out, folder=True)
    original, chosen = model.open(), None
    if images.optional_address is not None:
        chosen = images.read(original.image_size, model=model.model, at_least=2)
    elif images != PartOfImages():
        raise ValueError("--dataset, --limit, --half and --part choose among images: give the images, too")
    sizes = pack_model(model.model, out, maps=maps, overwrite=output.force)
    copy_split(out, model.model)
    notice(f"{sizes['after'] / 1e6:,.2f} MB, before {sizes['before'] / 1e6:,.2f} MB")
    values = {"model": out, "bytes": sizes}
    if chosen is not None:
        copy = as_model(out, device=model.device)
        with progress_bar("comparing") as report:
            cost = copy_cost(original, copy, chosen.images, progress=report)
        moved = ", ".join(f"{name} {share:.2%}" for name, share in cost["moved"].items())
        notice(f"features moved, as a share of the distance between two images: {moved}")
        notice(f"reconstruction L1 {cost['l1']:.5f}, before {cost['l1_before']:.5f}")
        values |= {"pictures": len(chosen), "cost": cost}
    output.result(f"model {out}")
    output.write(values)
