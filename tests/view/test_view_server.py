"""The page's server without a browser."""

import asyncio
import copy
import socket
from contextlib import closing
from types import SimpleNamespace

import pytest
import torch
from websockets.sync.client import connect

from ctm_plugin.color.light import brighten
from ctm_plugin.runs.evaluate import run_figures
from ctm_plugin.view.camera import Camera
from ctm_plugin.view.command import ViewConfig, view
from ctm_plugin.view.live_run import Subject
from ctm_plugin.view.server import Look, Viewer, check_free, names


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return listening.getsockname()[1]


@pytest.fixture
def viewer(runs):
    with closing(Viewer([Subject(runs["on"])], "127.0.0.1", free_port())) as viewer:
        yield viewer


def look_of(viewer: Viewer) -> Look:
    (subject,) = viewer.subjects.values()
    return Look(subject, "rgb", Camera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, 1.0), 1.0)


def test_checkpoints_are_taken_before_pictures_and_a_first_picture_tells_nothing(viewer, monkeypatch):
    taken = []
    monkeypatch.setattr(Subject, "refresh", lambda subject: taken.append(subject))
    look = look_of(viewer)
    assert [viewer._prepare(look) for _ in range(3)] == [False, True, True]
    assert taken == [look.subject] * 3


def test_light_begins_where_it_is_told_and_lifts_what_is_lifted(runs, viewer):
    (subject,) = viewer.subjects.values()
    assert 2**viewer.stops == pytest.approx(subject.run.factor)
    with closing(Viewer([subject], "127.0.0.1", free_port(), "3.5")) as another:
        assert another.stops == 3.5
    look = look_of(viewer)
    more, less = (viewer._paint(look._replace(kind="lifted", factor=f), 8, lambda: True) for f in (16.0, 2.0))
    plain, same = (viewer._paint(look._replace(factor=f), 8, lambda: True) for f in (16.0, 2.0))
    assert (more >= less).all()
    assert more.mean() > less.mean()
    assert torch.equal(plain, same)
    assert torch.allclose(less, brighten(plain, 2.0), atol=1e-6)


def test_who_has_gone_before_being_welcomed_is_forgotten(viewer):
    viewer._controls[7] = object()
    viewer.painter.ask(7, look_of(viewer))
    assert viewer.painter.step()
    assert not viewer.painter.step()
    assert viewer._controls == {}


def test_who_goes_while_asking_is_forgotten(viewer):
    """Its controls go first: with them a look could be asked for after it was forgotten."""
    viewer._controls[7] = object()
    viewer.painter.forget = lambda client: calls.append((client, dict(viewer._controls)))
    calls = []
    for forget in viewer.server._client_disconnect_cb:
        forget(SimpleNamespace(client_id=7))
    assert calls == [(7, {})]


def test_closing_leaves_nothing_of_clients(viewer):
    """Python would complain of their tasks as it exits."""
    with connect(f"ws://127.0.0.1:{viewer.server.get_port()}") as client:
        client.recv()
        viewer.close()
    assert asyncio.all_tasks(viewer.server._event_loop) == set()


@pytest.mark.parametrize("end", [KeyboardInterrupt, torch.OutOfMemoryError])
def test_the_server_ends_with_the_painting(runs, monkeypatch, end):
    def work(viewer):
        raise end

    monkeypatch.setattr(Viewer, "work", work)
    port = free_port()
    if end is KeyboardInterrupt:
        view(runs["on"], settings=ViewConfig(port=port))
    else:
        with pytest.raises(end):
            view(runs["on"], settings=ViewConfig(port=port))
    check_free("127.0.0.1", port)


def test_a_configuration_need_not_name_a_preset(runs):
    """Written by hand it may not: then the transform's name says what CTM it is."""
    subjects = [Subject(runs["on"]), Subject(runs["off"])]
    for subject in subjects:
        del subject.run.config["ctm"]["preset"]
    assert names(subjects) == ["CTM ctm", "CTM none"]
    run = subjects[0].run
    assert run_figures(run.module, copy.deepcopy(run.config), 1, 1.0, 0.0)["ctm"] == "ctm"
