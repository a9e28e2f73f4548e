"""The viewer in a real browser, and its web server."""

import socket
import threading
import time
from collections.abc import Iterator
from urllib.parse import urlsplit
from urllib.request import urlopen

import numpy as np
import pytest
from browser import opened, seen, until
from PIL import Image
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from ctm_plugin.data.readers.camera_path import read_key_frames
from ctm_plugin.view.server import Viewer
from ctm_plugin.view.settings import ViewConfig
from ctm_plugin.view.sources import Subject

CANVAS = {"x": 0, "y": 0, "width": 300, "height": 400}
"""The part of the page that the panel leaves free."""
CHOICES = ("run", "picture", "next to it", "compare by", "view")


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return listening.getsockname()[1]


@pytest.fixture(scope="module")
def viewer(runs) -> Iterator[Viewer]:
    viewer = Viewer([Subject(runs["on"]), Subject(runs["off"])], ViewConfig(port=free_port()))
    thread = threading.Thread(target=viewer.work)
    thread.start()
    yield viewer
    viewer.close()
    thread.join(30)


@pytest.fixture
def page(viewer):
    """The viewer's page."""
    size = {"width": 640, "height": 400}
    with opened(f"http://127.0.0.1:{viewer.server.get_port()}", foreign, viewport=size) as page:
        yield page


def foreign(url: str) -> bool:
    return urlsplit(url).scheme != "blob" and urlsplit(url).hostname != "127.0.0.1"


def finest(viewer: Viewer) -> bool:
    """Whether there is nothing finer to paint: how fine that is depends on the machine's speed."""
    tasks = viewer.painter._tasks.values()
    return bool(tasks) and all(task.done for task in tasks)


def canvas(page) -> np.ndarray:
    return seen(page, CANVAS)


@pytest.mark.slow
def test_a_picture_comes_and_follows_camera_and_controls(page, viewer):
    def changed(since: np.ndarray) -> bool:
        return np.abs(canvas(page) - since).mean() > 2

    def choose(control: str, choice: str) -> None:
        page.get_by_role("combobox").nth(CHOICES.index(control)).click()
        page.get_by_role("option", name=choice, exact=True).click()

    status, stops = page.locator("input[disabled]").first, page.locator("input[inputmode=decimal]").first
    until(lambda: canvas(page).std() > 10, "a picture that is not blank")
    until(lambda: finest(viewer), "the finest picture")

    before = canvas(page)
    stops.fill("0.5")
    stops.press("Enter")
    until(lambda: changed(before), "another light")

    before = canvas(page)
    page.mouse.move(200, 200)
    page.mouse.down(button="right")
    page.mouse.move(120, 120, steps=5)
    page.mouse.up(button="right")
    until(lambda: changed(before), "another picture when the camera is dragged")

    before = canvas(page)
    choose("picture", "depth")
    until(lambda: changed(before), "depth")
    before = canvas(page)
    choose("next to it", "photograph")
    until(lambda: changed(before) and "as taken" in status.input_value(), "the photograph beside it")
    before = canvas(page)
    page.get_by_role("button", name="next view").click()
    until(lambda: changed(before) and "as taken" not in status.input_value(), "the next test view and its photograph")
    assert page.told == []  # scripts of other hosts were not loaded


@pytest.mark.slow
def test_files_come_down(page, viewer, tmp_path):
    def downloaded(button: str):
        with page.expect_download(timeout=60_000) as download:
            page.get_by_role("button", name=button).click()
        download.value.save_as(tmp_path / download.value.suggested_filename)
        return tmp_path / download.value.suggested_filename

    until(lambda: finest(viewer), "the finest picture")
    time.sleep(0.5)  # it is on its way to the page
    width, height = Image.open(downloaded("save the picture")).size
    assert f"{width}x{height} in" in page.locator("input[disabled]").first.input_value()
    page.get_by_text("camera path").click()
    for _ in range(2):
        page.get_by_role("button", name="add key frame").click()
        page.get_by_role("button", name="next view").click()
        time.sleep(0.5)  # the camera goes there and back through the server
    keys = read_key_frames(downloaded("save the path"))
    assert len(keys.c2w) == 2
    assert not np.allclose(keys.c2w[0], keys.c2w[1])


def test_pages_load_nothing_from_elsewhere_and_stay_here(viewer):
    with urlopen(f"http://127.0.0.1:{viewer.server.get_port()}/", timeout=20) as answer:
        assert answer.headers["Content-Security-Policy"].startswith("default-src 'self'")
    assert viewer.server.request_share_url() is None


def test_pages_of_others_cannot_connect(viewer):
    port = viewer.server.get_port()
    with connect(f"ws://127.0.0.1:{port}", origin=f"http://127.0.0.1:{port}"):
        pass
    with pytest.raises(InvalidStatus, match="403"):
        connect(f"ws://127.0.0.1:{port}", origin="http://elsewhere.example")
