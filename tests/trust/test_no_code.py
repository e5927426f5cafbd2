"""Nothing that is read is ever run: no call that could do it stands in the sources, files that try fail."""

import ast
import json
import pickle
import resource
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save

import derender
from derender.baselines import load_baseline
from derender.evaluation.memory import Memory
from derender.features import FeatureTable
from derender.networks.unsup3d import read_checkpoint
from derender.objectives.perceptual import _read_weights
from derender.storage.atomic import DamageNoticed
from derender.storage.tensors import reads_safely
from derender.training import resolve
from derender.training.run_folder import read_config_tree

PACKAGE = Path(derender.__file__).parent
SOURCES = sorted(PACKAGE.rglob("*.py"))

NEVER = {
    *(f"{name}.{call}" for name in ("pickle", "marshal", "dill") for call in ("load", "loads")),
    *("cloudpickle.load", "cloudpickle.loads"),
    *("pickle.dumps", "pickle.Unpickler", "shelve.open", "joblib.load", "pandas.read_pickle"),
    *("yaml.load", "yaml.full_load", "yaml.unsafe_load", "yaml.load_all", "jsonpickle.decode"),
    *("eval", "exec", "compile", "__import__", "os.system", "os.popen", "runpy.run_path"),
    *("shutil.unpack_archive", "torch.hub.load", "torch.jit.load"),
}
NEVER_FROM = {"pickle", "marshal", "shelve", "dill", "joblib"}
NEVER_METHODS = {"extract", "extractall", "read_pickle", "full_load", "unsafe_load"}
BETWEEN_OWN_PROCESSES = {"features/blocks.py": {"pickle.loads", "pickle.dumps"}}
"""What our actors hand back through Ray, which sends pickles between its processes anyhow; never a file."""

NEEDED = {"torch.load": ("weights_only", True), "np.load": ("allow_pickle", False)}


def dangers(tree: ast.AST) -> list[str]:
    """Calls that can run what a file says, with their lines."""
    results = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in NEVER_FROM:
            results.append(f"{node.lineno}: from {node.module} import")
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        given = {word.arg: word.value.value for word in node.keywords if isinstance(word.value, ast.Constant)}
        needed = NEEDED.get(name)
        if name.endswith("from_pretrained") and "library" in name:
            needed = ("use_safetensors", True)
        if name in NEVER or name.rpartition(".")[2] in NEVER_METHODS:
            results.append(f"{node.lineno}: {name}")
        elif needed is not None and given.get(needed[0]) is not needed[1]:
            results.append(f"{node.lineno}: {name} without {needed[0]}={needed[1]}")
        elif given.get("shell") or given.get("trust_remote_code") or given.get("allow_pickle"):
            results.append(f"{node.lineno}: {name} with shell, trust_remote_code or allow_pickle")
    return results


def test_no_source_has_a_call_that_runs_what_a_file_says():
    results = {}
    for path in SOURCES:
        name = path.relative_to(PACKAGE).as_posix()
        allowed = BETWEEN_OWN_PROCESSES.get(name, set())
        left = [one for one in dangers(ast.parse(path.read_text())) if one.split(": ")[1] not in allowed]
        if left:
            results[name] = left
    assert not results


@pytest.mark.parametrize(
    "source",
    [
        *("pickle.load(f)", "from pickle import loads", "yaml.load(f, Loader)", "eval(text)"),
        *("torch.load(f)", "torch.load(f, weights_only=False)"),
        *("np.load(f)", "np.load(f, allow_pickle=True)"),
        *("archive.extractall(folder)", "subprocess.run(text, shell=True)"),
        "library.Net.from_pretrained(source)",
    ],
)
def test_such_calls_are_seen(source):
    assert dangers(ast.parse(source))


class Bomb:
    """Unpickling it makes a file."""

    def __init__(self, file: Path):
        self.file = file

    def __reduce__(self):
        return Path.touch, (self.file,)


@pytest.fixture
def canary(tmp_path):
    """A file that exists once somebody has run what a file said."""
    file = tmp_path / "executed"
    yield file
    assert not file.exists(), "code from a file was run"


def test_the_bomb_goes_off_where_pickles_are_read(tmp_path):
    pickle.loads(pickle.dumps(Bomb(tmp_path / "executed")))
    assert (tmp_path / "executed").exists()


