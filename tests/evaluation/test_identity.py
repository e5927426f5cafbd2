"""Identification and verification: best on codes of the person, chance on noise, known answers by hand."""

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from derender.baselines.controls import DESCRIPTORS, descriptor_features
from derender.data import ImageSet, half_of
from derender.evaluation.feature_rows import FeatureRow, control_rows
from derender.evaluation.identity import area_under_roc, identify, read_pairs, verify
from derender.evaluation.options import Options
from derender.features import FeatureTable

RNG = np.random.default_rng(0)
PEOPLE, SHOTS = 12, 10


def table(codes: np.ndarray, **labels: np.ndarray) -> FeatureTable:
    who = np.repeat([f"P{row}" for row in range(PEOPLE)], SHOTS)
    files = tuple(f"{name}/{name}_{1 + row % SHOTS:04d}.jpg" for row, name in enumerate(who))
    return FeatureTable(files, {"code": codes}, {"identity": who, **labels})


@pytest.fixture
def codes() -> np.ndarray:
    """Of a person, and, growing with the angle, of the light; all share a large mean."""
    person = np.repeat(RNG.standard_normal((PEOPLE, 8)), SHOTS, axis=0)
    return 50 + person + np.tile(LIGHT / 20, PEOPLE)[:, None] * RNG.standard_normal((PEOPLE * SHOTS, 8))


LIGHT = np.array([0, 5, 10, 20, 25, 40, 50, 70, 90, 110.0])


def test_recognition_falls_with_the_light_and_is_chance_for_noise(codes):
    angles = np.tile(LIGHT, PEOPLE).astype(np.float32)
    angles[1::2] *= -1
    result = identify(table(codes, light_deg=angles), factors=("code",), resamples=50, cache="none")
    rows = result.values["rows"]
    share = {name: one["value"] for name, one in rows["code"]["scores"].items()}
    groups = {"all": 108, "<= 12": 24, "<= 25": 24, "<= 50": 24, "<= 77": 12, "beyond": 24}
    assert result.values["probes"] == groups
    assert share["<= 12"] > 0.95 > share["<= 50"] > share["beyond"] + 0.1
    assert share["ward accuracy"] > rows["chance"]["scores"]["ward accuracy"]["value"] + 0.2
    assert rows["chance"]["scores"]["all"]["value"] == pytest.approx(1 / PEOPLE)
    assert [name[-8:] for name in result.values["gallery"]] == ["0001.jpg"] * PEOPLE
    noise = RNG.standard_normal((PEOPLE * SHOTS, 8))
    noise = identify(table(noise, light_deg=angles), factors=("code",), resamples=50, cache="none")
    assert noise.values["rows"]["code"]["scores"]["all"]["value"] == pytest.approx(1 / PEOPLE, abs=0.1)


def test_a_gallery_and_groups_by_other_columns(codes):
    yaw = np.radians(np.tile(LIGHT, PEOPLE)).astype(np.float32)
    how = {"by": "camera_y_rad", "bins": (30,), "resamples": 20, "cache": "none"}
    one = identify(table(codes, camera_y_rad=yaw), factors=("code",), **how)
    assert one.values["probes"] == {"all": 108, "<= 30": 48, "beyond": 60}
    role = np.tile(["shown"] * 2 + ["probe"] * 8, PEOPLE)
    of_role = table(codes, role=role)
    two = identify(of_role, factors=("code",), gallery="role=shown", resamples=20, cache="none")
    assert len(two.values["gallery"]) == 2 * PEOPLE and two.values["probes"] == {"all": 96}
    with pytest.raises(ValueError, match="no image has role=frontal: the gallery is empty"):
        identify(of_role, factors=("code",), gallery="role=frontal")
    with pytest.raises(ValueError, match="bins must grow"):
        identify(table(codes), factors=("code",), bins=(50, 12))


