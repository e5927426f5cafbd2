"""Released models: what save_pretrained writes, what reaches the Hub, what comes back, what is refused."""

import shutil
from pathlib import Path

import huggingface_hub
import numpy as np
import pytest
import torch
from huggingface_hub.errors import HFValidationError, LocalTokenNotFoundError

import derender
from derender.model import Derenderer
from derender.storage.places import ERRORS_FILE
from derender.training.held_out_errors import HeldOutErrors, read_errors, write_errors

MINE = {"data": "mugs", "licence": "MIT"}


@pytest.fixture
def model() -> Derenderer:
    return Derenderer.from_preset("small", seed=0, image_size=32, width=8, light_width=4).eval()


class FakeHub:
    """A Hub in a folder: repositories by name, with what was asked of it."""

    def __init__(self, place: Path):
        self.place, self.asked, self.fails = place, [], None

    def create_repo(self, repo_id: str, **options):
        if self.fails is not None:
            raise self.fails
        self.asked.append({"repo_id": repo_id, **options})

        class Address(str):
            repo_id: str

        address = Address(f"https://huggingface.co/{repo_id}")
        address.repo_id = repo_id
        return address

    def upload_folder(self, *, repo_id: str, folder_path: Path, commit_message: str) -> None:
        shutil.copytree(folder_path, self.place / repo_id, dirs_exist_ok=True)

    def snapshot_download(self, repository: str, allow_patterns: list[str]) -> str:
        there = self.place / "cache" / repository
        there.mkdir(parents=True)
        for file in (self.place / repository).iterdir():
            if file.name in allow_patterns:
                shutil.copy(file, there)
        return str(there)

    def card(self) -> str:
        return (self.place / "me" / "faces" / "README.md").read_text()


@pytest.fixture
def fake(tmp_path, monkeypatch) -> FakeHub:
    made = FakeHub(tmp_path / "hub")
    monkeypatch.setattr(huggingface_hub, "HfApi", lambda token: made)
    monkeypatch.setattr(huggingface_hub, "snapshot_download", made.snapshot_download)
    return made


def test_a_pushed_model_comes_back_the_same_with_a_card(model, fake):
    stated = {"data": "9 images of mugs", "licence": "CC0-1.0", "scores": "MAD 11 degrees."}
    address = model.push_to_hub("me/faces", private=True, **stated)
    assert str(address) == "https://huggingface.co/me/faces"
    assert fake.asked == [{"repo_id": "me/faces", "private": True, "exist_ok": True}]
    names = {file.name for file in (fake.place / "me" / "faces").iterdir()}
    assert names == {"model.safetensors", "config.json", "README.md"}
    back = Derenderer.from_pretrained("me/faces")
    images = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    for name, feature in model.embed(images).items():
        assert torch.equal(back.embed(images)[name], feature)
    assert fake.card().startswith("---\nlibrary_name: derender\n") and 'license: "cc0-1.0"\n' in fake.card()
    for text in (*stated.values(), 'derender.load("me/faces")', "32 x 32", "**Licence**: CC0-1.0"):
        assert text in fake.card()


def test_card_and_errors_go_with_the_weights_they_belong_to(model, tmp_path):
    first = model.save_pretrained(tmp_path / "first", **MINE)
    write_errors(first, HeldOutErrors(pictures=1234, quantiles=list(np.linspace(0.01, 0.11, 101))))
    loaded = derender.load(first)
    second = loaded.save_pretrained(tmp_path / "second")
    assert (second / "README.md").read_text() == (first / "README.md").read_text()
    assert read_errors(second).pictures == 1234
    with torch.no_grad():
        next(loaded.parameters()).add_(1)
    third = loaded.save_pretrained(tmp_path / "third")
    assert "**Trained on**: not stated" in (third / "README.md").read_text()
    assert not (third / ERRORS_FILE).exists()


def test_saving_over_the_folder_it_came_from_keeps_the_card(model, tmp_path):
    folder = model.save_pretrained(tmp_path / "mine", **MINE)
    with pytest.raises(FileExistsError, match="overwrite=True"):
        derender.load(folder).save_pretrained(folder)
    derender.load(folder).save_pretrained(folder, overwrite=True)
    assert "mugs" in (folder / "README.md").read_text()


def test_what_the_hub_refuses_is_one_sentence(model, fake, monkeypatch):
    for one in (model, derender.load("rendered-faces-64")):  # its card states another data set and licence
        with pytest.raises(ValueError, match="a card needs both: state what it was trained on"):
            one.push_to_hub("me/faces", data="mugs")
    assert not fake.asked
    fake.fails = HFValidationError("Repo id must be ...")
    with pytest.raises(ValueError, match="'a/b/c' is no name on the Hub: give OWNER/NAME"):
        model.push_to_hub("a/b/c", **MINE)
    fake.fails = LocalTokenNotFoundError("Token is required")
    with pytest.raises(PermissionError, match="log in with 'hf auth login'"):
        model.push_to_hub("a/b", **MINE)
    nowhere = huggingface_hub.hf_api.HfApi(endpoint="http://127.0.0.1:9", token="x")
    monkeypatch.setattr(huggingface_hub, "HfApi", lambda token: nowhere)
    with pytest.raises(ConnectionError, match=r"cannot be reached .* model.save_pretrained writes the same"):
        model.push_to_hub("me/faces", **MINE)
