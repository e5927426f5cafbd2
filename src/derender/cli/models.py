"""`derender models`: the trained models that are bundled."""

from derender.cli import options
from derender.cli.console import result, write_json
from derender.cli.gathered import command


@command("models", "models --json models.json")
def models(json_file: options.Json = None) -> None:
    """List the bundled models: their names, sizes, and what each was trained on."""
    from derender.storage.places import bundled, bundled_models

    rows = [bundled(name) for name in bundled_models()]
    for row in rows:
        about = f"{row['image_size']} pixels, {row['megabytes']} MB. {row['about']}"
        result(f"{row['name']:<20}{about}", json_file)
    write_json(json_file, {"models": rows})
