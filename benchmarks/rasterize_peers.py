"""derender's rasteriser on the CPU beside others: the same depth maps, forward and backward, in one run.

Before any clock runs every peer is held against derender's definition in plain torch: the same pixels hit
(a few at borders aside, which then count nowhere), the same points there, and the same gradient for random
cotangents. Where a ray meets an edge of the mesh, both its triangles are right and their gradients differ:
such pixels carry no cotangent, and their share is told. A peer whose gradient is off by more than 1 % is
timed, and said to be off; it is no rival for the ratio. Then all take turns; a time is the median over
rounds. Peers that are not installed are named.

    python benchmarks/rasterize_peers.py --sizes 64 256 --json benchmarks/results/rasterize_peers.json
"""

import importlib.util
import statistics
import time
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch
from machine import parser, publish
from peers import PEERS, Ours, Peer
from rasterize import FOV_DEG, surfaces
from torch import Tensor

from derender.scene.camera import focal_px, to_camera, unproject

SEEN_ALIKE = 0.98  # share of pixels that must be hit alike and show the same point
POINT_TOLERANCE = 2e-2  # of a pixel: where triangles fold over each other float32 may choose the other one
EXACT_GRADIENT = 1e-2  # of the gradient's norm
ON_EDGE = 1e-3  # of a cell: nearer to an edge, float32 may choose the triangle beyond it
DISTRIBUTIONS = {"warp": "warp-lang", "embreex": "embreex", "mitsuba": "mitsuba", "deodr": "deodr"}


def held_against(peer: Peer, expected: Peer, vertices: Tensor) -> dict[str, Any]:
    """How far a peer is from the definition: pixels, points, depth, gradient."""
    uv, depth, hit, _ = expected.run(vertices, None)
    found_uv, found_depth, found_hit, _ = peer.run(vertices, None)
    alike = (hit == found_hit) & ((uv - found_uv).abs().amax(-1) < POINT_TOLERANCE)
    near_edge = edge_distance(uv) < ON_EDGE
    both = alike & hit & ~near_edge
    if not both.any():
        return {"pixels_alike": float(alike.float().mean()), "gradient_off": float("inf"), "exact": False}
    draw = torch.Generator().manual_seed(1)
    cotangents = torch.randn(uv.shape, generator=draw), torch.randn(depth.shape, generator=draw)
    cotangents = cotangents[0] * both[..., None], cotangents[1] * both
    wanted, result = (one.run(vertices, cotangents)[3] for one in (expected, peer))
    assert wanted is not None and result is not None
    apart = float((result - wanted).norm() / wanted.norm())
    share = float(alike.float().mean())
    return {
        "pixels_alike": share,
        "pixels_on_edges": float(near_edge[hit].float().mean()),
        "uv_difference_px": float((uv - found_uv)[both].abs().max()),
        "depth_difference": float((depth - found_depth)[both].abs().max()),
        "gradient_off": apart,
        "exact": share >= SEEN_ALIKE and apart <= EXACT_GRADIENT,
    }


def edge_distance(uv: Tensor) -> Tensor:
    """How far points (..., 2) of the grid lie from its triangles' nearest edge along an axis; 0..1/3."""
    u, v = (uv % 1).unbind(-1)
    return torch.stack((u, 1 - u, v, 1 - v, (u + v - 1).abs())).amin(dim=0)


def milliseconds(peers: dict[str, Peer], vertices: Tensor, rounds: int) -> dict[str, dict[str, float]]:
    """Median over rounds of forward alone and of both ways, all peers in turns, after one to warm up."""
    draw = torch.Generator().manual_seed(2)
    cotangents = (
        torch.randn(*vertices.shape[:3], 2, generator=draw),
        torch.randn(vertices.shape[:3], generator=draw),
    )
    taken: dict[str, dict[str, list[float]]] = {name: {"forward": [], "both ways": []} for name in peers}
    for number in range(rounds + 1):
        for name, peer in peers.items():
            for way, given in (("forward", None), ("both ways", cotangents)):
                began = time.perf_counter()
                peer.run(vertices, given)
                if number:
                    taken[name][way].append(1e3 * (time.perf_counter() - began))
    return {
        name: {way: statistics.median(values) for way, values in ways.items()} for name, ways in taken.items()
    }


