"""`derender evaluate`: one protocol a command, each beside its controls.

One file per protocol; a new one gets a ``register`` of its own and a place in ``PROTOCOLS``.
"""

import typer

from derender.cli.evaluate import cluster, disentangle, geometry, linear, reconstruction, robustness, segment

PROTOCOLS = (
    cluster,
    linear,
    segment,
    disentangle,
    geometry,
    reconstruction,
    robustness,
)


def register(app: typer.Typer) -> None:
    group = typer.Typer(help="Score features or a model, beside controls.", no_args_is_help=True)
    for protocol in PROTOCOLS:
        protocol.register(group)
    app.add_typer(group, name="evaluate")
