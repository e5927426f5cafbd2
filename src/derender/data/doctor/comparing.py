"""Findings about what pictures share: whether they are aligned, of one kind, symmetric, and varied enough."""

from derender.data.doctor.counting import percent, sentence
from derender.data.doctor.estimate import Estimate
from derender.data.doctor.findings import Finding, Level, doubt, judged
from derender.data.doctor.limits import LIMITS
from derender.data.doctor.measures import FEWEST_COMPARED, Shared


def comparing(shared: Shared | None) -> list[Finding]:
    """Every finding that comes from comparing pictures; where they share nothing, the rest stays open."""
    if shared is None:
        text = (
            "Whether the pictures are aligned, of one kind, symmetric and varied was not measured: fewer "
            f"than {FEWEST_COMPARED} distinct ones show anything."
        )
        return [Finding("the rest", "open", text)]
    alignment = _alignment(shared)
    if shared.agreement.value < LIMITS.agreement_objects:
        text = (
            "Kinds, symmetry, crop, view and light cannot be judged where pictures have so little in common "
            "at the same place."
        )
        return [alignment, Finding("the rest", "open", text)]
    return [alignment, _kinds(shared), _odd(shared), _symmetry(shared), _crop(shared), *_variety(shared)]


def _alignment(shared: Shared) -> Finding:
    value = shared.agreement
    level, certain = judged(value, LIMITS.agreement_objects, LIMITS.agreement_struggles)
    measured = f"(agreement {value.text()}; 0 for unrelated pictures{doubt(certain)})"
    also = (
        f"The mean and eight components explain {percent(shared.explained)} of unseen pictures, "
        f"{percent(shared.explained_rolled)} once the pictures are moved about sideways."
    )
    if level == "good":
        text = f"The pictures show the same thing at the same place {measured}. {also}"
        return Finding("alignment", level, text, value=value)
    how = "almost nothing" if value.value < LIMITS.agreement_objects else "little"
    advice = (
        "Take pictures of one kind of thing, and crop them all alike: the same points (both eyes, both "
        "wheels) at the same place."
    )
    short = f"the pictures have {how} in common at the same place"
    text = f"{sentence(short)} {measured}: they are not aligned, or not one kind of thing. {also}"
    return Finding("alignment", level, text, advice, short, value)


def _kinds(shared: Shared) -> Finding:
    if shared.halves is None:
        return Finding("kinds", "open", "No two groups are large enough to compare.")
    value = shared.halves.kinship
    level, certain = judged(value, LIMITS.kinship_objects, None)
    measured = f"(kinship {value.text()}; 1 for one kind{doubt(certain)})"
    if level == "good":
        text = f"Even the two most different groups share their structure {measured}."
        return Finding("kinds", level, text, value=value)
    text = (
        f"The pictures fall into two groups with little in common {measured}; "
        f"the smaller one holds {percent(shared.halves.smaller)} of them."
    )
    advice = (
        "One model learns one kind of thing: look at the two groups and train on one, or on each by itself."
    )
    return Finding("kinds", level, text, advice, "they fall into two kinds of thing", value)


def _odd(shared: Shared) -> Finding:
    value = shared.odd
    above = value.value > LIMITS.odd_struggles
    certain = abs(value.value - LIMITS.odd_struggles) > 2 * value.error
    measured = f"(± {percent(2 * value.error)}{doubt(certain)})"
    short = f"{percent(value.value)} of the pictures are unlike the others"
    text = f"{sentence(short)} {measured}."
    if not above:
        return Finding("odd ones", "good", text, value=value)
    advice = "Look at the least typical ones and delete what does not belong."
    return Finding("odd ones", "trouble", text, advice, short, value)


def _symmetry(shared: Shared) -> Finding:
    value = shared.symmetry
    level, certain = judged(value, LIMITS.symmetry_objects, LIMITS.symmetry_struggles)
    measured = f"(symmetry {value.text()}; best 1{doubt(certain)})"
    if level == "good":
        return Finding("symmetry", level, f"On average left mirrors right {measured}.", value=value)
    if abs(shared.axis.offset) >= LIMITS.axis_struggles and shared.axis.correlation > LIMITS.axis_symmetric:
        text = f"The pictures are not symmetric about their middle {measured}. {_where(shared)}"
        return Finding(
            "symmetry", level, text, _shift(shared), "the axis of symmetry is off the middle", value
        )
    advice = (
        "The method explains each picture and its mirror image by one shape: add views from the other side, "
        "or mirror half of the pictures if all face one way."
    )
    text = f"On average left does not mirror right {measured}."
    return Finding(
        "symmetry", level, text, advice, "left does not mirror right (seen from one side only?)", value
    )


def _crop(shared: Shared) -> Finding:
    value = shared.fill
    level, certain = judged(value, None, LIMITS.fill_struggles)
    text = (
        f"What the pictures share covers {percent(value.value)} of the frame "
        f"(± {percent(2 * value.error)}{doubt(certain)})."
    )
    if level != "good":
        advice = "Crop more tightly: the thing should fill the frame and leave little background."
        return Finding("crop", level, text, advice, "the thing is small in the frame", value)
    if abs(shared.axis.offset) >= LIMITS.axis_struggles:
        text = f"{text} {_where(shared)}"
        return Finding("crop", "trouble", text, _shift(shared), "the crop is off the middle", value)
    return Finding("crop", level, text, value=value)


def _where(shared: Shared) -> str:
    side = "right" if shared.axis.offset > 0 else "left"
    return f"Their axis of symmetry lies {percent(abs(shared.axis.offset))} of the width {side} of it."


def _shift(shared: Shared) -> str:
    side = "right" if shared.axis.offset > 0 else "left"
    return f"Crop further to the {side}, so that the axis is in the middle."


def _variety(shared: Shared) -> list[Finding]:
    """View and light: where both are missing, nothing is left to learn a shape from; one alone is trouble."""
    no_view = shared.view.value + 2 * shared.view.error < LIMITS.view_flat
    level, certain = judged(shared.light, LIMITS.light_flat, LIMITS.light_struggles)
    if level == "objection" and not no_view:
        level = "trouble"
    return [_view(shared.view, level), _light(shared.light, level, certain)]


def _view(value: Estimate, light_level: Level) -> Finding:
    level, certain = judged(value, None, LIMITS.view_flat)
    measured = f"(variety {value.text()}; 0 all from the front, 1 from everywhere{doubt(certain)})"
    if level == "good":
        return Finding("view", level, f"The view varies {measured}.", value=value)
    level = "objection" if light_level == "objection" else level
    advice = "Add pictures with the thing turned left and right: depth shows by what moves."
    short = "all are seen from the same side"
    return Finding("view", level, f"{sentence(short)} {measured}.", advice, short, value)


def _light(value: Estimate, level: Level, certain: bool) -> Finding:
    measured = f"(side light varies by {value.text(3)}; 0 all lit alike{doubt(certain)})"
    if level == "good":
        return Finding("light", level, f"The light varies {measured}.", value=value)
    short = "all are lit alike" if value.value < LIMITS.light_flat else "the light varies little"
    advice = "Add pictures lit from the left and from the right: shading shows how the surface bends."
    return Finding("light", level, f"{sentence(short)} {measured}.", advice, short, value)
