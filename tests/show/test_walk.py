"""Scenes to walk through: what is in the page, and what a browser shows of it."""

import base64
import re
import threading

import numpy as np
import pytest
from browser import opened, seen, until

from ctm_plugin.show.walk import Spots, Start, walk

START = Start(np.array([5.0, 0, 0]), np.zeros(3), np.array([0, 0, 1.0]), 0.6)
PER_SPOT = 8
"""Numbers of 32 bits: a place and a free one, six of 16 bits of the covariance, a colour."""
COMPILED = """() => {
    const gl = document.createElement("canvas").getContext("webgl2"), shader = gl.createShader(gl.VERTEX_SHADER);
    gl.shaderSource(shader, "precision mediump float;");
    return gl.getShaderSource(shader);
}"""
"""Script that gives a vertex shader's text as the page compiles it."""


def sheets(*depths: float, size: float = 0.1, count: int = 500) -> Spots:
    """Red, then blue spots in planes across the way, as far along x."""
    centres = np.random.default_rng(0).normal(size=(len(depths) * count, 3)) * 0.5
    centres[:, 0] = np.repeat(depths, count)
    colors = np.repeat(np.array([[1.0, 0, 0], [0, 0, 1]])[: len(depths)], count, axis=0)
    axes = np.broadcast_to(size * np.eye(3), (len(centres), 3, 3))
    return Spots(centres, axes, colors, np.ones((len(centres), 1)))


def test_spots_are_in_the_page_and_the_server_has_ended(capsys):
    zstandard = pytest.importorskip("zstandard")
    before = threading.active_count()
    page = walk(sheets(1.0, size=1e4, count=7), START)
    assert capsys.readouterr().out == ""
    assert threading.active_count() == before
    (data,) = re.findall(r'__VISER_EMBED_DATA__="([^"]*)"', page)
    content = zstandard.ZstdDecompressor().decompressobj().decompress(base64.b64decode(data)[8:])
    begin = 8 + int.from_bytes(content[:8], "little")
    rows = np.frombuffer(content[begin + -begin % 8 :][: 4 * 7 * PER_SPOT], np.uint32).reshape(7, PER_SPOT)
    np.testing.assert_allclose(rows[:, 0].view(np.float32), 1.0)
    covariances = rows[:, 4:7].copy().view(np.float16).astype(float)
    np.testing.assert_allclose(covariances, [[62500, 0, 0, 62500, 0, 62500]] * 7, rtol=1e-2)  # not infinite


@pytest.mark.slow
def test_what_is_near_hides_what_is_far_in_a_page_that_is_opened_as_a_file(tmp_path):
    """Red is nearer but comes first in the file: viser's page alone sorts nothing there."""
    (tmp_path / "a.html").write_text(walk(sheets(1.0, -1.0), START), encoding="utf-8")
    size = {"width": 640, "height": 400}
    address = (tmp_path / "a.html").as_uri()
    with opened(address, lambda url: not url.startswith(("file:", "data:", "blob:")), viewport=size) as page:
        middle = {"x": 300, "y": 200, "width": 40, "height": 40}
        until(lambda: (seen(page, middle).mean((0, 1)) @ [1, 0, -1]) > 100, "red", seconds=40)
        assert page.evaluate(COMPILED) == "precision highp float;"  # else covariances may have 16 bits
        assert page.told == []
