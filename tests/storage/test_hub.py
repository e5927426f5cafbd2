"""Released models: what save_pretrained writes, what reaches the Hub, what comes back, what is refused."""

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import derender
from derender.model import Derenderer
from derender.storage import hub
from derender.storage.folder import ERRORS_FILE
from derender.training.held_out_errors import HeldOutErrors, read_errors, write_errors


@pytest.fixture
def model() -> Derenderer:
    return Derenderer.from_preset("small", seed=0, image_size=32, width=8, light_width=4).eval()


@dataclass
class RepoUrl:
    repo_id: str

    def __str__(self) -> str:
        return f"https://huggingface.co/{self.repo_id}"


@dataclass
class FakeHub:
    """A Hub in a folder: repositories by name, with what was asked of it."""

    place: Path
    asked: list[dict[str, Any]] = field(default_factory=list)
    fails: Exception | None = None

    def create_repo(self, repo_id: str, **options: Any) -> RepoUrl:
        if self.fails is not None:
            raise self.fails
        self.asked.append({"repo_id": repo_id, **options})
        return RepoUrl(repo_id if "/" in repo_id else f"me/{repo_id}")

    def upload_folder(self, *, repo_id: str, folder_path: Path, commit_message: str) -> None:
        self.asked.append({"uploaded": repo_id, "message": commit_message})
        shutil.copytree(folder_path, self.place / repo_id, dirs_exist_ok=True)

    def snapshot_download(self, repository: str, allow_patterns: list[str]) -> str:
        here = self.place / repository
        there = self.place / "cache" / repository
        there.mkdir(parents=True)
        for file in here.iterdir():
            if file.name in allow_patterns:
                shutil.copy(file, there)
        return str(there)


@pytest.fixture
def fake(tmp_path, monkeypatch) -> FakeHub:
    import huggingface_hub

    made = FakeHub(tmp_path / "hub")
    made.place.mkdir()
    monkeypatch.setattr(hub, "client", lambda token: made)
    monkeypatch.setattr(huggingface_hub, "snapshot_download", made.snapshot_download)
    return made


def images() -> torch.Tensor:
    return torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))


def with_errors(folder: Path) -> Path:
    return write_errors(folder, HeldOutErrors(np.linspace(0.01, 0.11, 101), 1234))


def test_a_pushed_model_comes_back_the_same(model, fake):
    address = model.push_to_hub("me/faces", data="my own images", licence="MIT", private=True)
    assert address == "https://huggingface.co/me/faces"
    assert fake.asked[0] == {"repo_id": "me/faces", "private": True, "exist_ok": True}
    assert fake.asked[1]["uploaded"] == "me/faces"
    names = {file.name for file in (fake.place / "me" / "faces").iterdir()}
    assert names == {"model.safetensors", "config.json", "README.md"}
    back = Derenderer.from_pretrained("me/faces")
    for name, feature in model.embed(images()).items():
        torch.testing.assert_close(back.embed(images())[name], feature, rtol=0, atol=0)


def test_the_card_states_data_licence_scores_and_how_to_load_it(model, fake):
    model.push_to_hub("me/faces", data="9 images of mugs", licence="CC0-1.0", scores="MAD 11 degrees.")
    card = (fake.place / "me" / "faces" / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: derender\n") and 'license: "cc0-1.0"\n' in card
    assert 'derender.load("me/faces")' in card
    for stated in ("9 images of mugs", "MAD 11 degrees.", "32 x 32", "**Licence**: CC0-1.0"):
        assert stated in card


def test_a_model_without_a_description_is_not_uploaded(model, fake):
    with pytest.raises(ValueError, match="has no card: state what it was trained on"):
        model.push_to_hub("me/faces", data="mugs")
    assert not fake.asked


def test_card_and_errors_go_with_the_weights_they_belong_to(model, tmp_path):
    first = model.save_pretrained(tmp_path / "first", data="mugs", licence="MIT")
    with_errors(first)
    loaded = derender.load(first)
    second = loaded.save_pretrained(tmp_path / "second")
    assert (second / "README.md").read_text() == (first / "README.md").read_text()
    assert read_errors(second).pictures == 1234
    with torch.no_grad():
        next(loaded.parameters()).add_(1)
    third = loaded.save_pretrained(tmp_path / "third")
    assert "**Trained on**: not stated" in (third / "README.md").read_text()
    assert not (third / ERRORS_FILE).exists()


def test_scores_on_a_card_come_from_the_errors_beside_the_model(model, tmp_path):
    folder = model.save(tmp_path / "plain")
    with_errors(folder)
    card = (derender.load(folder).save_pretrained(tmp_path / "told", data="mugs") / "README.md").read_text()
    assert "1,234 images it was not trained on have a masked L1 of 0.0600 in the median and 0.1090" in card


def test_saving_over_the_folder_it_came_from_keeps_the_card(model, tmp_path):
    folder = model.save_pretrained(tmp_path / "mine", data="mugs", licence="MIT")
    with pytest.raises(FileExistsError, match="overwrite=True"):
        derender.load(folder).save_pretrained(folder)
    derender.load(folder).save_pretrained(folder, overwrite=True)
    assert "mugs" in (folder / "README.md").read_text()


def test_bundled_cards_travel(tmp_path, fake):
    derender.load("rendered-faces-64").push_to_hub("me/again")
    folder = fake.place / "me" / "again"
    card = (folder / "README.md").read_text()
    assert card.startswith("---\n") and "SIDE 0.786e-2" in card
    assert json.loads((folder / ERRORS_FILE).read_text())["pictures"] > 0
    assert (folder / "whitening.safetensors").exists()


def test_a_hub_that_cannot_be_reached_is_one_sentence(model, monkeypatch):
    from huggingface_hub import HfApi

    monkeypatch.setattr(hub, "client", lambda token: HfApi(endpoint="http://127.0.0.1:9", token="x"))
    with pytest.raises(ConnectionError, match=r"cannot be reached .* model.save_pretrained writes the same"):
        model.push_to_hub("me/faces", data="mugs", licence="MIT")


def test_a_bad_name_and_a_missing_login_say_what_to_do(model, fake):
    from huggingface_hub.errors import HFValidationError, LocalTokenNotFoundError

    fake.fails = HFValidationError("Repo id must be ...")
    with pytest.raises(ValueError, match="'a/b/c' is no name on the Hub: give OWNER/NAME"):
        model.push_to_hub("a/b/c", data="mugs", licence="MIT")
    fake.fails = LocalTokenNotFoundError("Token is required")
    with pytest.raises(PermissionError, match="log in with 'hf auth login'"):
        model.push_to_hub("a/b", data="mugs", licence="MIT")
