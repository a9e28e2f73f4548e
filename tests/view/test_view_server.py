"""The page's server without a browser."""

import socket
from contextlib import closing

import pytest

from ctm_plugin.view.camera import Camera
from ctm_plugin.view.server import Look, Viewer
from ctm_plugin.view.subject import Subject


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return listening.getsockname()[1]


@pytest.fixture
def viewer(runs):
    with closing(Viewer([Subject(runs["on"])], "127.0.0.1", free_port())) as viewer:
        yield viewer


def look_of(viewer: Viewer) -> Look:
    (subject,) = viewer.subjects.values()
    return Look(subject, "rgb", Camera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, 1.0))


def test_checkpoints_are_taken_before_pictures_and_a_first_picture_tells_nothing(viewer, monkeypatch):
    taken = []
    monkeypatch.setattr(Subject, "refresh", lambda subject: taken.append(subject))
    look = look_of(viewer)
    assert [viewer._prepare(look) for _ in range(3)] == [False, True, True]
    assert taken == [look.subject] * 3
