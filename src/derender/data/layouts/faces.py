"""Published sets of faces: UTKFace, Labeled Faces in the Wild, Yale B, RAF-DB, CelebA, and faces in videos.

Their files are described in docs/reference/data-sets.md. Of Extended Yale B, ``yaleB01_P00A+035E-20.pgm`` has
the light at azimuth 35 degrees (positive lights the left of the image) and elevation -20. Images in ambient
light alone are left out, and crops are given room (data/image.py). Of RAF-DB the images before alignment and
the compound emotions are not read. Every track of a list is read, background people (unknown_...) too.

CelebA's lists are read as published and as CSV copies. Images in the wild get a square box about each face,
from a list of the user's own or from the landmarks: the box of CelebA-HQ without its rotation (Karras et al.,
Progressive Growing of GANs, 2018, appendix C). E is the eyes' middle, e their distance, M the middle of the
mouth's corners, m = |E - M|. The side is max(4 e, 3.6 m), the middle E + 0.1 (E - M). Masks of CelebAMask-HQ
come in parts as published, or merged. The owners' script for the official partition compares a count from
zero with CelebA's numbers, which start at one. Here an image is in the part in which CelebA has it.
"""

import re
from collections.abc import Mapping, Sequence
from posixpath import basename
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from derender.data.layouts import layout
from derender.data.layouts.layout import Labels, Table, read_csv, read_list, text_column
from derender.data.layouts.rendered import track_labels
from derender.data.source import Source, parent_name, stem_of

# In a few published names the race is missing, in one the gender.
UTK_NAME = re.compile(r"(?P<age>\d{1,3})_(?P<gender>\d?)_(?:(?P<race>\d)_)?\d{8,}")
_UTK_CODES = {"gender": ("male", "female"), "race": ("white", "black", "asian", "indian", "other")}
_UTK_OLDEST = 116

YALE_NAME = re.compile(r"(?P<identity>yaleB\d+)_(?P<pose>P\d\d)A(?P<a>[+-]\d+)E(?P<e>[+-]\d+)\.\w+")
LFW_NAME = re.compile(r"(?:.*/)?(?P<identity>[^/]+)/(?P=identity)_\d{4}\.\w+")

_RAF_LISTS = ("list_patition_label.txt", "list_partition_label.txt")
EMOTIONS = ("surprise", "fear", "disgust", "happiness", "sadness", "anger", "neutral")  # the owners' 1 to 7

_TRACKS_HEADER = "CVHCI_TRACKLABELS_V1"
_NUMBERED = re.compile(r"(?:.*/)?(?P<identity>[^/]+)/(?:track[_-]?)?\d+/(?:frame[_-]?)?\d[\d._-]*\.\w+")
_NESTED = re.compile(r"(?:.*/)?(?P<identity>[^/]+)/(?P<track>[^/]+)/[^/]+")


def load_utk(source: Source) -> Table | None:
    """Age, gender and race from the names; values outside the published codes count as unknown."""
    results = [UTK_NAME.match(basename(file)) for file in source.images]
    if source.images and not any(results):
        return None
    ages = [float(one["age"]) if one else np.nan for one in results]
    labels = {"age": np.array([age if age <= _UTK_OLDEST else np.nan for age in ages], np.float32)}
    for column, names in _UTK_CODES.items():
        by_code: dict[str, str] = dict(zip("01234", names, strict=False))
        labels[column] = text_column(by_code.get(one[column] or "", "") if one else "" for one in results)
    return Table(source.images, labels)


def load_yale(source: Source) -> Table:
    """Person, pose and light from the names; ``light_deg`` is the angle between light and view."""
    result = {file: match for file in source.images if (match := YALE_NAME.fullmatch(basename(file)))}
    azimuth, elevation = (np.array([float(one[name]) for one in result.values()]) for name in ("a", "e"))
    cosine = np.cos(np.radians(azimuth)) * np.cos(np.radians(elevation))
    labels = {name: text_column(one[name] for one in result.values()) for name in ("identity", "pose")}
    light = {"light_azimuth_deg": azimuth, "light_elevation_deg": elevation}
    light["light_deg"] = np.degrees(np.arccos(cosine)).round(3)
    return Table(tuple(result), labels | {name: one.astype(np.float32) for name, one in light.items()})