def written(path, folds=10, count=6) -> str:
    lines = [f"{folds}\t{count}"]
    for fold in range(folds):
        for pair in range(count):
            lines.append(f"P{(fold + pair) % PEOPLE}\t{1 + pair}\t{3 + pair}")
        for pair in range(count):
            lines.append(f"P{(fold + pair) % PEOPLE}\t1\tP{(fold + 2 * pair + 1) % PEOPLE}\t{2 + pair}")
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def test_pairs_are_judged_by_a_threshold_from_other_folds(tmp_path, codes, monkeypatch):
    pairs = read_pairs(written(tmp_path / "pairs.txt"))
    assert len(pairs) == 120 and pairs.first[1] == "P1_0002" and pairs.second[6] == "P1_0002"
    exact = np.repeat(np.eye(PEOPLE), SHOTS, axis=0)
    different = np.array([a[:-5] != b[:-5] for a, b in zip(pairs.first, pairs.second, strict=True)])
    assert (different == ~pairs.same).mean() > 0.9  # a few pairs of "two" people are one: judged wrong
    kept = pairs.select(np.flatnonzero(different == ~pairs.same))
    result = verify(table(exact), kept, factors=("code",), resamples=50, cache="none").values["rows"]["code"]
    assert [result["scores"][name]["value"] for name in ("accuracy", "auc")] == [1, 1]
    noise = RNG.standard_normal((PEOPLE * SHOTS, 8))
    chance = verify(table(noise), kept, factors=("code",), resamples=50, cache="none").values
    assert chance["rows"]["code"]["scores"]["accuracy"]["value"] == pytest.approx(0.5, abs=0.12)
    assert 0.01 < chance["standard_error"]["code"] < 0.1
    runs = FeatureRow("code", tuple(table(RNG.standard_normal((PEOPLE * SHOTS, 8))) for _ in range(3)))
    monkeypatch.setattr("derender.evaluation.identity.subject_and_controls", lambda *_: [runs])
    several = verify(runs.tables[0], kept, resamples=50, cache="none").values["rows"]["code"]["scores"]
    assert all(0 < several[name]["spread"] < 0.15 for name in ("accuracy", "auc"))


def test_pairs_of_a_half_have_all_people_in_it_and_are_balanced(tmp_path, codes):
    how = {"factors": ("code",), "resamples": 20, "cache": "none"}
    pairs = written(tmp_path / "p.txt")
    result = {half: verify(table(codes), pairs, half=half, **how) for half in ("development", "test")}
    people = np.array([f"P{row}" for row in range(PEOPLE)])
    whole = FeatureTable(tuple(people), {"x": np.zeros((PEOPLE, 1))}, {"identity": people})
    assert sum(len(half_of(whole, half)) for half in result) == PEOPLE
    for one in result.values():
        words = one.tables[0].caption.split()
        assert words[1] == words[6] and 0 < one.values["pairs"] < 60


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: expected FOLDS PAIRS"),
        ("2 1\nA\t1\t2\n", "expected 4 pairs as line 1 says, got 1"),
        ("1 1\nA 1 B 2 3\nA 1 B 2\n", "line 2: expected NAME 1 4, got 'A 1 B 2 3'"),
        ("1 1\nA 1 2\nA 1 B\n", "line 3: expected NAME 1 OTHER 2"),
    ],
)
def test_broken_pairs_are_named(tmp_path, text, message):
    (tmp_path / "pairs.txt").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_pairs(tmp_path / "pairs.txt")


def test_the_area_is_that_of_scikit_learn_also_with_ties_and_weights():
    score, positive = RNG.integers(0, 12, 200).astype(float), RNG.random(200) < 0.4
    weights = RNG.integers(0, 4, (3, 200))
    expected = [roc_auc_score(positive, score, sample_weight=one) for one in weights]
    np.testing.assert_allclose(area_under_roc(score, positive, weights), expected)
    np.testing.assert_allclose(area_under_roc(score, positive), roc_auc_score(positive, score))


def test_controls_stand_beside_a_model_of_faces(tmp_path):
    from derender.model import Derenderer

    model = Derenderer.from_preset("small", image_size=32, width=4, light_width=4, code_size=12)
    images = RNG.integers(0, 256, (PEOPLE * 2, 3, 32, 32)).astype(np.uint8)
    who = np.repeat([f"P{row}" for row in range(PEOPLE)], 2)
    pictures = ImageSet(images, tuple(f"{row}.png" for row in range(len(who))), {"identity": who})
    result = identify(model, images=pictures, untrained_seeds=1, resamples=20, cache="none")
    assert list(result.values["rows"]) == [
        "geometry + albedo", "untrained encoder", "PCA (6)", "pixels",
        "Gradientfaces", "Gradientfaces with mirror image", "HOG", "HOG with mirror image",
        "LBP", "LBP with mirror image", "chance",
    ]  # fmt: skip
    assert any("PCA (6), whitened, is fitted to 24 images" in note for note in result.notes)
    rows = control_rows(pictures, None, Options(descriptors=True))
    shown = {row.name: row.tables[0].factors for row in rows}
    turned = ImageSet(images[..., ::-1].copy(), pictures.files)
    for name in DESCRIPTORS:
        alone = [descriptor_features(name, one).factors[name] for one in (pictures, turned)]
        title = next(title for title in shown if title.lower() == name)
        np.testing.assert_array_equal(shown[title][name], alone[0])
        np.testing.assert_allclose(shown[f"{title} with mirror image"][name], np.mean(alone, axis=0))
