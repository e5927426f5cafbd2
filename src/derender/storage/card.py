"""A model's card: the README.md that says what a model is, what made it and what it may be used for.

Made from what is known; what nobody said stands there as not stated. Leaves out measuring anything.
"""

import json

CARD_FILE = "README.md"
NOT_STATED = "not stated"


def model_card(
    title: str,
    description: str,
    *,
    data: str | None = None,
    licence: str | None = None,
    scores: str | None = None,
    held_out: str | None = None,
) -> str:
    """The card of one model as Markdown.

    Args:
        title: what the model is called.
        description: one sentence: what the model does, its sizes and ranges.
        data: what it was trained on.
        licence: what it may be used for.
        scores: what was measured.
        held_out: its reconstruction errors (JSON), whose middle and 99th percentile are told.
    """
    measured = [text for text in (scores, _held_out(held_out)) if text]
    parts = {
        "Trained on": data,
        "Scores": " ".join(measured),
        "Licence": licence,
    }
    return "\n\n".join(
        [
            f"# {title}",
            description,
            f'```python\nimport derender\n\nmodel = derender.load("{title}")\n```',
            *(f"**{name}**: {text or NOT_STATED}" for name, text in parts.items()),
        ]
    ) + "\n"  # fmt: skip


def with_metadata(card: str, licence: str | None = None) -> str:
    """The card headed by what the Hub files it under, unless it has a head of its own."""
    if card.startswith("---"):
        return card
    tags = "library_name: derender\ntags: [inverse-rendering, disentanglement]\n"
    named = f"license: {json.dumps(licence.lower())}\n" if licence and _is_short_name(licence) else ""
    return f"---\n{tags}{named}---\n\n{card}"


def _is_short_name(licence: str) -> bool:
    """Whether this is a licence's short name, such as MIT, and no sentence."""
    return len(licence) <= 32 and " " not in licence


def _held_out(errors: str | None) -> str:
    if errors is None:
        return ""
    try:
        told = json.loads(errors)
        quantiles, pictures = [float(value) for value in told["quantiles"]], int(told["pictures"])
        middle, high = quantiles[50], quantiles[99]
    except (ValueError, LookupError, TypeError):
        return ""
    return (
        f"Rendered again, {pictures:,} pictures it was not trained on give a masked L1 of {middle:.4f} in "
        f"the middle and {high:.4f} at the 99th percentile (0..1, best 0)."
    )