def load_lfw(source: Source) -> Table | None:
    """Identity from the folder; emotion from ``emotions.csv`` (file, emotion) where there is one."""
    files = source.images
    if not all("/" in file for file in files):
        return None
    part_of_person: dict[str, str] = {}
    for name, part in (("peopleDevTrain.txt", "train"), ("peopleDevTest.txt", "test")):
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
        labels["emotion"] = text_column(by_name.get(basename(file), "") for file in files)
    partition = text_column(part_of_person.get(person, "") for person in people) if part_of_person else None
    return Table(files, labels, partition)


def raf_list(source: Source) -> str | None:
    """The list of the basic set, shallowest first, or None."""
    results = [one for one in source.files if one.endswith(_RAF_LISTS) and "compound" not in one.split("/")]
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
    partition = text_column(part if part in ("train", "test") else "" for part in parts)
    return Table(files, {"emotion": text_column(emotions.get(name, "") for name in names)}, partition)


def is_tracks(source: Source) -> bool:
    """A list of tracks, or numbered frames in numbered tracks throughout, of two people or more."""
    if _track_lists(source):
        return bool(source.images)
    matches = [match for file in source.images if (match := _NUMBERED.fullmatch(file))]
    people = {match["identity"] for match in matches} - layout.PARTITION_NAMES.keys()
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
    home = layout.TOLD["face_tracks"]["home"]
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


MASK_CLASSES = (  # the owners' names by class number: eye_g are glasses, ear_r earrings, neck_l a necklace
    *("background", "skin", "nose", "eye_g", "l_eye", "r_eye", "l_brow", "r_brow", "l_ear", "r_ear"),
    *("mouth", "u_lip", "l_lip", "hair", "hat", "ear_r", "neck_l", "neck", "cloth"),
)
_PART = re.compile(rf"(?:(.*)/)?(\d+)_({'|'.join(MASK_CLASSES[1:])})\.png", re.DOTALL)

BOX_LIST = "boxes.csv"

_PARTITIONS = {"0": "train", "1": "validation", "2": "test"}
_IN_ORDER = np.array(["", *_PARTITIONS.values()])  # the parts are runs of image numbers, from these on
_FIRST_NUMBERS = (1, 162_771, 182_638)
_POINTS = [f"{name}_{axis}" for name in ("lefteye", "righteye", "leftmouth", "rightmouth") for axis in "xy"]
_SIZED, _SIDES = ("left", "top", "width", "height"), ("left", "top", "right", "bottom")


class _OwnersList(NamedTuple):
    where: str  # its file and place
    columns: Sequence[str]  # names of its values; none where it has no such line
    rows: Mapping[str, Sequence[str]]  # by image

    def numbers(self, columns: Sequence[str], names: Sequence[str]) -> Float32[np.ndarray, "n c"]:
        """These columns for the images of these names, NaN for one without a row."""
        if missing := [column for column in columns if column not in self.columns]:
            known = ", ".join(self.columns) or "unnamed"
            raise ValueError(f"{self.where} has no column {missing[0]!r}; its columns are {known}")
        places = [self.columns.index(column) for column in columns]
        unknown = ["nan"] * len(self.columns)
        try:
            rows = [[float(self.rows.get(name, unknown)[place]) for place in places] for name in names]
        except ValueError as problem:
            raise ValueError(f"{self.where} holds something that is no number ({problem})") from problem
        return np.array(rows, np.float32).reshape(len(names), len(columns))


