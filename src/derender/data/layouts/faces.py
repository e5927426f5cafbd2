"""Real faces: UTKFace, Labeled Faces in the Wild, Yale B, RAF-DB, and faces followed through a video.

Their files are described in docs/reference/data-sets.md. Of Extended Yale B, ``yaleB01_P00A+035E-20.pgm`` has
the light at azimuth 35 degrees (positive lights the left of the image) and elevation -20. Images in ambient
light alone are left out, and crops are given room (data/image.py). Of RAF-DB the images before alignment and
the compound emotions are not read. Every track of a list is read, background people (unknown_...) too.
"""

import re

import numpy as np

from derender.data.layouts.layout import (
    PARTITION_NAMES,
    TOLD,
    Labels,
    Table,
    base_name,
    number_column,
    parent_name,
    read_csv,
    read_list,
    stem_of,
    text_column,
)
from derender.data.layouts.rendered import track_labels
from derender.data.source import Source

# In a few published names the race is missing, in one the gender.
UTK_NAME = re.compile(r"(?P<age>\d{1,3})_(?P<gender>\d?)_(?:(?P<race>\d)_)?\d{8,}")
_UTK_CODES = {"gender": ("male", "female"), "race": ("white", "black", "asian", "indian", "other")}
_UTK_OLDEST = 116

YALE_NAME = re.compile(r"(?P<identity>yaleB\d+)_(?P<pose>P\d\d)A(?P<a>[+-]\d+)E(?P<e>[+-]\d+)\.\w+")
LFW_NAME = re.compile(r"(?:.*/)?(?P<identity>[^/]+)/(?P=identity)_\d{4}\.\w+")
_LFW_PARTS = {"peopleDevTrain.txt": "train", "peopleDevTest.txt": "test"}

_RAF_LISTS = ("list_patition_label.txt", "list_partition_label.txt")
EMOTIONS = ("surprise", "fear", "disgust", "happiness", "sadness", "anger", "neutral")
"""In the owners' order: 1 is surprise, 7 neutral."""

_TRACKS_HEADER = "CVHCI_TRACKLABELS_V1"
_NUMBERED = re.compile(
    r"(?:.*/)?(?P<identity>[^/]+)/(?P<track>(?:track[_-]?)?\d+)/(?:frame[_-]?)?\d[\d._-]*\.\w+"
)
_NESTED = re.compile(r"(?:.*/)?(?P<identity>[^/]+)/(?P<track>[^/]+)/[^/]+")


def load_utkface(source: Source) -> Table | None:
    """Age, gender and race from the names; values outside the published codes count as unknown."""
    results = [UTK_NAME.match(base_name(file)) for file in source.images]
    if source.images and not any(results):
        return None
    ages = [float(one["age"]) if one else np.nan for one in results]
    labels = {"age": number_column(age if age <= _UTK_OLDEST else np.nan for age in ages)}
    for column, names in _UTK_CODES.items():
        by_code = dict(zip("01234", names, strict=False))
        labels[column] = text_column(by_code.get(one[column] or "", "") if one else "" for one in results)
    return Table(source.images, labels)


def load_yale(source: Source) -> Table:
    """Person, pose and light from the names; ``light_deg`` is the angle between light and view."""
    result = {file: match for file in source.images if (match := YALE_NAME.fullmatch(base_name(file)))}
    azimuth, elevation = (np.array([float(one[name]) for one in result.values()]) for name in ("a", "e"))
    cosine = np.cos(np.radians(azimuth)) * np.cos(np.radians(elevation))
    labels = {name: text_column(one[name] for one in result.values()) for name in ("identity", "pose")}
    labels |= {"light_azimuth_deg": number_column(azimuth), "light_elevation_deg": number_column(elevation)}
    labels["light_deg"] = number_column(np.degrees(np.arccos(cosine)).round(3))
    return Table(tuple(result), labels)


