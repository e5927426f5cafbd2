"""Feeds the readers bytes that a search by coverage finds: those that make them do something new are kept.

    pip install atheris
    python tests/trust/fuzz_atheris.py --seconds 300 --only zip

The readers, and what is a finding, are those of fuzz.py, as far as they are fed bytes; the search, which is
libFuzzer's, starts from whole files. What derender and yaml do is watched, not other libraries. Each reader
has a process of its own, whose end by a signal is a finding, too. Inputs that were worth keeping stay in
``--corpus`` for the next time. Atheris is needed by nothing else.
"""

import argparse
import os
import pickle
import re
import sys
import tempfile
from pathlib import Path

try:
    import atheris
except ImportError as error:
    raise SystemExit("atheris is not installed: pip install atheris") from error

with atheris.instrument_imports(include=["derender", "yaml"], enable_loader_override=False):
    from fuzz import Found, limited_and_quiet
    from fuzzing.targets import Target, targets

LONGEST = 1 << 14
REACHED = re.compile(r"#(\d+)\s+\w+\s+cov: (\d+) ft: (\d+)")
NOTED = ("inputs", "accepted", "slowest", "findings", "times")


def search(target: Target, seconds: int, seed: int, corpus: Path, notes: Path) -> int:
    """Search in a process of its own, which notes what it finds; gives how that process ended."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    log = os.open(notes / "log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(log, stream)
    found = Found(target)

    def one(content: bytes) -> None:
        kinds = len(found.findings)
        (notes / "input").write_bytes(content)
        found.feed(target.given(content))
        if found.inputs % 200 == 1 or len(found.findings) > kinds:
            (notes / "found").write_bytes(pickle.dumps({name: getattr(found, name) for name in NOTED}))

    asked = {"max_total_time": seconds, "seed": seed + 1, "max_len": LONGEST, "timeout": 300}
    asked |= {"rss_limit_mb": 0, "artifact_prefix": f"{notes}/"}
    asked["only_ascii"] = int(all(whole.isascii() for whole in target.wholes))
    atheris.Setup([sys.argv[0], *(f"-{name}={value}" for name, value in asked.items()), str(corpus)], one)
    atheris.Fuzz()
    os._exit(1)  # it does not come back


def run(given: argparse.Namespace) -> int:
    """The script."""
    limited_and_quiet()
    findings = 0
    with tempfile.TemporaryDirectory() as place:
        for target in targets(Path(place)):
            if not target.wholes or not any(part in target.name for part in given.only.split(",")):
                continue
            name = re.sub(r"\W+", "-", target.name).strip("-")
            corpus, notes = (given.corpus or Path(place) / "corpus") / name, Path(place) / "notes" / name
            for folder in (corpus, notes):
                folder.mkdir(parents=True, exist_ok=True)
            for number, whole in enumerate(target.wholes):
                (corpus / f"whole{number}").write_bytes(whole)
            code = search(target, given.seconds, given.seed, corpus, notes)
            found, log = Found(target), (notes / "log").read_text(errors="replace")
            vars(found).update(pickle.loads((notes / "found").read_bytes()))
            if code:
                found.keep(f"ended with code {code}", log[-1500:], (notes / "input").read_bytes())
            seen = [tuple(map(int, numbers)) for numbers in REACHED.findall(log)] or [(0, 0, 0)]
            found.inputs = max(found.inputs, seen[-1][0])
            places = f"; {seen[-1][1]} places and {seen[-1][2]} features reached ({seen[0][2]} at first)"
            findings += found.tell(places)
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
