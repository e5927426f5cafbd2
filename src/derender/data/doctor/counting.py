"""Findings about files and pixels: how many, how large, how often the same, how bright."""

from derender.data.doctor.findings import Finding, Level
from derender.data.doctor.limits import LIMITS
from derender.data.doctor.measures import Measures
from derender.data.doctor.originals import Originals


def percent(share: float) -> str:
    """A share as people say it; never 0 % for something or 100 % for less than all."""
    if 0 < share < 0.01:
        return "under 1 %"
    if 0.99 < share < 1:
        return "over 99 %"
    return f"{100 * share:.0f} %"


def count_of(number: int, noun: str) -> str:
    """``1 picture``, ``2,000 pictures``."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def sentence(text: str) -> str:
    """The text with a capital first letter."""
    return text[:1].upper() + text[1:]


def counting(measures: Measures, unreadable: int, originals: Originals | None) -> list[Finding]:
    """Every finding that needs no comparison of different pictures."""
    findings = [_number(measures), _copies(measures), _readable(measures, unreadable)]
    if originals is not None:
        findings.append(_sizes(originals))
    return [*findings, _brightness(measures), _colour(measures)]


def _number(measures: Measures) -> Finding:
    distinct = count_of(measures.distinct, "distinct picture")
    advice = "Add pictures: a few thousand different ones of the same kind of thing."
    if measures.distinct < LIMITS.distinct_objects:
        verb = "is" if measures.distinct == 1 else "are"
        return Finding(
            "number", "objection", f"{distinct}.", advice, f"{distinct} {verb} too few to learn from"
        )
    if measures.distinct < LIMITS.distinct_struggles:
        return Finding("number", "trouble", f"{distinct}.", advice, f"{distinct} are few")
    return Finding("number", "good", f"{distinct}.")


def _copies(measures: Measures) -> Finding:
    extra = measures.pictures - measures.distinct
    if not extra:
        return Finding("copies", "good", "No picture is a copy or near copy of another.")
    share = extra / measures.pictures
    text = (
        f"{extra:,} of {count_of(measures.pictures, 'picture')} ({percent(share)}) copy an earlier one: "
        f"{measures.identical:,} to the pixel, {measures.near_copies:,} nearly."
    )
    advice = (
        "Training drops copies to the pixel by itself; delete near copies, or some end up on both sides of "
        "the split."
    )
    if share > LIMITS.copies_struggles:
        return Finding("copies", "trouble", text, advice, f"{percent(share)} of the pictures are copies")
    return Finding("copies", "note", text, advice)


def _readable(measures: Measures, unreadable: int) -> Finding:
    if not unreadable:
        return Finding("files", "good", "Every file can be read.")
    files = unreadable + measures.pictures
    share = unreadable / files
    text = f"{unreadable:,} of {count_of(files, 'file')} ({percent(share)}) cannot be read."
    advice = "They are left out; the list of unreadable files says why."
    if share > LIMITS.unreadable_struggles:
        return Finding("files", "trouble", text, advice, f"{percent(share)} of the files cannot be read")
    return Finding("files", "note", text, advice)


def _sizes(originals: Originals) -> Finding:
    side = originals.image_size
    text = [
        f"Short sides have {originals.median_short:,} pixels in the median, {originals.smallest_short:,} at "
        f"least ({count_of(originals.sampled, 'file')} asked)."
    ]
    level: Level = "good"
    advice: list[str] = []
    short = ""
    if originals.oblong > LIMITS.note_share:
        level = "note"
        text.append(
            f"{sentence(percent(originals.oblong))} are far from square and are cropped to their middle."
        )
        advice.append("Look whether the thing is still in the picture, and crop around it if not.")
    if originals.smaller > LIMITS.note_share:
        level = "note"
        text.append(
            f"{sentence(percent(originals.smaller))} are smaller than {side} pixels and are enlarged."
        )
        advice.append("Enlarged pictures are blurred: find larger ones.")
    if originals.smaller > LIMITS.small_struggles:
        level, short = "trouble", f"{percent(originals.smaller)} of the files are smaller than {side} pixels"
    return Finding("sizes", level, " ".join(text), " ".join(advice), short)


def _brightness(measures: Measures) -> Finding:
    clipped, blank = measures.clipped, int(measures.pixels.blank.sum())
    text = [f"{sentence(percent(clipped))} of all pixels are black or white."]
    level: Level = "good"
    advice: list[str] = []
    short = ""
    if blank:
        level = "note"
        text.append(f"{count_of(blank, 'picture')} {'shows' if blank == 1 else 'show'} one brightness only.")
        advice.append("Delete empty pictures.")
    if clipped > LIMITS.note_share:
        level = "note"
        advice.append(
            "Where pixels are clipped no shading is left: see whether it is the thing or the background."
        )
    if clipped > LIMITS.clipped_struggles:
        level, short = "trouble", f"{percent(clipped)} of all pixels are black or white"
    return Finding("brightness", level, " ".join(text), " ".join(advice), short)


def _colour(measures: Measures) -> Finding:
    share = float(measures.pixels.colourless.mean())
    if share == 0:
        return Finding("colour", "good", "All pictures are in colour.")
    if share == 1:
        return Finding("colour", "note", "All pictures are grey; so will the albedo be.")
    text = f"{sentence(percent(share))} of the pictures are grey."
    if share <= LIMITS.note_share:
        return Finding("colour", "good", text)
    advice = "Features will tell grey from colour: leave the fewer out if that is in the way."
    return Finding("colour", "note", text, advice)
