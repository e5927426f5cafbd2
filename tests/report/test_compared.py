"""One table and one image of many data sets: what failed keeps its place, shared trainings count once."""

from derender.report.comparison import protocol_picture, protocol_table, scores_from, set_tables


def question(name: str, **accuracies: float) -> dict:
    def row(value: float, control: bool) -> dict:
        one = {"value": value, "low": value - 0.1, "high": value + 0.1, "spread": None}
        scores = dict.fromkeys(("accuracy", "f1", "nmi", "hungarian", "ari"), one)
        rival = {"rival": "pixels", "value": 0.1, "low": 0.05, "high": 0.2, "above": True}
        versus = {} if control else {"accuracy": rival}
        return {"control": control, "runs": 1, "scores": scores, "versus": versus}

    rows = {name: row(value, name == "pixels") for name, value in accuracies.items()}
    how = {"protocol": "cluster", "method": "ward", "labels": {"class": 3}, "n_rows": 9}
    return {"name": name, **how, "rows": rows}


def test_rows_are_methods_then_controls_and_what_failed_keeps_its_place():
    def cost(seconds: float, embedding: float) -> dict:
        size = {"parameters": 10, "images": 64, "numbers": 8}
        return {"ours": {**size, "seconds": seconds, "embedding_seconds": embedding}}

    costs = cost(5.0, 0.001)
    absent = {"vqvae": "failed: it was stopped by the watcher after a while, because of a hollow depth"}
    scores = [
        *scores_from(question("lfw", ours=0.5, pixels=0.2), costs, absent),
        *scores_from(question("cars", ours=0.6, vqvae=0.4, pixels=0.3), cost(7.0, 0.003), {}),
        *scores_from(question("utk", ours=0.7, pixels=0.3), costs, {"vqvae": "missing: the budget"}),
    ]
    table = protocol_table(scores, ["ours", "vqvae"])
    assert [row.name for row in table.rows] == ["ours", "vqvae", "pixels"]
    assert [row.control for row in table.rows] == [False, False, True]
    values = dict(zip((column.name for column in table.columns), table.rows[0].cells, strict=True))
    assert (values["lfw: accuracy"], values["cars: accuracy"], values["numbers"]) == (0.5, 0.6, 8)
    assert values["training, s"] == 12  # lfw and utk share a run
    assert abs(values["ms an image"] - 5 / 3) < 1e-9
    assert table.rows[1].cells[:6] == ("failed", None, 0.4, 0.4, "missing", None)
    assert table.best(0) == 0.5
    own, verdicts = set_tables(scores[0], ["ours", "vqvae"])
    assert own.rows[1].cells[0].startswith("failed: it was stopped") and len(own.rows[1].cells[0]) <= 60
    assert [text for text, _ in own.texts(own.rows[0])[:3]] == ["0.500", "0.400-0.600", "-"]
    assert [row.name for row in verdicts.rows] == ["ours: accuracy"]
    svg, png = protocol_picture(scores, ["ours", "vqvae"])
    assert all(word in svg for word in ("lfw", "cars", "utk", "vqvae", "failed", "missing"))
    assert png.startswith(b"\x89PNG")


def test_few_labels_show_one_head_and_the_most_labels():
    def part(head: str, labels: int, value: float) -> dict:
        one = {"value": value, "low": None, "high": None, "spread": None}
        scores = dict.fromkeys(("accuracy", "balanced_accuracy", "average_precision"), one)
        row = {"control": False, "runs": 1, "scores": scores, "versus": {}}
        return {"head": head, "labels": labels, "rows": {"ours": row}}

    asked = [(head, labels) for head in ("linear", "logistic") for labels in (100, 500)]
    parts = [part(head, labels, 0.5) for head, labels in asked]
    told = {"name": "celeba", "protocol": "linear", "kind": "labels", "names": ["a", "b"]}
    told |= {"n_test": 5, "seeds": [0]}
    scores = scores_from({**told, "parts": parts}, {}, {})
    assert [(one.head, one.count) for one in scores] == asked
    table = protocol_table(scores, ["ours"])
    names = [column.name for column in table.columns[:2]]
    assert names == ["celeba, 100 labels: balanced", "celeba, 500 labels: balanced"]
    svg, _ = protocol_picture(scores, ["ours"])
    assert "celeba, 500 labels" in svg and "celeba, 100 labels" not in svg
