"""Which pictures a source holds, with labels, before any is decoded.

The source is a folder, a zip, one picture, or a table of paths (data/tables.py). ``SOURCE::SUBSET`` names
one part of a data set: ``synface64.zip::test_gt``, or any sub-folder of a plain folder.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from derender.data.layout import Layout, Table
from derender.data.registry import layout_named, recognise
from derender.data.source import SUFFIXES, Source, open_source
from derender.data.tables import TableSource, is_table


@dataclass(frozen=True)
class Inventory:
    """The pictures of an open source.

    Attributes:
        source: where to read them; whoever made the inventory closes it.
        subset: the part that was asked for, or None.
        layout: the layout they were read by.
        table: files, labels and official partition.
    """

    source: Source
    subset: str | None
    layout: Layout
    table: Table


def take_inventory(source: str | Path, *, dataset: str = "auto", subset: str | None = None) -> Inventory:
    """Open a source, recognise its layout (or take the one named), and read its labels.

    No picture at all is an error that says what is there instead. Close ``.source`` after use.
    """
    layout = None if dataset == "auto" else layout_named(dataset)
    path, named = parse_source(source)
    if named is not None and subset is not None and named != subset:
        raise ValueError(
            f"{source} names the subset {named!r}, but subset={subset!r} was given too; give one"
        )
    subset = named if subset is None else subset
    opened = TableSource(path) if is_table(path) else open_source(path)
    try:
        layout = layout or _recognised(opened)
        table = layout.read(opened, subset)
        if not table.files:
            raise ValueError(_nothing_found(opened))
        opened.remember()
    except BaseException:
        opened.close()
        raise
    return Inventory(opened, subset, layout, table)


def _recognised(source: Source) -> Layout:
    """The layout a source looks like, remembered in it."""
    layout = layout_named(source.recognised) if source.recognised else recognise(source)
    source.recognised = layout.name
    return layout


def parse_source(source: str | Path) -> tuple[Path, str | None]:
    """Split ``PATH::SUBSET`` into its two parts; a path that exists as written is taken as it is."""
    path = Path(source).expanduser()
    left, separator, right = str(path).rpartition("::")
    if not separator or path.exists():
        return path, None
    if not left or not right:
        raise ValueError(f"{source!s} should read PATH::SUBSET, with both parts")
    return Path(left), right


def _nothing_found(source: Source) -> str:
    """What was looked for, where, and what lies there instead."""
    kinds = Counter(PurePosixPath(file).suffix.lower() or "no suffix" for file in source.files)
    found = ", ".join(f"{count:,} of {kind}" for kind, count in kinds.most_common(5)) or "no files at all"
    hint = "; to read an archive in it, name that file itself" if ".zip" in kinds else ""
    if source.skipped:
        first = source.skipped[0]
        hint += f"; passed over {len(source.skipped):,}, the first is {first.file!r}: {first.reason}"
    return f"no pictures found in {source.path}: looked for {' '.join(SUFFIXES)}; found {found}{hint}"
