"""The page's server without a browser."""

import socket
import urllib.error
import urllib.request
from contextlib import closing
from dataclasses import astuple
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import viser

from ctm_plugin.color.light import Light
from ctm_plugin.view.command import view
from ctm_plugin.view.page import NOTHING, PHOTOGRAPH, Page
from ctm_plugin.view.painter import Look, Renderings, Viewpoint
from ctm_plugin.view.server import Viewer, admitted, check_free, names
from ctm_plugin.view.settings import ViewConfig
from ctm_plugin.view.sources import Subject

HERE = "127.0.0.1:8080"


def at_free_port(**settings) -> ViewConfig:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return ViewConfig(port=listening.getsockname()[1], **settings)


@pytest.fixture(scope="module")
def subjects(runs):
    return [Subject(runs["on"]), Subject(runs["off"])]


@pytest.fixture(scope="module")
def viewer(subjects):
    with closing(Viewer(subjects, at_free_port())) as viewer:
        yield viewer


def a_client(viewer: Viewer) -> Mock:
    """A browser's side without one: viser's own controls and scene, and a camera that stays where it is put."""
    server, camera = viewer.server, viewer.views[0].camera
    at = SimpleNamespace(wxyz=camera.wxyz, position=camera.position, fov=camera.fov, aspect=1.5)
    at.image_width, at.image_height, at.on_update = 300, 200, lambda changed: None
    return Mock(viser.ClientHandle, gui=server.gui, scene=server.scene, camera=at, atomic=server.atomic)


@pytest.fixture
def page(viewer):
    """A page, and what it asked for."""
    asked = []
    client = a_client(viewer)
    page = Page(client, viewer.subjects, viewer.views, viewer.light, lambda *what: asked.append(what))
    page.client, page.asked = client, asked
    yield page
    page.leave()
    viewer.server.gui.reset()
    viewer.server.scene.reset()


def test_it_begins_at_the_first_test_view_with_both_runs(page, viewer, subjects):
    page.ask()
    look, limit = page.asked[-1]
    assert look.sources == tuple(subjects)
    assert (look.kind, look.layout, look.split) == ("lit", "slider", 0.5)
    assert astuple(look.light) == pytest.approx(astuple(viewer.light))
    assert look.shot == Viewpoint(look.shot.camera, (255, 255, 255))  # the ball's
    assert limit == (300, 10.0)  # as large as the window
    assert viewer.views[0].seen_from(look.shot.camera)


def test_controls_make_the_look(page, viewer):
    page.run.value, page.kind.value, page.stops.value = "CTM off", "depth", 10.0
    page.contrast.value, page.saturation.value = 1.5, 0.5
    page.beside.value, page.layout.value = PHOTOGRAPH, "side by side"
    page.background.value, page.cropped.value = (255, 0, 7), True
    page.sides[1].value = (0.5, -0.5)
    page.size.value, page.seconds.value = 10**9, 0.0
    page.ask()
    look, limit = page.asked[-1]
    assert look.sources == (viewer.subjects["CTM off"], viewer.views[0])
    assert (look.kind, look.layout, look.light) == ("depth", "side by side", Light(2.0**10, 1.5, 0.5))
    assert look.shot.background == (255, 0, 7)
    assert [corner[1] for corner in look.shot.crop] == [-0.5, 0.5]
    assert limit == (4096, 0.1)
    assert (page.legend.visible, page.split.visible) == (True, False)
    page.beside.value = NOTHING
    page.ask()
    assert len(page.asked[-1][0].sources) == 1


def test_a_camera_that_is_none_asks_for_nothing(page):
    before = len(page.asked)
    page.client.camera.fov = float("nan")
    page.ask()
    assert len(page.asked) == before


def test_a_client_that_left_asks_for_nothing(page, viewer):
    page.leave()
    viewer.server.gui.reset()  # its controls take no values any more
    before = len(page.asked)
    page.ask()
    assert len(page.asked) == before


