"""A scene of Gaussians as a page to walk through, in viser's own viewer."""

from __future__ import annotations

import io
import warnings
from contextlib import redirect_stdout
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

FIRST_DISTANCE = 5.0
"""Distance from the first camera to what it looks at, in the viewer's units; they keep covariances within 16 bits."""
MAX_SIGMA = 250.0
"""Largest standard deviation in the viewer's units: the square of 256 does not fit in 16 bits."""
FILE_SCRIPT = """<head><script>
// Pages that are opened as files may not start module workers from blobs: without one, viser takes a data address.
const made = URL.createObjectURL;
URL.createObjectURL = (of) => of.type?.startsWith("text/javascript") ? "" : made.call(URL, of);
// Half precision, which phones and WebKit may take for mediump, is too little for covariances.
const compiled = WebGL2RenderingContext.prototype, source = compiled.shaderSource;
compiled.shaderSource = function (shader, text) {
  source.call(this, shader, text.replaceAll("precision mediump float", "precision highp float"));
};
</script><style>:has(> [aria-label$="scene tree"]) { display: none !important }</style>"""
"""Script added to viser's page: lets a page opened as a file start viser's sorting worker; renders in 32-bit floats."""


class Spots(NamedTuple):
    """Gaussians whose colours do not depend on the view direction.

    Attributes:
        centres: ``[N, 3]``.
        axes: ``[N, 3, 3]``, principal axes as columns, each of the length of its standard deviation.
        colors: ``[N, 3]`` sRGB in [0, 1].
        opacities: ``[N, 1]`` in [0, 1].
    """

    centres: Float[np.ndarray, "n 3"]
    axes: Float[np.ndarray, "n 3 3"]
    colors: Float[np.ndarray, "n 3"]
    opacities: Float[np.ndarray, "n 1"]


class Start(NamedTuple):
    """First camera of a walk: position, point looked at, up direction, and vertical field of view in radians."""

    eye: Float[np.ndarray, " 3"]
    ahead: Float[np.ndarray, " 3"]
    up: Float[np.ndarray, " 3"]
    fov: float


def walk(spots: Spots, start: Start) -> str:
    """Make a page of HTML that needs nothing else: viser's viewer, with the scene in it.

    The server that viser needs to make the page ends before it has the scene, so that nobody can reach the scene.
    """
    import viser

    scale = FIRST_DISTANCE / np.linalg.norm(start.ahead - start.eye)
    axes = scale * spots.axes
    axes = axes * np.minimum(1, MAX_SIGMA / np.linalg.norm(axes, axis=1, keepdims=True).clip(1e-12))
    with redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that nobody listens
        server = viser.ViserServer("127.0.0.1", 0, verbose=False)
        server.stop()
        server.scene.set_up_direction(start.up)
        server.scene.add_gaussian_splats(
            "/scene", scale * spots.centres, axes @ axes.swapaxes(1, 2), spots.colors, spots.opacities
        )
        camera = server.initial_camera
        camera.position, camera.look_at = scale * start.eye, scale * start.ahead
        camera.up, camera.fov = start.up, start.fov
        return server.scene.as_html(dark_mode=True).replace("<head>", FILE_SCRIPT, 1)
