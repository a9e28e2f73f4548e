"""A run as one HTML page without other files, for any browser."""

from __future__ import annotations

import base64
import io
import math
import os
import re
import shlex
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v3 as iio
import numpy as np
import torch
from jinja2 import Environment, FileSystemLoader
from PIL import Image

from ctm_plugin import __version__
from ctm_plugin.backbones.posed import PosedBackbone
from ctm_plugin.backbones.splat import Splat
from ctm_plugin.color.light import AS_IS, Light
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.data.readers.images import to_8_bits
from ctm_plugin.export.splats import MAX_CAMERAS, cameras_in_files, lit_view, plain
from ctm_plugin.export.video import encoded
from ctm_plugin.files import write_text
from ctm_plugin.runs.evaluate import LITTLE_DETAIL
from ctm_plugin.runs.load import LoadedRun
from ctm_plugin.runs.rundir import METRICS, film_of, read_json
from ctm_plugin.scene.poses import IDENTITY
from ctm_plugin.show.bars import tracked
from ctm_plugin.show.walk import Spots, Start, walk
from ctm_plugin.splats.gaussians import Camera, Gaussians, rotations
from ctm_plugin.splats.seen import as_wide_as_pixels, pixels_made, times_seen
from ctm_plugin.splats.start import SH_C0

LIMIT = 10_000_000
"""Most bytes of a page, so that it can be sent by mail."""
MAX_FILM_BYTES = MAX_PICTURE_BYTES = 2_500_000
"""Most bytes of a page's film, and of its pictures, before base64, which makes four bytes of three."""
MAX_VIEWS, MAX_WIDTH, QUALITY = 12, 1280, 80
"""Most test views, their largest width in pixels, and WebP's quality."""
SHRINK = 0.8
"""Factor on pictures' widths, repeated until they fit into their bytes."""
COLOR_STEPS, COLOR_WIDTH = 100, 400
"""Steps of the training of colours, and the width in pixels of its pictures: 42.4 dB from a run's pictures, 44.9 after
six times as many steps (LOM's bike, 370 pixels wide)."""
MIN_CONTRIBUTION = 0.01
"""Least number of pixels of a mean picture that a Gaussian makes; the cameras hardly saw others."""
GAUSSIAN_BYTES = 40
"""Bytes of a Gaussian in the page, and of the viewer without any."""
VIEWER_BYTES = 1_100_000
WITHOUT_VIEWER = "To walk through the scene, the page needs viser when it is made: pip install -e '.[view]'"


class PageView(NamedTuple):
    """A test view: width and height; data URLs of it lit, and of the photograph as it was and lit, if there is one."""

    name: str
    size: tuple[int, int]
    lit: str
    taken: str | None
    photo: str | None


def write_page(path: Path, run: Path, posed: LoadedRun, light: Light) -> None:
    """Write a run as a page that opens from a file, loads nothing, and has less than ten million bytes.

    It shows the run's newest film, test views next to their photographs, and of splats the scene to walk through.
    It prints which parts had to be made smaller or left out.
    """
    module, film = posed.module, film_of(run)
    scores = read_json(run / METRICS) if (run / METRICS).exists() else {}
    with fast_products(module.device):
        shots, size = shots_of(module, light)
        parts = {"shots": shots, "size": size, "film": film and film_url(film), "walk": None, "why": ""}
        room = LIMIT - len(page(run, posed, light, scores, parts).encode())
        if not isinstance(module, Splat):
            name = posed.config["backbone"]["name"]
            parts["why"] = f"This scene is of {name}, not of splats, so there is none to walk through."
        elif find_spec("viser") is None:
            parts["why"] = WITHOUT_VIEWER
            print(WITHOUT_VIEWER)
        else:
            parts["walk"] = walk_of(module, light, room)
    if film is None:
        print(f"the page has no film, as the run has none: ctm render {shlex.quote(str(run))}")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, page(run, posed, light, scores, parts))


