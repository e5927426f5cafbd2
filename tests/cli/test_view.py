"""`derender view` as a person meets it: what it prints, what it refuses, how it ends."""

import http.client
import json
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from tests.cli.conftest import noise, run

from derender import Derenderer

SIZE = 32


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    return noise(tmp_path_factory.mktemp("photos"), 3, SIZE, cells=6)


@pytest.fixture
def served(monkeypatch):
    """What would be served; the server itself does not run."""
    results = []

    def instead(application, listener):
        results.append((application, listener.getsockname()))
        application.close()

    monkeypatch.setattr("derender.report.viewer.server.serve", instead)
    return results


def test_it_listens_on_this_machine_only(tiny, photos, served, tmp_path, capsys):
    table, told = tmp_path / "F.parquet", tmp_path / "told.json"
    assert run("embed", "-m", tiny, "-d", photos, "-o", table) == 0
    (photos / "no.jpg").write_text("<html>")
    words = ("view", "-m", tiny, photos / "0.png", photos / "no.jpg", "-f", table)
    assert run(*words, "--json", told, "--keep", 7) == 0
    (application, place) = served[0]
    assert place[0] == "127.0.0.1"
    studio = application.studio
    assert [example.name for example in studio.examples] == ["0.png"]
    assert studio.shelf.limit == 7
    assert len(studio.gallery.table) == 3 and not studio.gallery.without_pictures
    assert json.loads(told.read_text())["url"] == f"http://127.0.0.1:{place[1]}/"
    printed = capsys.readouterr()
    assert f"open http://127.0.0.1:{place[1]}/" in printed.out
    assert "left out" in printed.err and "no password" not in printed.err
    (photos / "no.jpg").unlink()


def test_listening_elsewhere_is_warned_of(tiny, photos, served, capsys):
    assert run("view", "-m", tiny, photos / "0.png", "--host", "0.0.0.0") == 0
    assert served[0][1][0] == "0.0.0.0"
    assert "no password" in capsys.readouterr().err


def test_what_is_refused(tiny, photos, refused, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        line = refused("view", "-m", tiny, "--port", port)
    assert f"port {port} of 127.0.0.1 is in use: choose another port" in line
    message = refused("view", "-m", tiny, "--fit-steps", 5)
    assert "cannot optimise scenes per image yet: derender whiten" in message
    assert "no address of this machine" in refused("view", "-m", tiny, "--host", "no such host")
    assert "0..65535" in refused("view", "-m", tiny, "--port", 70_000)
    assert "does not exist" in refused("view", "-m", tiny, tmp_path / "none.png")
    assert "no model at" in refused("view", "-m", tmp_path / "none")
    other = Derenderer.from_preset("small", seed=1, image_size=SIZE, width=4, light_width=4)
    other.save(tmp_path / "other")
    table = tmp_path / "F.parquet"
    assert run("embed", "-m", tmp_path / "other", "-d", photos, "-o", table) == 0
    assert "made by another model" in refused("view", "-m", tiny, "-f", table)


@contextmanager
def viewing(told: Path, *words: object) -> Iterator[str]:
    """The address of a viewer in a process of its own, which at the end is stopped by Ctrl-C and says so."""
    command = [sys.executable, "-m", "derender", "view", *map(str, words), "--json", str(told)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # where tests run in the background, too
    with subprocess.Popen(command, text=True, preexec_fn=heard, **pipes) as process:
        try:
            yield _url(process, told)
            process.send_signal(signal.SIGINT)
            _, message = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0
    assert message.strip() == "stopped"


def test_it_answers_until_ctrl_c_which_does_not_wait_for_a_running_fit(photos, tmp_path):
    words = ("-m", "rendered-faces-64", photos / "1.png", "--fit-steps", 10_000)
    with viewing(tmp_path / "told.json", *words) as url:
        with urllib.request.urlopen(url, timeout=60) as page:
            assert b"relight and turn a photograph" in page.read()
        foreign = urllib.request.Request(url, headers={"Host": "rebound.example"})
        with pytest.raises(urllib.error.HTTPError, match="421") as answer:
            urllib.request.urlopen(foreign, timeout=60)
        answer.value.close()
        connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=60)
        connection.request("POST", "/api/examples/0", headers={"X-Derender-Page": "1"})
        time.sleep(1)
    assert connection.getresponse().status == 500  # the fit was not waited for
    connection.close()


def _url(process: subprocess.Popen, told) -> str:
    for _ in range(1200):
        if told.exists():
            return json.loads(told.read_text())["url"]
        assert process.poll() is None, "it ended by itself"
        time.sleep(0.1)
    raise AssertionError("it did not start within two minutes")