def installed() -> tuple[dict[str, str], list[str]]:
    """Versions of the peers that are here, and names of those that are not."""
    result, missing = {}, []
    for name, (module, _) in PEERS.items():
        if importlib.util.find_spec(module) is None:
            missing.append(name)
            continue
        try:
            result[name] = version(DISTRIBUTIONS[module])
        except PackageNotFoundError:
            result[name] = "unknown version"
    return result, missing


def one_size(size: int, maps: int, rounds: int, versions: dict[str, str]) -> dict[str, Any]:
    depth, _, _, camera = surfaces(maps, size)
    focal = focal_px(size, FOV_DEG)
    vertices = to_camera(unproject(depth, FOV_DEG), camera).detach()
    definition = Ours(maps, size, focal, "reference")
    peers: dict[str, Peer] = {"derender, Numba": Ours(maps, size, focal, "numba")}
    failed = {}
    for name in versions:
        try:
            peers[name] = PEERS[name][1](maps, size, focal)
            peers[name].run(vertices, None)
        except Exception as problem:
            peers.pop(name, None)
            failed[name] = f"{type(problem).__name__}: {str(problem).splitlines()[0][:200]}"
    checks = {name: held_against(peer, definition, vertices) for name, peer in peers.items()}
    if not checks["derender, Numba"]["exact"]:
        raise SystemExit(f"derender's own rasteriser disagrees with its definition: {checks}")
    times = milliseconds({"derender, torch": definition, **peers}, vertices, rounds)
    ours = times["derender, Numba"]["both ways"]
    exact = {
        name: times[name]["both ways"]
        for name in peers
        if name != "derender, Numba" and checks[name]["exact"]
    }
    best = min(exact, key=exact.__getitem__) if exact else None
    return {
        "size": size, "maps": maps, "checks": checks, "milliseconds": times, "failed": failed,
        "best_exact_peer": best, "ratio_to_best_exact_peer": None if best is None else exact[best] / ours,
        "ratio_to_torch": times["derender, torch"]["both ways"] / ours,
    }  # fmt: skip


def show(row: dict[str, Any]) -> None:
    print(f"{row['maps']} maps of {row['size']}x{row['size']}")
    for name, ways in row["milliseconds"].items():
        check = row["checks"].get(name)
        note = "the definition" if check is None else f"gradient off by {check['gradient_off']:.1e}"
        if check is not None and not check["exact"]:
            note += f", {check['pixels_alike']:.1%} of pixels alike: NOT EXACT"
        print(f"  {name:18} {ways['forward']:9.1f} ms forward {ways['both ways']:9.1f} ms both ways   {note}")
    for name, why in row["failed"].items():
        print(f"  {name:18} failed: {why}")
    if row["best_exact_peer"]:
        ratio = row["ratio_to_best_exact_peer"]
        against_torch = f"{row['ratio_to_torch']:.1f}x torch"
        print(f"  {ratio:.1f}x the best exact peer ({row['best_exact_peer']}), {against_torch}")


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--sizes", type=int, nargs="+", default=[64, 256], help="pixels")
    asks.add_argument("--maps", type=int, default=16, help="depth maps in a call")
    asks.add_argument("--rounds", type=int, default=7, help="timed rounds after one to warm up")
    asks.add_argument("--threads", type=int, default=torch.get_num_threads(), help="torch's threads")
    options = asks.parse_args()
    torch.set_num_threads(options.threads)
    versions, missing = installed()
    rows = []
    for size in options.sizes:
        rows.append(one_size(size, options.maps, options.rounds, versions))
        show(rows[-1])
    missing = [*missing, "PyTorch3D (no wheel)"]
    print(f"not installed: {', '.join(missing)}")
    result = {"benchmark": "rasterise beside peers", "rows": rows, "peers": versions, "missing": missing}
    publish(result, options.json)


if __name__ == "__main__":
    main()