def page(run: Path, posed: LoadedRun, light: Light, scores: Mapping[str, Any], parts: Mapping[str, Any]) -> str:
    """A run's page as HTML that needs no other file."""
    return html(
        Path(__file__).with_name("page.html.jinja"),
        name=re.sub(r"[_-]+", " ", posed.module.scene.name).strip() or posed.module.scene.name,
        dark=light != AS_IS,
        facts=facts(posed, light, scores),
        run=shlex.quote(os.path.relpath(run)),
        **parts,
    )


def html(template: Path, **values: Any) -> str:
    """Fill a template, which may extend ``base.html.jinja``, with values, text escaped."""
    environment = Environment(loader=FileSystemLoader([template.parent, Path(__file__).parent]), autoescape=True)
    environment.policies["json.dumps_kwargs"] = {"ensure_ascii": False}
    return environment.get_template(template.name).render(version=__version__, **values)


def facts(posed: LoadedRun, light: Light, scores: Mapping[str, Any]) -> list[str]:
    """Sentences on a run's settings and scores, for its page."""
    scene, config = posed.module.scene, posed.config
    known, kept = len(scene.train), len(scene.test)
    sentences = [f"The program used {known} photographs. {kept} more were kept aside, to test it."]
    if light != AS_IS:
        why = ", set automatically" if light == posed.light else ""
        sentences.append(f"It is shown {light.gain:.3g} times as bright as it was{why}.")
        sentences.append("Where the photographs are almost black, they hardly tell colours: some may be wrong.")
    detail = scores.get("detail")
    if detail is not None:
        wrong = "" if detail >= LITTLE_DETAIL else ": something went wrong"
        sentences.append(f"Its views show {detail:.0%} of the smallest detail in the photographs{wrong}.")
    minutes = posed.spent["seconds"] / 60
    spots = f"{len(posed.module.gaussians.means):,} spots of colour" if isinstance(posed.module, Splat) else ""
    how = f"It took {minutes:.0f} minutes" if minutes >= 1.5 else f"It took {posed.spent['seconds']:.0f} seconds"
    what = f", for {spots}" if spots else f", by {config['backbone']['name']}"
    sentences.append(f"{how}{what}, on pictures {scene.train.width} pixels wide.")
    return sentences


def shots_of(module: PosedBackbone, light: Light) -> tuple[list[PageView], tuple[int, int]]:
    """Test views, evenly chosen, rendered and photographed, as large as the page has room, and the film's size."""
    views = module.scene.test
    chosen = np.unique(np.linspace(0, len(views) - 1, min(MAX_VIEWS, len(views))).round().astype(int)).tolist()
    if len(chosen) < len(views):
        print(f"the page shows {len(chosen)} of {len(views)} test views")
    pictures = []
    for index in tracked(chosen, "page"):
        photograph = module.target(index)
        kinds = [lit_view(module, views, index, light).cpu()]
        kinds += [] if photograph is None else [photograph, light.apply(photograph)]
        pictures.append([Image.fromarray(to_8_bits(views.own(index, each)).numpy()) for each in kinds])
    width = min(MAX_WIDTH, views.width)
    while True:
        files = [[webp(each, width) for each in kinds] for kinds in pictures]
        if sum(len(each) for kinds in files for each in kinds) <= MAX_PICTURE_BYTES:
            break
        width = int(SHRINK * width)
    if width < views.width:
        print(f"the page's pictures are {width} pixels wide, of {views.width}: it is to have less than {LIMIT:,} bytes")
    shots = [
        PageView(
            views.names[index],
            views.size(index)[::-1],
            *[url("image/webp", each) for each in kinds],
            *[None] * (3 - len(kinds)),
        )
        for index, kinds in zip(chosen, files, strict=True)
    ]
    return shots, views.size(views.largest)[::-1]


def webp(picture: Image.Image, width: int) -> bytes:
    """Encode a picture as WebP, at most ``width`` pixels wide."""
    small = picture.copy()
    small.thumbnail((width, picture.height))
    out = io.BytesIO()
    small.save(out, "WEBP", quality=QUALITY)
    return out.getvalue()


def picture_url(picture: Image.Image) -> str:
    """Encode a picture as a data URL, at its own size."""
    return url("image/webp", webp(picture, picture.width))


