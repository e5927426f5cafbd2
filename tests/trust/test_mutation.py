"""The list of mutants that no test can kill speaks of the code as it is."""

from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]


def test_every_equivalent_mutant_changes_a_line_that_still_stands():
    listed = yaml.safe_load((ROOT / "tests" / "trust" / "equivalent_mutants.yaml").read_text())
    assert listed
    for row in listed:
        assert set(row) == {"file", "where", "before", "after", "why"} and row["why"]
        text = (ROOT / "src" / "derender" / row["file"]).read_text()
        assert row["before"] in [line.strip() for line in text.splitlines()], row
        assert f"def {row['where']}(" in text or not row["where"], row
        assert row["before"] != row["after"], row
