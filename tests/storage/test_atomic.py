"""Files and folders appear whole or not at all, and nothing is left beside them."""

import errno
import os

import pytest

from derender.storage.atomic import atomic_file, atomic_folder


def test_a_file_is_replaced_only_at_the_end(tmp_path):
    path = tmp_path / "deep" / "a.txt"
    with atomic_file(path) as temporary:
        temporary.write_text("one")
        assert not path.exists()
    assert path.read_text() == "one"
    with pytest.raises(RuntimeError, match="disk full"), atomic_file(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError("disk full")
    assert path.read_text() == "one"
    assert [entry.name for entry in path.parent.iterdir()] == ["a.txt"]
    assert path.stat().st_mode & 0o777 == 0o644


def test_a_folder_is_replaced_only_at_the_end(tmp_path):
    folder = tmp_path / "model"
    for content in ("one", "two"):
        with atomic_folder(folder) as temporary:
            (temporary / content).write_text(content)
        assert [entry.name for entry in folder.iterdir()] == [content]
    with pytest.raises(KeyboardInterrupt), atomic_folder(folder) as temporary:
        (temporary / "half").write_text("half")
        raise KeyboardInterrupt
    assert [entry.name for entry in folder.iterdir()] == ["two"]
    assert [entry.name for entry in tmp_path.iterdir()] == ["model"]


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path):
    for kind, target in (("file", tmp_path / "real"), ("folder", tmp_path / "elsewhere")):
        (link := tmp_path / f"link to {kind}").symlink_to(target.name)
        for content in ("one", "two"):  # the first time it leads to nothing
            with (atomic_file if kind == "file" else atomic_folder)(link) as temporary:
                (temporary if kind == "file" else temporary / "a").write_text(content)
            assert link.is_symlink() and link.exists() and not target.is_symlink()
            assert (target if kind == "file" else target / "a").read_text() == content
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize(("write", "maker"), [(atomic_file, "mkstemp"), (atomic_folder, "mkdtemp")])
def test_errors_name_the_place_that_was_asked_for(write, maker, tmp_path, monkeypatch):
    def denied(prefix, dir):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(dir / f"{prefix}x7"))

    monkeypatch.setattr(f"tempfile.{maker}", denied)
    with pytest.raises(PermissionError) as raised, write(tmp_path / "a"):
        pass
    assert raised.value.filename == str(tmp_path / "a")
