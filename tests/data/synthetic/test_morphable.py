"""A user's own morphable model: read, checked, and pictured like the built-in faces."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from derender.data.layouts.faces import MASK_CLASSES
from derender.data.synthetic import LIGHTS, VIEWS, FaceSettings, MorphableFaces, faces
from derender.data.synthetic.morphable import NOSE_TIP_Z

ROOT = Path(__file__).resolve().parents[3]
AHEAD = FaceSettings(view=VIEWS["frontal"], light=LIGHTS["frontal"], pictures_per_identity=1)


def dome(rows: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A half ball of radius 8 that bulges towards +z, y up, and its triangles (counter-clockwise outside)."""
    y, x = np.meshgrid(np.linspace(8, -8, rows), np.linspace(-8, 8, rows), indexing="ij")
    z = np.sqrt(np.maximum(128.0 - x**2 - y**2, 0.0))
    corner = np.arange(rows * rows).reshape(rows, rows)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    triangles = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, c, b), (b, c, d))])
    return np.stack([x, y, z], -1).reshape(-1, 3), triangles


def arrays(**changes) -> dict[str, np.ndarray]:
    mean, triangles = dome()
    components = np.stack([mean * [0.1, 0.0, 0.0], mean * [0.0, 0.1, 0.0]])
    made = {"mean": mean, "triangles": triangles, "components": components, "std": np.array([1.0, 0.5])}
    made |= {"unit": 18.0}
    return {name: value for name, value in (made | changes).items() if value is not None}


def saved(path: Path, **changes) -> Path:
    np.savez(path, **arrays(**changes))
    return path


def test_a_model_is_pictured_with_its_own_geometry(tmp_path):
    made = faces.generate(6, settings=AHEAD, seed=1, model=saved(tmp_path / "m.npz"))
    assert made.mask.mean(axis=(1, 2)).min() > 0.4
    middle = made.depth[:, 31:33, 31:33].min(axis=(1, 2))
    assert np.allclose(middle, NOSE_TIP_Z, atol=1e-3)
    assert (made.depth[:, 32, 32] < made.depth[:, 32, 12]).all()
    assert np.allclose(made.normal[:, 32, 32], [0, 0, 1], atol=0.1)
    assert (made.normal[:, 32, 12, 0] > 0.2).all()  # inward: the left flank's normal points right
    assert set(np.unique(made.parts)) == {0, MASK_CLASSES.index("skin")}


def test_coefficients_are_the_traits_and_stretch_the_surface(tmp_path):
    made = faces.generate(12, settings=AHEAD, seed=1, model=saved(tmp_path / "m.npz"))
    width = made.mask[:, 32].sum(axis=1).astype(float)
    height = made.mask[:, :, 32].sum(axis=1).astype(float)
    traits = made.identity_traits
    assert np.corrcoef(width, traits["shape_000"])[0, 1] > 0.9
    assert np.corrcoef(height, traits["shape_001"])[0, 1] > 0.9
    assert abs(traits["shape_001"]).max() <= 0.5 * 2.5