def test_cameras_are_drawn_where_the_photographs_were_taken(page, viewer):
    for _ in range(2):
        page.show_cameras()
    assert len(page.drawn) == len(viewer.views)
    for mark, photograph in zip(page.drawn, viewer.views, strict=True):
        np.testing.assert_allclose(mark.position, photograph.camera.position)
        assert mark.fov == pytest.approx(photograph.camera.fov)


def test_a_path_holds_its_cameras_and_the_light(page, viewer):
    cameras = [view.camera for view in viewer.views[:3]]
    page.path.set(cameras)
    page.stops.value, page.contrast.value, page.saturation.value = -1.5, 1.25, 0.5
    found = page.path.key_frames()
    for c2w, fov, camera in zip(found.c2w, found.fov, cameras, strict=True):
        np.testing.assert_allclose(c2w, camera.c2w, atol=1e-6)
        assert fov == pytest.approx(camera.fov)
    assert (found.closed, found.lit) == (False, (-1.5, 1.25, 0.5))


def test_what_is_shown_is_told(page, viewer, subjects):
    page.ask()
    look = page.asked[-1][0]._replace(sources=(subjects[0], viewer.views[0]))
    page.show(look, torch.zeros(4, 6, 3), 0.5)
    assert page.status.value == "step 60, 6x4 in 0.50 s"
    assert not page.trouble.visible
    page.show(look._replace(sources=(subjects[0], viewer.views[-1])), torch.zeros(4, 6, 3), 0.5)
    assert page.status.value.endswith(f"{viewer.views[-1].label} as taken")


def test_light_begins_where_it_is_told_and_lifts_what_is_lifted(subjects, viewer):
    assert viewer.light == subjects[0].run.light
    with closing(Viewer(subjects[:1], at_free_port(light="3", contrast=1.5))) as another:
        assert another.light == Light(8.0, 1.5)
    look = Look(Viewpoint(viewer.views[0].camera), (subjects[0],), kind="lit")
    renderings = Renderings()
    more, less = (renderings.paint(look._replace(light=Light(f)), 8, lambda: None)[0] for f in (16.0, 2.0))
    plain, same = (renderings.paint(look._replace(kind="rgb", light=Light(f)), 8, lambda: None)[0] for f in (16.0, 2.0))
    assert (more >= less).all()
    assert more.mean() > less.mean()
    assert torch.equal(plain, same)
    assert torch.allclose(less, Light(2.0).apply(plain), atol=1e-6)


def test_the_page_is_served_by_the_address_that_is_told(viewer):
    with urllib.request.urlopen(viewer.address, timeout=20) as answer:
        assert "script-src 'self'" in answer.headers["Content-Security-Policy"]
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(
            urllib.request.Request(viewer.address, headers={"Host": "elsewhere.example"}), timeout=20
        )


def test_runs_of_one_kind_are_named_by_their_folders(runs, subjects):
    assert names(subjects) == ["CTM quick", "CTM off"]
    assert names(subjects[:1] * 2) == [str(runs["on"])] * 2


def test_the_server_ends_with_the_painting(runs, monkeypatch):
    monkeypatch.setattr(Viewer, "work", Mock(side_effect=torch.OutOfMemoryError))
    settings = at_free_port()
    with pytest.raises(torch.OutOfMemoryError):
        view(runs["on"], settings=settings)
    check_free(settings.port)


@pytest.mark.parametrize(
    ("origin", "host", "answered"),
    [
        (None, HERE, True),
        (None, "LOCALHOST", True),
        ("http://127.0.0.1:8080", HERE, True),
        # Other sites.
        ("http://elsewhere.example", HERE, False),
        ("http://127.0.0.1:9090", HERE, False),
        ("null", HERE, False),
        ("http://127.0.0.1:8080@elsewhere.example", HERE, False),
        # DNS rebinding: to the browser a page of that name comes from this server.
        ("http://elsewhere.example:8080", "elsewhere.example:8080", False),
        (None, "localhost.example", False),
        (None, "10.0.0.7", False),
        (None, "", False),
    ],
)
def test_pages_of_other_sites(origin, host, answered):
    headers = {"Host": host} | ({"Origin": origin} if origin else {})
    assert admitted(headers) == answered
