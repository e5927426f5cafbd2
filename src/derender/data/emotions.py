"""RAF-DB, the basic set: 15,339 aligned faces, each with one of seven emotions, and the official split.

As published: ``basic/Image/aligned/train_00001_aligned.jpg`` (100 x 100) and
``basic/EmoLabel/list_patition_label.txt``, spelt so, with a line ``train_00001.jpg 5`` for each picture;
the name says the part (12,271 train, 3,068 test). The pictures before alignment and the set of compound
emotions are not read.
"""

from pathlib import PurePosixPath

from derender.data.layout import Layout, Table, part_of, text_column
from derender.data.source import Source

HOME = "http://www.whdeng.cn/raf/model1.html"
EMOTIONS = ("surprise", "fear", "disgust", "happiness", "sadness", "anger", "neutral")
"""In the owners' order: 1 is surprise, 7 neutral."""

_LISTS = ("list_patition_label.txt", "list_partition_label.txt")


def _is_raf(source: Source) -> bool:
    return _list_of(source) is not None


def _list_of(source: Source) -> str | None:
    """The list of the basic set, shallowest first, or None."""
    found = [
        file for file in source.files if file.endswith(_LISTS) and not {"compound"} & set(file.split("/"))
    ]
    return min(found, key=lambda file: (file.count("/"), file), default=None)


def _read_raf(source: Source, subset: str | None) -> Table:
    file = _list_of(source)
    if file is None:
        raise ValueError(
            f"{source.path} has no EmoLabel/list_patition_label.txt (the owners' spelling), as RAF-DB's "
            f"basic set has; the owners send the set on request: {HOME}"
        )
    emotions = _emotions(source, file)
    files = tuple(name for name in source.pictures if PurePosixPath(name).stem.endswith("_aligned"))
    if not files:
        raise ValueError(
            f"{source.path} has RAF-DB's list of emotions and no aligned pictures: expected "
            f"Image/aligned/train_00001_aligned.jpg; unpack aligned.zip into a folder of its name"
        )
    names = [PurePosixPath(name).stem.removesuffix("_aligned") for name in files]
    if not emotions.keys() & set(names):
        raise ValueError(f"{file} in {source.path} names none of its pictures; the first is {files[0]!r}")
    parts = (name.partition("_")[0] for name in names)
    table = Table(
        files,
        {"emotion": text_column(emotions.get(name, "") for name in names)},
        text_column(part if part in ("train", "test") else "" for part in parts),
    )
    return part_of(table, source, subset, "a name such as test_0001_aligned.jpg")


def _emotions(source: Source, file: str) -> dict[str, str]:
    """The emotion of each picture, by its name without suffix."""
    emotions = {}
    for number, line in enumerate(source.read_text(file).splitlines(), 1):
        if not line.strip():
            continue
        name, _, code = line.strip().rpartition(" ")
        if not name or not code.isdecimal() or not 1 <= int(code) <= len(EMOTIONS):
            raise ValueError(
                f"{file} in {source.path}, line {number}: expected a picture and an emotion from 1 "
                f"({EMOTIONS[0]}) to {len(EMOTIONS)} ({EMOTIONS[-1]}), got {line.strip()!r}"
            )
        emotions[PurePosixPath(name.strip()).stem] = EMOTIONS[int(code) - 1]
    return emotions


RAFDB = Layout(
    "rafdb",
    "RAF-DB: faces with one of seven emotions",
    HOME,
    _is_raf,
    _read_raf,
    "non-commercial research only, on request",
)
