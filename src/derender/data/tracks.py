"""Faces followed through a video: one folder of frames for each track, and who it shows.

Two forms. ``NAME.ids`` as published for The Big Bang Theory and Buffy (episodes bbt_s01e01..06 and
buffy_s05e01..06; github.com/makarandtapaswi/BallClustering_ICCV2019, after Baeuml et al., CVPR 2013): a
line ``CVHCI_TRACKLABELS_V1``, then a track's number and a name a line. The frames cannot be published;
cut them from the video into ``NAME/NUMBER/FRAME.jpg``, leading zeros as you like. ``NAME/`` may be left
out where there is one list only. Or, without a list, ``IDENTITY/TRACK/FRAME.jpg`` as in YouTube Faces,
where tracks and frames are numbered.

Every track of a list is read, background people (unknown_...) too; the paper used 568 tracks of six
people of buffy_s05e02 and 644 of five of bbt_s01e01. There is no official split.
"""

import re
from pathlib import PurePosixPath

from derender.data.layout import PARTITION_NAMES, Labels, Layout, Table, pictures_of, text_column
from derender.data.source import Source

HOME = "https://github.com/makarandtapaswi/BallClustering_ICCV2019"

_HEADER = "CVHCI_TRACKLABELS_V1"
_NUMBERED = re.compile(
    r"(?:.*/)?(?P<identity>[^/]+)/(?P<track>(?:track[_-]?)?\d+)/(?:frame[_-]?)?\d[\d._-]*\.\w+"
)
_NESTED = re.compile(r"(?:.*/)?(?P<identity>[^/]+)/(?P<track>[^/]+)/[^/]+")


def _is_tracks(source: Source) -> bool:
    """A list of tracks, or numbered frames in numbered tracks throughout, of two people or more."""
    if _lists(source):
        return bool(source.pictures)
    people: set[str] = set()
    for file in source.pictures:
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
    files = pictures_of(source, subset)
    labels = _listed(source, lists, files) if lists else _nested(source, files)
    labels["frame"] = text_column(PurePosixPath(file).stem for file in files)
    return Table(files, labels)


def _listed(source: Source, lists: dict[str, str], files: tuple[str, ...]) -> Labels:
    people = {name: _people(source, file) for name, file in lists.items()}
    identities, tracks, episodes = [], [], []
    for file in files:
        folders = PurePosixPath(file).parts[:-1]
        only = next(iter(lists)) if len(lists) == 1 else ""
        episode = next((name for name in lists if name in folders), only)
        number = folders[-1] if folders else ""
        track = int(number) if number.isdecimal() and number.isascii() else None
        identities.append(people[episode].get(track, "") if episode and track is not None else "")
        tracks.append(f"{episode}/{track}" if episode and track is not None else "")
        episodes.append(episode)
    if files and not any(identities):
        first = next(iter(lists.values()))
        raise ValueError(
            f"none of the pictures in {source.path} lies in the folder of a track that {first} lists "
            f"(the first is {files[0]!r}): expected {next(iter(lists))}/NUMBER/FRAME.jpg; the owners "
            f"publish numbers and names, not pictures ({HOME})"
        )
    return {
        "identity": text_column(identities),
        "track": text_column(tracks),
        "episode": text_column(episodes),
    }


def _people(source: Source, file: str) -> dict[int, str]:
    """The name of each track of one list."""
    lines = source.read_text(file).splitlines()
    if not lines or lines[0].strip() != _HEADER:
        raise ValueError(
            f"{file} in {source.path} is no list of tracks: expected the first line {_HEADER}, as at {HOME}"
        )
    people: dict[int, str] = {}
    for number, line in enumerate(lines[1:], 2):
        track, _, name = line.strip().partition(" ")
        if not line.strip():
            continue
        if not track.isdecimal() or not name.strip():
            raise ValueError(
                f"{file} in {source.path}, line {number}: expected a track's number and a name, got {line!r}"
            )
        if people.setdefault(int(track), name.strip()) != name.strip():
            raise ValueError(f"{file} in {source.path}, line {number}: track {int(track)} has two names")
    return people


def _nested(source: Source, files: tuple[str, ...]) -> Labels:
    found = [_NESTED.fullmatch(file) for file in files]
    stray = next((file for file, match in zip(files, found, strict=True) if match is None), None)
    if stray is not None:
        raise ValueError(
            f"{source.path} is no set of face tracks: {stray} does not lie in IDENTITY/TRACK/, and there "
            f"is no list of tracks NAME.ids (those of Buffy and The Big Bang Theory are published at {HOME})"
        )
    matches = [match for match in found if match is not None]
    return {
        "identity": text_column(match["identity"] for match in matches),
        "track": text_column(f"{match['identity']}/{match['track']}" for match in matches),
    }


FACE_TRACKS = Layout(
    "face_tracks",
    "face tracks: NAME.ids and NAME/TRACK/FRAME (Buffy, Big Bang Theory), or IDENTITY/TRACK/FRAME",
    HOME,
    _is_tracks,
    _read_tracks,
    "lists for research; frames are the broadcasters', to be cut from one's own copy",
)