def test_texture_parts_colours_and_expressions_are_used(tmp_path):
    mean, _ = dome()
    left = mean[:, 0] > 0
    colours = np.full(mean.shape, np.nan)
    colours[left] = (0.2, 0.4, 0.6)
    path = saved(
        tmp_path / "m.npz",
        texture_mean=np.full(mean.shape, 0.5), texture_std=np.ones(1),
        texture_components=np.ones((1, *mean.shape)) * 0.1,
        colours=colours, parts=np.where(left, MASK_CLASSES.index("l_eye"), 1),
        expressions=np.stack([mean * [0, 0, -0.5]]), expression_names=np.array(["fear"]),
    )  # fmt: skip
    settings = AHEAD.model_copy(update={"expressions": {"neutral": 1.0, "fear": 1.0}})
    made = faces.generate(16, settings=settings, model=MorphableFaces.read(path))
    assert (made.albedo[:, :, 32, 45] == np.array([51, 102, 153])).all()
    assert len(np.unique(made.albedo[:, 0, 32, 20])) > 8  # the other half varies from person to person
    assert (made.parts[:, 32, 45] == MASK_CLASSES.index("l_eye")).all() and (made.parts[:, 32, 20] == 1).all()
    afraid = made.expression == "fear"
    assert made.depth[afraid, 32, 32].min() > made.depth[~afraid, 32, 32].max() + 0.01


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"std": None}, "the array 'std' is missing; there are components, mean"),
        ({"mean": np.zeros((5, 2))}, r"mean must be numbers of shape \(any, 3\), got float64 \(5, 2\)"),
        ({"components": np.zeros((2, 4, 3))}, r"components must be numbers of shape \(any, 576, 3\)"),
        ({"std": np.ones(3)}, r"std must be numbers of shape \(2\)"),
        ({"triangles": np.full((4, 3), 9999)}, r"triangles must number vertices 0..575"),
        ({"triangles": np.zeros((4, 3))}, "triangles must be whole numbers"),
        ({"unit": 0.0}, "unit must be above 0"),
        ({"texture_mean": np.full((576, 3), 200.0)}, "texture_mean must lie in 0..1"),
        ({"parts": np.full(576, 40)}, "parts must be class numbers 1..18"),
        ({"expressions": np.zeros((1, 576, 3)), "expression_names": ["smug"]}, "expression_names must give"),
        ({"mean": np.full((576, 3), np.nan)}, "mean holds values that are not finite"),
    ],
)  # fmt: skip
def test_bad_files_are_named(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        MorphableFaces.read(saved(tmp_path / "m.npz", **changes))


@pytest.fixture
def converter(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    return importlib.import_module("convert_ict_facekit")


@pytest.fixture
def published(tmp_path, converter, monkeypatch) -> Path:
    """A tiny tree in ICT-FaceKit's layout: a dome whose last row of vertices are 'teeth'."""
    mean, _ = dome()
    ranges = {"face": (0, 551, "skin", None), "teeth": (552, 575, "mouth", (0.9, 0.8, 0.7))}
    monkeypatch.setattr(converter, "RANGES", ranges)
    folder = tmp_path / "FaceXModel"
    folder.mkdir()
    write_obj(folder / "generic_neutral_mesh.obj", mean)
    write_obj(folder / "identity000.obj", mean * [1.1, 1.0, 1.0])
    write_obj(folder / "identity001.obj", mean * [1.0, 1.2, 1.0])
    for name in {shape for weights in converter.EXPRESSIONS.values() for shape in weights}:
        sides = ("",) if name in ("jawOpen", "mouthShrugLower") else ("_L", "_R")
        for side in sides:
            write_obj(folder / f"{name}{side}.obj", mean + np.array([0.0, 0.0, 0.5 * (name == "jawOpen")]))
    return folder


def write_obj(path: Path, vertices: np.ndarray, rows: int = 24) -> None:
    corner = np.arange(rows * rows).reshape(rows, rows) + 1
    quads = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], -1).reshape(-1, 4)
    lines = ["# made for a test", *(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices)]
    lines += ["f " + " ".join(f"{v}/{v}/{v}" for v in quad) for quad in quads]
    path.write_text("\n".join(lines) + "\n")


def test_the_converter_reads_the_published_layout(converter, published, tmp_path, capsys):
    out = tmp_path / "ict.npz"
    assert converter.main([str(published), str(out)]) == 0
    assert "576 vertices, 2 components, 1,058 triangles" in capsys.readouterr().out
    with np.load(out) as file:
        mean, _ = dome()
        assert np.allclose(file["components"][0], mean * [0.1, 0, 0], atol=1e-4)
        assert np.allclose(file["components"][1], mean * [0, 0.2, 0], atol=1e-4)
        names = file["expression_names"].tolist()
        assert np.allclose(file["expressions"][names.index("surprise")][:, 2], 0.55 * 0.5, atol=1e-4)
        assert (file["parts"][552:] == MASK_CLASSES.index("mouth")).all()
        assert np.isnan(file["colours"][0]).all() and np.allclose(file["colours"][560], (0.9, 0.8, 0.7))
    made = faces.generate(4, settings=AHEAD, model=out)
    assert (made.depth[:, 30:34, 30:34] > 0).all() and made.mask.mean() > 0.3
