"""Faces followed through a video: one folder of frames for each track, and who it shows.

Rendered tracks are ``tracks/IDENTITY/TRACK/FRAME.png`` with a params.csv (rendered.py). Real ones have two
forms: ``NAME.ids`` as published for The Big Bang Theory and Buffy (episodes bbt_s01e01..06 and
buffy_s05e01..06; github.com/makarandtapaswi/BallClustering_ICCV2019, after Baeuml et al., CVPR 2013): a
line ``CVHCI_TRACKLABELS_V1``, then a track's number and a name a line. The frames cannot be published; cut
them from the video into ``NAME/NUMBER/FRAME.jpg``, leading zeros as you like. ``NAME/`` may be left out
where there is one list only. Or, without a list, ``IDENTITY/TRACK/FRAME.jpg`` as in YouTube Faces, where
tracks and frames are numbered.

Every track of a list is read, background people (unknown_...) too; the paper used 568 tracks of six
people of buffy_s05e02 and 644 of five of bbt_s01e01. There is no official split.
"""

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

from derender.data.layouts.layout import (
    PARTITION_NAMES,
    Labels,
    Layout,
    Table,
    all_match,
    images_of,
    read_list,
    text_column,
)
from derender.data.layouts.rendered import parameters_of
from derender.data.source import Source

HOME = "https://github.com/makarandtapaswi/BallClustering_ICCV2019"

_HEADER = "CVHCI_TRACKLABELS_V1"
_NUMBERED = re.compile(
    r"(?:.*/)?(?P<identity>[^/]+)/(?P<track>(?:track[_-]?)?\d+)/(?:frame[_-]?)?\d[\d._-]*\.\w+"
)
_NESTED = re.compile(r"(?:.*/)?(?P<identity>[^/]+)/(?P<track>[^/]+)/[^/]+")
_RENDERED = re.compile(r"(?:.*/)?tracks/(?P<identity>[^/]+)/(?P<track>[^/]+)/[^/]+\.\w+")


def _is_tracks(source: Source) -> bool:
    """A list of tracks, or numbered frames in numbered tracks throughout, of two people or more."""
    if _lists(source):
        return bool(source.images)
    people: set[str] = set()
    for file in source.images:
        match = _NUMBERED.fullmatch(file)
        if match is None:
            return False
        people.add(match["identity"])
    return len(people - PARTITION_NAMES.keys()) > 1


def _lists(source: Source) -> dict[str, str]:
    """Each list's file by its name (the episode)."""
    found = {PurePosixPath(file).stem: file for file in reversed(source.files) if file.endswith(".ids")}
    return dict(sorted(found.items()))


def _read_tracks(source: Source, subset: str | None) -> Table:
    """Identity, track (unique in the whole set) and frame; the subset is an episode or a folder."""
    lists = _lists(source)
    files = images_of(source, subset)
    if lists:
        return Table(files, {**_listed(source, lists, files), **_frames(files)})
    error = (
        f"does not lie in IDENTITY/TRACK/, and there is no list of tracks NAME.ids (those of Buffy and The "
        f"Big Bang Theory are published at {HOME})"
    )
    return Table(files, _by_folders(all_match(source, files, _NESTED, error)) | _frames(files))


def _frames(files: Sequence[str]) -> Labels:
    return {"frame": text_column(PurePosixPath(file).stem for file in files)}


def _by_folders(matches: list[re.Match[str]]) -> Labels:
    return {
        "identity": text_column(match["identity"] for match in matches),
        "track": text_column(f"{match['identity']}/{match['track']}" for match in matches),
    }


def _listed(source: Source, lists: dict[str, str], files: tuple[str, ...]) -> Labels:
    people = {name: _people(source, file) for name, file in lists.items()}
    identities, tracks, episodes = [], [], []
    for file in files:
        folders = file.split("/")[:-1]
        only = next(iter(lists)) if len(lists) == 1 else ""
        episode = next((name for name in lists if name in folders), only)
        number = folders[-1] if folders else ""
        track = int(number) if episode and number.isdecimal() and number.isascii() else None
        identities.append("" if track is None else people[episode].get(track, ""))
        tracks.append("" if track is None else f"{episode}/{track}")
        episodes.append(episode)
    if files and not any(identities):
        name, first = next(iter(lists.items()))
        raise ValueError(
            f"none of the images in {source.path} lies in the folder of a track that {first} lists "
            f"(the first is {files[0]!r}): expected {name}/NUMBER/FRAME.jpg; the owners "
            f"publish numbers and names, not images ({HOME})"
        )
    columns = {"identity": identities, "track": tracks, "episode": episodes}
    return {name: text_column(column) for name, column in columns.items()}


def _people(source: Source, file: str) -> dict[int, str]:
    """The name of each track of one list."""
    expected = f"a first line {_HEADER}, then a track's number and a name a line, as at {HOME}"
    people: dict[int, str] = {}
    for line, (number, name) in read_list(source, file, r"(\d+) +(.+)", expected, _HEADER):
        if people.setdefault(int(number), name) != name:
            raise ValueError(f"{file} in {source.path}, line {line}: track {int(number)} has two names")
    return people


def _is_rendered(source: Source) -> bool:
    return bool(source.images) and all(_RENDERED.fullmatch(file) for file in source.images)


def _read_rendered(source: Source, subset: str | None) -> Table:
    """Identity and track from the folders, everything else from params.csv where it is there."""
    files = images_of(source, subset)
    matches = all_match(source, files, _RENDERED, "does not lie in tracks/IDENTITY/TRACK/")
    table = source.named("params.csv")
    labels = {} if table is None else parameters_of(source, table, files)[0]
    return Table(files, labels | _by_folders(matches) | _frames(files))


FACE_TRACKS = Layout(
    "face_tracks",
    "face tracks: NAME.ids and NAME/TRACK/FRAME (Buffy, Big Bang Theory), or IDENTITY/TRACK/FRAME",
    HOME,
    _is_tracks,
    _read_tracks,
    "lists for research; frames are the broadcasters', to be cut from one's own copy",
)
SYNFACE_TRACKS = Layout(
    "synface_tracks", "rendered tracks: tracks/IDENTITY/TRACK/FRAME", "", _is_rendered, _read_rendered
)