def load_lfw(source: Source) -> Table | None:
    """Identity from the folder; emotion from ``emotions.csv`` (file, emotion) where there is one."""
    files = source.images
    if not all("/" in file for file in files):
        return None
    part_of_person: dict[str, str] = {}
    for name, part in _LFW_PARTS.items():
        if (file := source.named(name)) is not None:
            expected = "the number of people, then a name and a number of images a line"
            rows = read_list(source, file, r"(.+?)\s+\d+", expected, header=r"\d+")
            count = int(source.read_text(file).split("\n", 1)[0])
            if len(rows) != count:
                raise ValueError(f"{file} in {source.path} is cut short: {len(rows)} people of {count}")
            part_of_person |= {person: part for _, (person,) in rows}
    people = [parent_name(file) for file in files]
    labels = {"identity": text_column(people)}
    if (emotions := source.named("emotions.csv")) is not None:
        by_name = {row["file"]: row["emotion"] for row in read_csv(source, emotions, ("file", "emotion"))}
        labels["emotion"] = text_column(by_name.get(base_name(file), "") for file in files)
    partition = text_column(part_of_person.get(person, "") for person in people) if part_of_person else None
    return Table(files, labels, partition)


def raf_list(source: Source) -> str | None:
    """The list of the basic set, shallowest first, or None."""
    results = [
        file for file in source.files if file.endswith(_RAF_LISTS) and "compound" not in file.split("/")
    ]
    return min(results, key=lambda file: (file.count("/"), file), default=None)


def load_rafdb(source: Source) -> Table | None:
    """Emotions from the owners' list, the part from an image's name."""
    file = raf_list(source)
    files = tuple(name for name in source.images if stem_of(name).endswith("_aligned"))
    if file is None or not files:
        return None
    expected = f"an image and an emotion from 1 ({EMOTIONS[0]}) to {len(EMOTIONS)} ({EMOTIONS[-1]})"
    rows = read_list(source, file, rf"(\S.*) ([1-{len(EMOTIONS)}])", expected)
    emotions = {stem_of(name.strip()): EMOTIONS[int(code) - 1] for _, (name, code) in rows}
    names = [stem_of(name).removesuffix("_aligned") for name in files]
    if not emotions.keys() & set(names):
        raise ValueError(f"{file} in {source.path} names none of its images; the first is {files[0]!r}")
    parts = (name.partition("_")[0] for name in names)
    return Table(
        files,
        {"emotion": text_column(emotions.get(name, "") for name in names)},
        text_column(part if part in ("train", "test") else "" for part in parts),
    )


def is_tracks(source: Source) -> bool:
    """A list of tracks, or numbered frames in numbered tracks throughout, of two people or more."""
    if _track_lists(source):
        return bool(source.images)
    matches = [match for file in source.images if (match := _NUMBERED.fullmatch(file))]
    people = {match["identity"] for match in matches} - PARTITION_NAMES.keys()
    return len(matches) == len(source.images) and len(people) > 1


def _track_lists(source: Source) -> dict[str, str]:
    """Each list's file by its name (the episode)."""
    result = {stem_of(file): file for file in reversed(source.files) if file.endswith(".ids")}
    return dict(sorted(result.items()))


def load_tracks(source: Source) -> Table | None:
    """Identity, track (unique in the whole set) and frame, by lists or by folders."""
    files, lists = source.images, _track_lists(source)
    if lists:
        labels = _listed_tracks(source, lists)
        return Table(files, labels) if not files or any(labels["identity"]) else None
    labels = track_labels(files, _NESTED)
    return None if labels is None else Table(files, labels)


def _listed_tracks(source: Source, lists: dict[str, str]) -> Labels:
    home = TOLD["face_tracks"]["home"]
    expected = f"a first line {_TRACKS_HEADER}, then a track's number and a name a line, as at {home}"
    people: dict[tuple[str, int], str] = {}
    for episode, file in lists.items():
        for line, (number, name) in read_list(source, file, r"(\d+) +(.+)", expected, _TRACKS_HEADER):
            if people.setdefault((episode, int(number)), name) != name:
                raise ValueError(f"{file} in {source.path}, line {line}: track {int(number)} has two names")
    rows = []
    for file in source.images:
        folders = file.split("/")[:-1]
        episode = next((name for name in lists if name in folders or len(lists) == 1), "")
        known, number = ("", ""), folders[-1] if folders else ""
        if episode and number.isdecimal() and number.isascii():
            known = people.get((episode, int(number)), ""), f"{episode}/{int(number)}"
        rows.append((*known, episode, stem_of(file)))
    columns = np.array(rows, np.str_).reshape(-1, 4).T
    return dict(zip(("identity", "track", "episode", "frame"), columns, strict=True))
