"""Images that are broken, odd or meant to do harm, made on the spot, and every command that reads images.

    python tests/trust/hostile.py

writes them to a temporary folder, runs each command on all of them in a process of its own, and tells exit
code, time and peak memory. A traceback, another exit code than is due, unreadable files that are not counted
(where a folder is read) or not named (where files are), and more memory than ``MEMORY_LIMIT_MB`` are faults.
"""

import http.client
import os
import resource
import sys
import tempfile
import time
from pathlib import Path
from urllib.parse import urlsplit

from apart import start
from hostile_files import Hostile, encoded, named_in, smooth, write_hostile, write_hostile_zip
from tests.report.viewer.serving import serving

from derender.cli import main
from derender.model import load
from derender.report.viewer.app import Application
from derender.report.viewer.studio import Shelf, Studio

MEMORY_LIMIT_MB = 3_000
"""Of a process, interpreter and network included; an image of 169 million pixels takes 676 MB by itself."""

CPU_SECONDS = 600
MODEL = "rendered-faces-64"
TINY_RUN = ("image_size=32", "width=4", "light_width=4", "images=16", "batch_size=8")
TINY_RUN += ("perceptual=none", "whitening.pictures=8")
FOLDER_COMMANDS = {
    "doctor": "doctor DATA",
    "train": "train --data DATA --device cpu TINY --preset small --out PLACE/run",
    "report": "report PLACE/run --data DATA --device cpu --force",
    "finetune": "finetune --data DATA --device cpu TINY --label class --model PLACE/run --out PLACE/tuned",
    "whiten": "whiten READS --set pictures=8 --out PLACE/white",
    "refine": "refine READS --set images=16 --set fitted=8 --set fit_steps=2 --set whitening.pictures=8"
    " --out PLACE/refined",
    "unet": "unet READS --set images=16 --out PLACE/unet",
    "embed": "embed READS --out PLACE/F.parquet",
    "evaluate cluster": "evaluate cluster READS --label class --resamples 20",
    "evaluate linear": "evaluate linear READS --label class --resamples 20 --counts 20 --seeds 1",
    "evaluate reconstruction": "evaluate reconstruction READS --resamples 20",
    "evaluate robustness": "evaluate robustness READS --resamples 20 --limit 40",
    "evaluate geometry": "evaluate geometry READS --resamples 20",
    "evaluate disentangle": "evaluate disentangle READS",
    "evaluate segment": "evaluate segment READS --resamples 20",
    "compare": "compare --table cars --model m=MODEL --data DATA --device cpu --resamples 20",
    "explain": "explain READS --label class --seeds 1 --out PLACE/why",
}
REFUSING = ("evaluate geometry", "evaluate segment")
UNCOUNTED = ("evaluate robustness", "evaluate disentangle", "report")  # the page of a report counts
IMAGE_COMMANDS = {
    "decompose": "--out PLACE/apart",
    "relight": "--size 64 --stills 2 --film none --out PLACE/relit",
    "rotate": "--size 64 --stills 2 --film none --out PLACE/turned",
    "swap": "--from PLAIN --size 64 --out PLACE/mixed",
    "mesh": "--out PLACE/solid",
}
SEARCHED = ("empty.png", "nan.tif", "bomb.png", "cut 08 of 16.jpg", "to itself.png", "pipe.png")


class Bench:
    """Runs commands and collects what is wrong."""

    def __init__(self, place: Path):
        self.place, self.faults = place, 0

    def run(self, name: str, arguments: list[str], due: int, counted: str = "", named: tuple[str, ...] = ()):
        """One command in a process of its own, which must end with this code and say these things."""
        log, began = self.place / "log", time.monotonic()

        def work() -> int:
            resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
            return main(arguments)

        _, status, usage = os.wait4(start(work, log), 0)
        code, message = os.waitstatus_to_exitcode(status), log.read_text(errors="replace")
        megabytes = usage.ru_maxrss / 1024
        wrong = [f"exit code {code} and not {due}: {message[-400:]}"] if code != due else []
        wrong += [f"a traceback: {message[-1500:]}"] if "Traceback" in message else []
        wrong += [f"{megabytes:,.0f} MB"] if megabytes > MEMORY_LIMIT_MB else []
        wrong += [f"does not count {counted}: {message[:400]}"] if counted not in message else []
        wrong += [f"does not name {one}" for one in named_in(message.replace("\\t", " "), named)]
        took = time.monotonic() - began
        self.tell(f"{name}: exit code {code}, {took:.0f} s, {megabytes:,.0f} MB", wrong)

    def tell(self, line: str, wrong: list[str]) -> None:
        self.faults += len(wrong)
        print(line, *(f"  {one}" for one in wrong), sep="\n", flush=True)


