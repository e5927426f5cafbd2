"""Feeds the readers bytes that a search by coverage finds: those that make them do something new are kept.

    pip install atheris
    python tests/trust/fuzz_atheris.py --seconds 300 --only zip

The readers, and what is a finding, are those of fuzz.py, as far as they are fed bytes; the search, which is
libFuzzer's, starts from whole files. What derender and yaml do is watched, not other libraries. Each reader
has a process of its own, whose end by a signal is a finding, too. Inputs that were worth keeping stay in
``--corpus`` for the next time. Atheris is needed by nothing else.
"""

import argparse
import json
import os
import re
import sys
import tempfile
from pathlib import Path

try:
    import atheris
except ImportError as error:
    raise SystemExit("atheris is not installed: pip install atheris") from error

with atheris.instrument_imports(include=["derender", "yaml"], enable_loader_override=False):
    from fuzzing.found import Found, limit_memory, quiet
    from fuzzing.targets import Target, targets

LONGEST = 1 << 14
REACHED = re.compile(r"#(\d+)\s+\w+\s+cov: (\d+) ft: (\d+)")


def search(target: Target, seconds: int, seed: int, corpus: Path, notes: Path) -> int:
    """Search in a process of its own, which notes what it finds; gives how that process ended."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    log = os.open(notes / "log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(log, stream)
    found = Found()

    def one(content: bytes) -> None:
        kinds = len(found.findings)
        (notes / "input").write_bytes(content)
        found.feed(target, target.given(content))
        if found.inputs % 200 == 0 or len(found.findings) > kinds:
            told = [found.inputs, found.accepted, found.slowest, found.findings]
            (notes / "found.json").write_text(json.dumps(told))

    asked = {"max_total_time": seconds, "seed": seed + 1, "max_len": LONGEST, "timeout": 300}
    asked |= {"rss_limit_mb": 0, "artifact_prefix": f"{notes}/"}
    asked["only_ascii"] = int(all(whole.isascii() for whole in target.wholes))
    options = [f"-{name}={value}" for name, value in asked.items()]
    atheris.Setup([sys.argv[0], *options, str(corpus)], one)
    atheris.Fuzz()
    os._exit(1)  # it does not come back


def tell(target: Target, code: int, notes: Path) -> int:
    """Say what came of it; gives the number of findings."""
    log = (notes / "log").read_text(errors="replace")
    inputs, accepted, slowest, findings = json.loads((notes / "found.json").read_text())
    seen = [tuple(map(int, numbers)) for numbers in REACHED.findall(log)] or [(0, 0, 0)]
    if code != 0:
        last = (notes / "input").read_bytes()
        findings[f"ended with code {code}"] = f"{log[-1500:]} <- {last!r:.2000}"
    print(
        f"{target.name}: {max(inputs, seen[-1][0]):,} inputs, {accepted:,} read, {seen[-1][1]} places and "
        f"{seen[-1][2]} features reached ({seen[0][2]} at first), {len(findings)} findings, "
        f"slowest {slowest:.2f} s",
        flush=True,
    )
    for kind, example in findings.items():
        print(f"  {kind}: {example}", flush=True)
    return len(findings)


def run(given: argparse.Namespace) -> int:
    """The script."""
    limit_memory()
    findings = 0
    with tempfile.TemporaryDirectory() as place, quiet():
        for target in targets(Path(place)):
            if not target.wholes or not any(part in target.name for part in given.only.split(",")):
                continue
            name = re.sub(r"\W+", "-", target.name).strip("-")
            corpus, notes = (given.corpus or Path(place) / "corpus") / name, Path(place) / "notes" / name
            for folder in (corpus, notes):
                folder.mkdir(parents=True, exist_ok=True)
            for number, whole in enumerate(target.wholes):
                (corpus / f"whole{number}").write_bytes(whole)
            findings += tell(target, search(target, given.seconds, given.seed, corpus, notes), notes)
    return 1 if findings else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=int, default=300, help="for each reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="targets whose name holds one of these, between commas")
    parser.add_argument("--corpus", type=Path, help="folder that keeps what was found worth trying")
    sys.exit(run(parser.parse_args()))