def url(kind: str, content: bytes) -> str:
    """Encode a file's content as a data URL of a media type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def film_url(film: Path) -> str:
    """Encode a film as a data URL, a GIF as WebP, shrunk to at most ``MAX_FILM_BYTES``."""
    content, ending = film.read_bytes(), ".mp4" if film.suffix == ".mp4" else ".webp"
    if film.suffix != ending or len(content) > MAX_FILM_BYTES:
        frames = iio.imread(film, index=None if film.suffix == ".mp4" else ...)
        about = iio.immeta(film)
        fps = about["fps"] if "fps" in about else 1000 / about["duration"]
        width = frames.shape[2]
        content = encoded(frames, ending, fps)
        while len(content) > MAX_FILM_BYTES:
            width = int(SHRINK * width) // 2 * 2  # even sides, as video wants them
            small = [Image.fromarray(frame) for frame in frames]
            size = (width, round(width * frames.shape[1] / frames.shape[2] / 2) * 2)
            content = encoded(np.stack([np.asarray(each.resize(size)) for each in small]), ending, fps)
        if width < frames.shape[2]:
            print(f"the page's film is {width} pixels wide, of {frames.shape[2]} in {film}")
    return url("video/mp4" if ending == ".mp4" else "image/webp", content)


def walk_of(module: Splat, light: Light, room: int) -> str:
    """HTML of a viewer with the Gaussians that two or more training cameras see, the least visible left out for room.

    Args:
        module: the backbone with trained weights.
        light: light of the Gaussians' colours.
        room: bytes that the viewer may have in the page.
    """
    scene, every = module.scene, math.ceil(module.scene.train.width / COLOR_WIDTH)
    gaussians, cameras = plain(module, light, COLOR_STEPS, False, every), cameras_in_files(module, scene.train, every)
    made = pixels_made(gaussians, cameras[:: math.ceil(len(cameras) / MAX_CAMERAS)]) * every**2
    made = made * (times_seen(gaussians.means, cameras) >= 2)
    order, seen = made.argsort(descending=True), int((made >= MIN_CONTRIBUTION).sum())
    count = max(min(seen, (room - VIEWER_BYTES) // GAUSSIAN_BYTES), 1)
    if count < seen:
        print(f"the page's walk has {count:,} of {seen:,} spots: it is to have less than {LIMIT:,} bytes")
    gaussians = as_wide_as_pixels(gaussians, cameras_in_files(module, scene.train))
    return walk(spots_of(Gaussians(*(table[order[:count]] for table in gaussians))), start_of(module, cameras))


def spots_of(gaussians: Gaussians) -> Spots:
    """The viewer's spots out of Gaussians of three channels, one colour each."""
    axes = rotations(gaussians.quats) * gaussians.scales.exp()[:, None]
    colors = (0.5 + SH_C0 * gaussians.sh0).clamp(0, 1)
    tables = gaussians.means, axes, colors, gaussians.opacities.sigmoid()
    return Spots(*(each.detach().double().cpu().numpy() for each in tables))


def start_of(module: Splat, cameras: Sequence[Camera]) -> Start:
    """Start of a walk: the training camera nearest to the mean of all, in the files' world, facing as it did.

    The up direction is that of the mean photograph.
    """
    views, back = module.scene.train, (module.scene.world or IDENTITY).inverse()
    centres = torch.stack([camera.centre for camera in cameras])
    middle = int((centres - centres.mean(0)).norm(dim=1).argmin())
    depth = module.render_view(views, middle, math.ceil(views.width / COLOR_WIDTH))["depth"]
    high, wide = (side // 3 for side in depth.shape)
    away = back.scale * depth[high : 2 * high, wide : 2 * wide].median()
    camera, up = cameras[middle], -torch.stack([each.turn[1] for each in cameras]).mean(0)
    fov = 2 * math.atan(camera.height / (2 * float(camera.lens[1])))
    places = camera.centre, camera.centre + away * camera.turn[2], up / up.norm()
    return Start(*(each.detach().double().cpu().numpy() for each in places), fov)