@pytest.mark.skipif(not reads_safely(), reason="this PyTorch is not trusted with pickles")
def test_weights_that_are_pickles_run_nothing(canary, tmp_path):
    bomb = {"weight": torch.zeros(1), "more": Bomb(canary)}
    torch.save(bomb, tmp_path / "vgg16.pth")
    with pytest.raises(ValueError, match=r"vgg16\.pth cannot be read"):
        _read_weights(tmp_path / "vgg16.pth")
    with pytest.raises(ValueError, match=r"wants to run code when read|no checkpoint of unsup3d"):
        read_checkpoint(tmp_path / "vgg16.pth")
    np.savez(tmp_path / "vgg16.npz", weight=np.array([Bomb(canary)], object))
    with pytest.raises(ValueError, match=r"vgg16\.npz cannot be read"):
        _read_weights(tmp_path / "vgg16.npz")


@pytest.fixture
def folder(tmp_path) -> Path:
    """A tiny model, saved."""
    model = derender.Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4)
    return model.save(tmp_path / "model")


def refused_as_damaged(folder: Path, name: str, content: bytes) -> None:
    """A model with one file exchanged, which is put back."""
    file = folder / name
    whole = file.read_bytes() if file.exists() else None
    file.write_bytes(content)
    with pytest.raises(ValueError, match="damaged"):
        derender.load(folder)
    file.unlink() if whole is None else file.write_bytes(whole)


def test_model_folders_with_pickles_in_them_run_nothing(canary, folder):
    pickled = pickle.dumps(Bomb(canary))
    (folder / "pytorch_model.bin").write_bytes(pickled)
    assert derender.load(folder).image_size == 32
    for name in ("model.safetensors", "whitening.safetensors", "config.json"):
        refused_as_damaged(folder, name, pickled)
    (folder / "config.json").unlink()
    for source in (folder, folder / "pytorch_model.bin"):
        with pytest.raises(ValueError, match="is a pickle, which can run code"):
            load_baseline(source)
    config = {"format": 1, "baseline": "ae", "settings": {}}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "model.safetensors").write_bytes(pickled)
    with pytest.raises(ValueError, match=r"is damaged \(model\.safetensors is cut off"):
        load_baseline(folder)


def test_safetensors_with_other_sizes_than_they_say_are_refused(folder):
    large = (1 << 62).to_bytes(8, "little") + (folder / "model.safetensors").read_bytes()[8:]
    for changed in (large, save({"nets.geometry.encoder.weight": torch.zeros(3)})):
        refused_as_damaged(folder, "model.safetensors", changed)


def test_a_configuration_that_claims_a_giant_takes_no_memory(folder):
    config = json.loads((folder / "config.json").read_text())
    network = dict(config["settings"]["network"])
    for name, size in (("width", 1 << 16), ("code_size", 10**30), ("light_width", 1 << 20)):
        config["settings"]["network"] = {**network, name: size}
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        refused_as_damaged(folder, "config.json", json.dumps(config).encode())
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB
    config["settings"] = {"ranges": {"border_depth": 1e308}}
    refused_as_damaged(folder, "config.json", json.dumps(config).encode())


def test_tables_and_caches_with_pickles_in_them_run_nothing(canary, tmp_path):
    (tmp_path / "F.parquet").write_bytes(pickle.dumps(Bomb(canary)))
    with pytest.raises(ValueError, match="not a readable parquet file"):
        FeatureTable.read(tmp_path / "F.parquet")
    bomb, memory = np.array([Bomb(canary)], object), Memory(tmp_path)
    memory.recall("kind", {"a": 1}, lambda: {"found": np.zeros(2)})
    (file,) = tmp_path.glob("kind-*.npz")
    np.savez(file, found=bomb)
    with pytest.warns(DamageNoticed):
        assert memory.recall("kind", {"a": 1}, lambda: {"found": np.ones(2)})["found"].tolist() == [1, 1]


def test_configurations_run_nothing(canary, tmp_path):
    told = f'!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.PosixPath ["{canary}"]]'
    (tmp_path / "config.yaml").write_text(f"preset: {told}\n")
    with pytest.raises(ValueError, match="is damaged"):
        read_config_tree(tmp_path)
    with pytest.raises(ValueError, match="cannot read the value"):
        resolve("small", [f"preset={told}"])
