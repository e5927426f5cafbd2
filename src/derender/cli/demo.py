"""`derender demo` and `bench`: the whole story on built-in data in one report, and ratios of speeds."""

import time
from itertools import count
from pathlib import Path
from typing import Any

from derender.cli import options
from derender.cli.console import duration, notice, progress_bar, result, show_scores, write_json
from derender.cli.options import command, option


@command("demo", "demo --quick")
def demo(
    images: options.Images = None,
    out: Path | None = option(None, "New folder for everything it makes.", "--out", "-o", metavar="DIR"),
    quick: bool = option(False, "About one minute: to see that it runs, not how good it is.", "--quick"),
    seed: options.Seed = 0,
    json_file: options.Json = None,
) -> None:
    """Edit portraits, train on generated faces or your own images, score, write one page. Offline."""
    began = time.monotonic()
    notice("decomposing images, learned from scratch on this machine" + (" (quick)" if quick else ""))
    from derender.demo import FULL, QUICK, demo_page, run_demo, run_own_demo
    from derender.demo.page import score_tables
    from derender.training.process import TrainingInterrupted

    names = (f"derender-demo{f'-{number}' if number > 1 else ''}" for number in count(1))
    folder = out or next(Path(name) for name in names if not Path(name).exists())
    values: dict[str, Any] = {"report": folder / "report.html"}
    try:
        with progress_bar("starting", "") as report:
            how: dict[str, Any] = {
                "seed": seed,
                "report": lambda stage, done, total, note: report(done, total, note, description=stage),
                "opened": lambda page: notice(f"open {page} now: it fills in while a model trains"),
            }
            settings, story = QUICK if quick else FULL, None
            if images is not None:
                run_own_demo(images, folder, settings, **how)
            else:
                story = run_demo(folder, settings, **how)
                demo_page(story).write(folder / "report.html")
    except TrainingInterrupted as stop:
        raise KeyboardInterrupt(f"stopped: run derender demo again ({folder} can be deleted)") from stop
    if story is not None:
        for name, table in score_tables(story).items():
            show_scores(table, json_file)
            result("", json_file)
            values[name] = table.values()
        values |= {"run": story.trained, "seconds": story.seconds}
        notice(*(f"{one.sign}: {one.text}; {one.advice}" for one in story.trained.findings))
    notice(f"done in {duration(time.monotonic() - began)}; the model is in {folder / 'run'}")
    result(f"report {folder / 'report.html'}", json_file)
    write_json(json_file, values)


@command("bench", "bench --quick --json speed.json")
def bench(
    quick: bool = option(False, "One small round: a minute.", "--quick"), json_file: options.Json = None
) -> None:
    """Measure speed on this machine, as ratios: rasteriser, embedding beside training, clustering."""
    from derender.speed import bench as measure

    with progress_bar("measuring", unit="pairs") as report:
        measured = measure(quick, report)
    for row in measured["rows"]:
        speeds = f"{row['ours_per_second']:,.1f} against {row['theirs_per_second']:,.1f} {row['unit']}/s"
        spread = f"rounds {row['least']:.2f}..{row['most']:.2f}"
        result(f"{row['what']}: {row['ratio']:.2f}x ({speeds}; {spread})", json_file)
    share, seconds, unaided = (measured["waiting"][key] for key in ("share", "seconds", "share_unaided"))
    spent = f"{share:.2%} of {seconds:.1f} s spent waiting for data ({unaided:.2%} without reading ahead)"
    result(f"training, preset small, images in a mapped file: {spent}", json_file)
    write_json(json_file, measured)
