"""Images per second of the viewer: one client, then many at once, each moving light and camera.

The server runs in a process of its own, the clients in threads of another, on one machine and share its
cores; the clients' time is small. Every answer is checked: an image of the right size, and not the one
before. Ends by itself after ``--seconds`` for each size and number of clients.

    .venv/bin/python benchmarks/view.py --clients 1 20 --size 256 512
"""

import http.client
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from math import sin
from pathlib import Path
from threading import Barrier

import numpy as np
from machine import parser, publish
from PIL import Image

HEADERS = {"X-Derender-Page": "1"}


@dataclass(frozen=True)
class Visit:
    """What one client saw: seconds of each answer, and how many were refused."""

    seconds: list[float]
    refused: int


def visit(host: str, port: int, number: int, size: int, seconds: float, together: Barrier) -> Visit:
    """Open an example, wait for the other clients, then ask for it in ever other lights and views."""
    connection = http.client.HTTPConnection(host, port, timeout=60)

    def ask(path: str, body: object = None) -> tuple[int, bytes]:
        connection.request("POST", path, json.dumps(body), HEADERS)
        answer = connection.getresponse()
        return answer.status, answer.read()

    status, content = ask(f"/api/examples/{number % 8}")
    assert status == 200, content
    name = json.loads(content)["picture"]
    together.wait()
    taken: list[float] = []
    refused, before, end = 0, b"", time.perf_counter() + seconds
    while (began := time.perf_counter()) < end:
        step = len(taken) + 100 * number
        light = {
            "ambient": 0.4,
            "diffuse": 0.6,
            "pitch_deg": 20 * sin(step / 7),
            "yaw_deg": 60 * sin(step / 5),
        }
        camera = {"rotation_deg": [0, 30 * sin(step / 9), 0], "translation": [0, 0, 0]}
        status, content = ask("/api/view", {"picture": name, "light": light, "camera": camera, "size": size})
        if status != 200:
            refused += 1
            continue
        assert max(Image.open(io.BytesIO(content)).size) == size
        assert content != before, "the light moved and the image did not"
        before = content
        taken.append(time.perf_counter() - began)
    connection.close()
    return Visit(taken, refused)


def cpu_seconds(process: subprocess.Popen) -> float:
    """Processor time that the server has used, which other programs on the machine do not change."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb(process: subprocess.Popen) -> float:
    """Resident memory of the server."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--model", default="faces-64", help="which model (default faces-64)")
    asks.add_argument(
        "--clients", type=int, nargs="+", default=[1, 20], help="how many at once (default 1 20)"
    )
    asks.add_argument(
        "--size", type=int, nargs="+", default=[256, 512], help="longer side of images (default 256 512)"
    )
    asks.add_argument("--seconds", type=float, default=10, help="for each number of clients (default 10)")
    options = asks.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder) / "told.json"
        words = ["view", "--model", options.model, "--json", str(told), "--device", "cpu"]
        server = subprocess.Popen([sys.executable, "-m", "derender", *words], stdout=subprocess.DEVNULL)
        try:
            while not told.exists():
                assert server.poll() is None, "the viewer ended by itself"
                time.sleep(0.2)
            where = json.loads(told.read_text())
            visit(
                where["host"], where["port"], 0, options.size[0], 2, Barrier(1)
            )  # compiles what is compiled once
            for size, clients in product(options.size, options.clients):
                before, together = cpu_seconds(server), Barrier(clients)
                with ThreadPoolExecutor(clients) as pool:
                    visits = [
                        pool.submit(visit, where["host"], where["port"], n, size, options.seconds, together)
                        for n in range(clients)
                    ]
                    results = [one.result() for one in visits]
                seconds = np.concatenate([one.seconds for one in results])
                row = {
                    "size": size,
                    "clients": clients,
                    "pictures_per_second": len(seconds) / options.seconds,
                    "pictures_per_cpu_second": len(seconds) / (cpu_seconds(server) - before),
                    "slowest_client_per_second": min(len(one.seconds) for one in results) / options.seconds,
                    "cpu_ms": 1e3 * (cpu_seconds(server) - before) / len(seconds),
                    "median_ms": float(np.median(seconds) * 1e3),
                    "p99_ms": float(np.quantile(seconds, 0.99) * 1e3),
                    "refused": sum(one.refused for one in results),
                    "server_mb": memory_mb(server),
                }
                rows.append(row)
                print(", ".join(f"{name} {value:,.1f}" for name, value in row.items()), flush=True)
        finally:
            server.terminate()
            server.wait(30)
    publish({"benchmark": "view", "rows": rows}, options.json)


if __name__ == "__main__":
    main()