def _owners_list(
    source: Source, stem: str, codes: Sequence[str] = (), meaning: str = ""
) -> _OwnersList | None:
    """The list of that name, as the original text or as a CSV copy, or None when neither is there."""
    if (file := source.named(f"{stem}.txt", f"{stem}.csv")) is None:
        return None
    where = f"{file} in {source.path}"
    comma = "," if file.endswith(".csv") else None
    lines = [line.strip() for line in source.read_text(file).split("\n")]
    counted = comma is None and lines[0].isdecimal()
    head = 2 if counted else 1 if comma else 0
    if len(lines) <= head or not lines[head]:
        raise ValueError(f"{where} is cut short: expected rows below the names of its columns")
    columns = lines[head - 1].split(comma) if head else []
    if columns and (comma or columns[0] == "image_id"):
        columns = columns[1:]
    rows, count = {}, len(columns) or 1
    for number, line in enumerate(lines[head:], head + 1):
        name, *values = line.split(comma) or [""]
        if line and (len(values) != count or (codes and not set(values) <= set(codes))):
            expected = f"a name and {count} values{meaning}"
            raise ValueError(f"{where}, line {number}: expected {expected}, got {line[:80]!r}")
        if line:
            rows[name] = values
    if counted and len(rows) < int(lines[0]):
        what = f"its first line says {int(lines[0]):,} rows and it has {len(rows):,}"
        raise ValueError(f"{where} is cut short: {what}; copy it again, or correct that line")
    return _OwnersList(where, columns, rows)


def _attributes(source: Source, stem: str, names: Sequence[str]) -> Labels:
    """Every attribute as 1 yes, 0 no, -1 unknown (no row) for these images; none without the list."""
    if (listed := _owners_list(source, stem, ("-1", "0", "1"), " of -1 or 1")) is None:
        return {}
    rows = {name: np.array([value == "1" for value in row], np.int8) for name, row in listed.rows.items()}
    unknown = np.full(len(listed.columns), -1, np.int8)
    values = np.array([rows.get(name, unknown) for name in names], np.int8).reshape(len(names), -1)
    return {column: values[:, place].copy() for place, column in enumerate(listed.columns)}


def is_celeba(source: Source) -> bool:
    return source.named("list_attr_celeba.txt", "list_attr_celeba.csv") is not None


def load_celeba(source: Source) -> Table | None:
    """Attributes, and identity and the official partition where their lists are there; boxes in the wild."""
    if not is_celeba(source) or not source.images:
        return None
    aligned, wild = (
        tuple(file for file in source.images if folder in file.split("/")[:-1])
        for folder in ("img_align_celeba", "img_celeba")
    )
    files = aligned or wild or source.images
    names = [basename(file) for file in files]
    labels, partition = _attributes(source, "list_attr_celeba", names), None
    if (listed := _owners_list(source, "identity_CelebA")) is not None:
        labels["identity"] = text_column(listed.rows.get(name, [""])[0] for name in names)
    meaning = " of 0 (train), 1 (validation) or 2 (test)"
    if (listed := _owners_list(source, "list_eval_partition", tuple(_PARTITIONS), meaning)) is not None:
        partition = text_column(_PARTITIONS.get(listed.rows.get(name, [""])[0], "") for name in names)
    boxes = _face_boxes(source, names) if wild and not aligned else None
    return Table(files, labels, partition, boxes)


def _face_boxes(source: Source, names: Sequence[str]) -> Float32[np.ndarray, "n 4"]:
    """A box about each face in the wild (left, top, right, bottom); NaN for an image without landmarks."""
    own, landmarks = source.named(BOX_LIST), _owners_list(source, "list_landmarks_celeba")
    if own is not None:
        return _own_boxes(source, own, names)
    if landmarks is None:
        what = "CelebA's images in the wild (img_celeba), but no list_landmarks_celeba.txt"
        why = f"which says where faces are. The owners publish it at {layout.TOLD['celeba']['home']}"
        fix = f"A list of your own may stand in for it: {BOX_LIST}, with rows of file,{','.join(_SIZED)}"
        raise ValueError(f"{source.path} holds {what}, {why}. {fix}")
    points = landmarks.numbers(_POINTS, names).reshape(-1, 4, 2)
    eyes, mouth = points[:, :2].mean(axis=1), points[:, 2:].mean(axis=1)
    apart = np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
    down = np.linalg.norm(eyes - mouth, axis=1)
    middle, half = eyes + 0.1 * (eyes - mouth), np.maximum(4 * apart, 3.6 * down)[:, None] / 2
    return np.concatenate([middle - half, middle + half], axis=1).astype(np.float32)


