"""The command line of the viewer, and what it refuses."""

import signal
import socket
import time
import urllib.request
from importlib.util import find_spec

import pytest
from forked import Command

from ctm_plugin.cli import main
from ctm_plugin.errors import CTMError
from ctm_plugin.view import command as module
from ctm_plugin.view.live_run import Subject
from ctm_plugin.view.server import check_same_scene, names


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere: found no such directory"),
        (["RUN", "nowhere"], "nowhere: found no such directory"),
        (["RUN", "port=0"], "port: found 0"),
        (["RUN", "port=99999"], "host, port: found '127.0.0.1, 99999', expected an address to listen at"),
        (["RUN", "size=8"], "size: found 8, expected"),
        (["RUN", "seconds=0"], "seconds: found 0.0, expected in (0, 600]"),
        (["RUN", "port=many"], "view.port: found 'many'"),
        (["RUN", "host=203.0.113.7"], "host, port: found '203.0.113.7, 8080', expected an address to listen at"),
        (
            ["RUN", "speed=2"],
            "view.speed: found 'an unknown key', expected one of dataset.root, host, light, port, seconds, size",
        ),
        (["RUN", "port=8080", "host"], "found 'host', expected key=value"),
    ],
)
def test_mistakes(runs, capsys, arguments, message):
    assert main(["view", *(str(runs["on"]) if argument == "RUN" else argument for argument in arguments)]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error


def test_a_port_in_use(runs, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert main(["view", str(runs["on"]), f"port={taken.getsockname()[1]}"]) == 1
    assert "Address already in use" in capsys.readouterr().err


@pytest.mark.parametrize("found", ["no such package", "0.2.23", "1.0.30"])
def test_without_the_extra_it_says_what_to_install(runs, monkeypatch, capsys, found):
    monkeypatch.setattr(module, "find_spec", lambda name: None if found.startswith("no") else find_spec(name))
    monkeypatch.setattr(module, "version", lambda name: found)
    assert main(["view", str(runs["on"])]) == 1
    assert f"found {found}, expected version 1.1 or newer: pip install -e '.[view]'" in capsys.readouterr().err


def test_runs_are_named_by_what_differs(runs):
    on, off = Subject(runs["on"]), Subject(runs["off"])
    assert names([on, off]) == ["CTM quick", "CTM off"]
    assert names([on, on]) == [str(runs["on"])] * 2


def test_runs_of_other_scenes_are_refused(runs, forward_run):
    subjects = [Subject(runs["on"]), Subject(forward_run)]
    with pytest.raises(CTMError, match="found a run of hall with other test cameras, expected those of ball"):
        check_same_scene(subjects)
    check_same_scene(subjects[:1])


def test_a_folder_with_an_equals_sign_is_a_run(runs, tmp_path, capsys):
    folder = tmp_path / "ctm=on"
    folder.mkdir()
    assert main(["view", str(folder)]) == 1
    assert f"{folder}: found no config.yaml" in capsys.readouterr().err


def test_it_serves_until_ctrl_c(runs, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
    process = Command("view", str(runs["on"]), f"port={port}", told=tmp_path / "told")
    until = time.monotonic() + 120
    while "ends it" not in process.said() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    assert f"http://127.0.0.1:{port}/" in process.said().split()  # nothing touches it that a click would take along
    with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=20) as page:
        assert page.status == 200
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate()
    assert (process.returncode, errors) == (0, "")


def test_planar_runs_are_refused(tmp_path, capsys):
    folder = tmp_path / "planar"
    small = ("dataset.height=24", "dataset.width=32", "dataset.patch=12", "backbone.steps=2")
    assert main(["backbone=barf2d", "trainer=smoke", "ctm=off", *small, f"hydra.run.dir={folder}"]) == 0
    assert main(["view", str(folder)]) == 1
    assert f"{folder}: found a run of another kind" in capsys.readouterr().err