def labelled(folder: Path, hostile: Hostile) -> int:
    """The same files in two classes, with 12 plain images each; gives how many of them cannot be read."""
    for number, name in enumerate("ab"):
        (folder / name).mkdir(parents=True)
        for row in range(12):
            (folder / name / f"plain {row}.png").write_bytes(encoded(smooth(500 + 2 * row + number)))
        for file in (*hostile.readable, *hostile.unreadable):
            if (hostile.folder / file).is_file() and len(file) < 200:
                (folder / name / file).write_bytes((hostile.folder / file).read_bytes())
    return 2 * sum((hostile.folder / file).is_file() for file in hostile.unreadable)


def uploads(hostile: Hostile) -> list[str]:
    """Send every file to a viewer; gives what was answered otherwise than is due."""
    faults = []
    with serving(Application(Studio(load(MODEL), "m", Shelf(2)))) as url:
        server = urlsplit(url).netloc
        for file in (*hostile.readable, *hostile.unreadable):
            if (hostile.folder / file).is_file():
                connection = http.client.HTTPConnection(server, timeout=60)
                headers = {"X-Derender-Page": "1", "Origin": f"http://{server}"}
                connection.request("POST", "/api/pictures", (hostile.folder / file).read_bytes(), headers)
                status = connection.getresponse().status
                connection.close()
                if status not in ((200,) if file in hostile.readable else (413, 415)):
                    faults.append(f"{file}: {status}")
    return faults


def run_all() -> int:
    """The script."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        os.environ["DERENDER_CACHE"] = str(place / "cache")
        bench, hostile = Bench(place), write_hostile(place / "hostile")
        print(len(hostile.readable), "odd images,", len(hostile.unreadable), "that are broken", flush=True)
        broken = labelled(place / "classes", hostile)
        words = {
            "READS": f"--model {MODEL} --data DATA --device cpu",
            "TINY": " ".join(f"--set {setting}" for setting in TINY_RUN),
            "DATA": str(place / "classes"), "PLACE": folder, "MODEL": MODEL,
            "PLAIN": str(hostile.folder / "plain.jpg"),
        }  # fmt: skip

        def split(text: str) -> list[str]:
            for word, value in words.items():
                text = text.replace(word, value)
            return text.split()

        for name, text in FOLDER_COMMANDS.items():
            counts = name not in (*REFUSING, *UNCOUNTED)
            bench.run(name, split(text), 2 * (name in REFUSING), f"{broken} skipped" if counts else "")
        archive = write_hostile_zip(place / "hostile.zip")
        embed = split("embed --model MODEL --device cpu --out PLACE/Z.parquet")
        bench.run("embed of a zip", [*embed, "--data", str(archive)], 0, "8 skipped")
        names = [name for name in (*hostile.readable, *hostile.unreadable) if "xff" not in name]
        files = [str(hostile.folder / name) for name in names]
        for name, text in IMAGE_COMMANDS.items():
            given = [name, *files, *split(f"--model MODEL --device cpu {text}")]
            bench.run(name, given, 2, named=hostile.unreadable)
        search = split("search --features PLACE/F.parquet --model MODEL --device cpu --like")
        for file in SEARCHED:
            bench.run(f"search --like {file}", [*search, str(hostile.folder / file)], 2)
        wrong = uploads(hostile)
        bench.tell(f"view, every file uploaded: {len(wrong)} answered otherwise than is due", wrong)
    print(f"{bench.faults} faults")
    return 1 if bench.faults else 0


if __name__ == "__main__":
    sys.exit(run_all())
