"""What a plan may say, and that everything else is one clear line before anything is trained."""

import pytest

from derender.learn.plan import Plan, read_plan
from derender.learn.sweep import states_of

GOOD = """
images: 1000
seeds: 2
settings: {precision: bf16-mixed}
train:
  faces: {data: faces.zip, split: [0.9, 0.05, 0.05]}
  cars: {data: cars.zip::train}
methods:
  ours: {settings: {loocc: light+camera}, settings_on: {cars: {curvature_weight: 2}}}
  codes: {like: ours, whitened: false}
  small vqvae: {kind: vqvae, settings: {width: 416, learning_rate: 1e-4}}
  hog:
  pixels:
score:
  lfw: {data: lfw.zip, trained_on: faces, table: identity}
  police: {data: cars.zip::test, trained_on: cars, label: class, protocols: [cluster, linear]}
"""


@pytest.fixture
def read(tmp_path):
    """The plan in a file of this text."""

    def call(text: str = GOOD, name: str = "plan.yaml") -> Plan:
        (tmp_path / name).write_text(text)
        return read_plan(tmp_path / name)

    return call


def test_every_training_gets_the_plans_pictures_split_and_seed(read):
    plan = read()
    ours = plan.configuration("ours", "cars", 1)
    assert (ours.images, ours.seed, ours.precision) == (1000, 1, "bf16-mixed")
    assert (ours.objective.loocc, ours.objective.curvature_weight) == ("light+camera", 2)
    assert plan.configuration("ours", "faces", 0).objective.curvature_weight == 3
    vqvae = plan.configuration("small vqvae", "faces", 0)
    assert (vqvae.model.width, vqvae.optimiser.learning_rate) == (416, 1e-4)
    assert vqvae.split == (0.9, 0.05, 0.05)


def test_jobs_share_trainings_and_come_after_what_they_need(read):
    jobs = list(states_of(read()))
    assert [job for job in jobs if job.startswith("train")] == [
        f"train {method} on {where}{seed}"
        for where in ("faces", "cars")
        for method in ("ours", "small vqvae")
        for seed in ("", ", seed 1")
    ]
    made = ("ours", "codes", "small vqvae")
    wanted = [f"embed {name} of lfw{seed}" for name in made for seed in ("", ", seed 1")]
    assert [job for job in jobs if "of lfw" in job] == [*wanted, "embed hog of lfw"]
    for where, scored in (("faces", "lfw"), ("cars", "police")):
        end = jobs.index(f"score {scored}")
        assert all(jobs.index(job) < end for job in jobs if job.endswith((f"on {where}", f"of {scored}")))
        assert jobs.index(f"train ours on {where}") < jobs.index(f"embed ours of {scored}")


def test_toml_says_the_same(read):
    text = """
methods = ["hog"]
[score.lfw]
data = "lfw.zip"
label = "identity"
"""
    plan = read(text, "plan.toml")
    assert plan.score["lfw"].label == ("identity",)
    assert states_of(plan) == {"embed hog of lfw": "to do", "score lfw": "to do"}


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("images: 1000", "image: 1000", "unknown setting 'image'; did you mean 'images'"),
        ("small vqvae: {kind: vqvae", "x: {kind: vqvea", "method 'vqvea'; did you mean 'vqvae'"),
        ("like: ours", "like: our", "unknown like 'our'; did you mean 'ours'"),
        ("width: 416", "widht: 416", "unknown setting 'widht'; did you mean 'model.width'"),
        ("width: 416", "seed: 3", "seed is the plan's own"),
        ("{precision: bf16-mixed}", "{precision: bf17}", "setting 'precision'"),
        ("trained_on: faces", "trained_on: face", "unknown training set 'face'; did you mean 'faces'"),
        (", trained_on: faces", "", "score 'lfw' needs trained_on: the training set of ours"),
        ("table: identity", "table: identities", "Input should be 'clustering', 'identity'"),
        ("table: identity", "table: segmentation", "got 'segmentation'"),
        ("table: identity", "table: identity, label: x", "needs a table (identity, emotion, ...) or a label"),
        ("trained_on: faces", "trained_on: faces, part: test", "data, dataset and limit of 'faces'"),
        ("data: lfw.zip", "data: faces.zip, part: test", "needs seeds: 1 and the data"),
        ("  lfw:", "  ../lfw:", "String should match pattern"),
        ("  hog:", "  hog: {settings: {a: 1}}", "(hog) is not trained here"),
        ("whitened: false", "whitened: false, model: x", "is like 'ours': leave out model"),
        ("score:", "score: [", "cannot be read as a plan"),
    ],
)
def test_a_mistake_is_one_line(read, old, new, told):
    assert old in GOOD
    with pytest.raises(ValueError, match=r"plan\.yaml") as error:
        read(GOOD.replace(old, new, 1))
    assert told in str(error.value)
