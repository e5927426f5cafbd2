"""`derender bench`: speed on this machine, as ratios of two things measured in turns in one run."""

from derender.cli import options
from derender.cli.console import progress_bar, result, write_json
from derender.cli.options import command, option

QUICK = "Smaller sizes and one round: a minute."


@command("bench", "bench --quick --json speed.json")
def bench(quick: bool = option(False, QUICK, "--quick"), json_file: options.Json = None) -> None:
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