def _own_boxes(source: Source, file: str, names: Sequence[str]) -> Float32[np.ndarray, "n 4"]:
    """The boxes of a list that the user made; an image without a row or with an empty box is an error."""
    columns = _SIZED if "width" in layout.header_of(source, file) else _SIDES
    rows = read_csv(source, file, ("file", *columns))
    by_name = {basename(row["file"]): [row[column] for column in columns] for row in rows}
    listed = _OwnersList(f"{file} in {source.path}", columns, by_name)
    if missing := [name for name in names if name not in listed.rows]:
        first = f"{missing[0]} ({len(missing):,} of {len(names):,} images have none)"
        fix = "add the rows, or move these images or the list out of the folder"
        raise ValueError(f"{listed.where} has no row for {first}: {fix}")
    boxes = listed.numbers(columns, names)
    if columns == _SIZED:
        boxes[:, 2:] += boxes[:, :2]
    if not (has_area := (boxes[:, 2:] > boxes[:, :2]).all(axis=1)).all():
        raise ValueError(f"{listed.where}: the box of {names[int(has_area.argmin())]} has no area")
    return boxes


def parts_of(source: Source) -> dict[str, dict[int, str]]:
    """The files of every mask in parts, by class number, under the mask's name (FOLDER/NUMBER_*.png)."""
    result: dict[str, dict[int, str]] = {}
    for match in filter(None, map(_PART.fullmatch, source.files)):
        folder, digits, part = match.groups(default="")
        result.setdefault(f"{folder}/{digits}_*.png", {})[MASK_CLASSES.index(part)] = match[0]
    return result


def mask_names(source: Source) -> dict[str, str]:
    """By image its mask, "" where there is none: a file, or FOLDER/NUMBER_*.png for one in parts."""
    merged = {file for file in source.files if file.endswith(".png") and parent_name(file) == "masks"}
    in_parts = {int(basename(name).removesuffix("_*.png")): name for name in parts_of(source)}
    names = {}
    for file in source.images_in("CelebA-HQ-img") or source.images_in("images"):
        stem, folders = stem_of(file), file.split("/")[:-2]
        number = int(stem) if stem.isdecimal() and stem.isascii() else -1
        beside = "/".join([*folders, "masks", f"{stem}.png"])
        names[file] = beside if beside in merged else in_parts.get(number, "")
    return names


def load_celebamask(source: Source) -> Table | None:
    """The label ``mask`` names each mask ("" for none); attributes and parts where their lists are there."""
    if not any((masks := mask_names(source)).values()):
        return None
    names = [basename(file) for file in masks]
    labels, partition = _attributes(source, "CelebAMask-HQ-attribute-anno", names), None
    if (mapping := source.named("CelebA-HQ-to-CelebA-mapping.txt")) is not None:
        expected, header = "idx orig_idx orig_file, as in 0 119613 119614.jpg", r"idx\s+orig_idx\s+orig_file"
        rows = read_list(source, mapping, r"(\d+)\s+\S+\s+(\d+)(?:\.\w+)?", expected, header)
        origins = {f"{int(number)}.jpg": int(origin) for _, (number, origin) in rows}
        numbers = [origins.get(name, 0) for name in names]
        partition = _IN_ORDER[np.searchsorted(_FIRST_NUMBERS, numbers, "right")]
    return Table(tuple(masks), {"mask": text_column(masks.values()), **labels}, partition)
