"""The command line of the viewer, and what it refuses."""

import signal
import socket
import time
import urllib.request

import pytest
from forked import Command


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere: found no such directory"),
        (["RUN", "nowhere"], "nowhere: found no such directory"),
        (["RUN", "FORWARD"], "found a run of hall with other test cameras, expected those of ball"),
        (["RUN", "port=0"], "port: found 0"),
        (["RUN", "port=99999"], "port: found 99999, expected an integer, 1 to 65535"),
        (["RUN", "port=TAKEN"], "Address already in use"),
        (["RUN", "port=many"], "port: found 'many'"),
        (["RUN", "speed=2"], "speed: found an unknown key, expected one of contrast, dataset.root, light"),
        (["RUN", "port=8080", "light"], "found 'light', expected key=value"),
        (["ctm=on"], "ctm=on: found no config.yaml"),  # a folder of that name is a run
    ],
)
def test_mistakes(runs, forward_run, refused, monkeypatch, tmp_path, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ctm=on").mkdir()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        meant = {"RUN": runs["on"], "FORWARD": forward_run, "port=TAKEN": f"port={taken.getsockname()[1]}"}
        assert message in refused("view", *(str(meant.get(argument, argument)) for argument in arguments))


def test_without_the_extra_it_says_what_to_install(runs, monkeypatch, refused):
    monkeypatch.setattr("ctm_plugin.view.command.find_spec", lambda name: None)
    assert "viser: found no such package, expected version 1.1 or newer: pip" in refused("view", str(runs["on"]))


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
    said, errors = process.communicate()
    assert (process.returncode, errors) == (0, "")
    assert said.endswith(f"next: ctm render {runs['on']}\n")
