"""Films of a run along a camera path, as GIF, WebP or H.264."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ctm_plugin.backbones.posed import PosedBackbone
from ctm_plugin.color.light import AS_IS, Light, chosen_light
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.data.readers.camera_path import read_key_frames
from ctm_plugin.data.rig import SURROUND_DEGREES, turn
from ctm_plugin.errors import ConfigError
from ctm_plugin.export.settings import VideoConfig, can_mp4
from ctm_plugin.files import replacing
from ctm_plugin.runs.load import LoadedRun, load_posed
from ctm_plugin.scene.camera_paths import KeyFrames, capture, orbit, spiral
from ctm_plugin.scene.views import Scene, Views
from ctm_plugin.settings.setting import Number
from ctm_plugin.show.bars import tracked
from ctm_plugin.show.console import print_next
from ctm_plugin.show.pictures import beside

BT709_TAGS = ":".join(f"{key}=bt709" for key in ("colorspace", "color_primaries", "color_trc"))
FFMPEG_BT709 = ["-vf", f"scale=out_color_matrix=bt709:out_range=tv,setparams={BT709_TAGS}", "-movflags", "+faststart"]
"""ffmpeg's arguments: BT.709's colours, tagged as such, and the index at the file's beginning."""

FILM_WIDTH = 1280
"""Largest width in pixels to which films are enlarged, by at most the backbone's ``max_scale``; wider views stay."""


def render(run: Path, settings: VideoConfig) -> None:
    """Render a film of a run, lit where the scene is dark.

    Frames have the test views' size, of splats up to twice that and 1280 pixels wide, through a pinhole.
    ``path=FILE.json`` films a camera path that ``ctm view`` saved: a spline through all key frames, with as many frames
    from each key frame to the next, in the light that they were saved in unless ``light`` says otherwise.

    Raises:
        CTMError: the folder is no run, its checkpoint cannot be used, it is not of a scene with cameras, or a film is
            there already.
    """
    out = film(run, load_posed(run, settings.dataset.root, pictures=False), settings)
    print(f"written to {out}")
    print_next("view", run)


def film(run: Path, posed: LoadedRun, settings: VideoConfig) -> Path:
    """Write a film, see :func:`render`.

    Returns:
        The film's file.
    """
    module, scene = posed.module, posed.module.scene
    path = settings.path or ("orbit" if turn(scene.train.c2w.cpu().double().numpy()) >= SURROUND_DEGREES else "capture")
    ending = ".mp4" if can_mp4() else ".gif"
    out = Path(settings.out) if settings.out else run / "video" / f"{Path(path).stem}{ending}"
    keys = read_key_frames(Path(path)) if path.endswith(".json") else None
    lit = keys.lit if keys and settings.light is None else None
    light = chosen_light(settings, Light(2.0 ** lit[0], *lit[1:]) if lit else posed.light)
    if lit:
        seen = f"light={math.log2(light.gain):g} contrast={light.contrast:g} saturation={light.saturation:g}"
        print(f"lit as {path} was saved: {seen}; light=auto finds it anew")
    _, width = scene.test.size(scene.test.largest)
    scale = max(min(FILM_WIDTH / width, module.max_scale), 1.0)
    if scale > 1:
        print(f"film: {round(scale * width)} pixels wide, {scale:.2g} times the training's pictures")
    cameras = film_cameras(scene, keys or path, settings.frames, scale)
    if not settings.overwrite:
        check_new([out])
    out.parent.mkdir(parents=True, exist_ok=True)
    kinds = ("lit", *(("rgb",) if light != AS_IS else ()), "depth", "latent") if settings.what == "all" else ("lit",)
    with fast_products(module.device):
        views = rendered(module, cameras)
        shown = [
            frame(*(posed.picture(view, kind, light) for kind in kinds))
            for view in tracked(views, "film", len(cameras))
        ]
    write_video(out, shown, settings.fps)
    return out


def check_new(files: Iterable[Path]) -> None:
    """Refuse to overwrite existing files.

    Raises:
        ConfigError: a file exists.
    """
    for file in files:
        if file.exists():
            raise ConfigError("out", str(file), "a file that is not there yet, or overwrite=true")


def film_cameras(scene: Scene, path: str | KeyFrames, frames: int, scale: float = 1.0) -> list[Views]:
    """The cameras of a path, a view each, of ``scale`` times the largest test view's size: with its lens, or as a
    pinhole of the key frames' field of view.
    """
    test, own = scene.test, scene.test.largest
    lens = test.intrinsics[own : own + 1]
    distortion = None if test.distortion is None else test.distortion[own : own + 1]
    high, wide = test.size(own)
    if isinstance(path, KeyFrames):
        c2w, fov = path.path(frames)
        focal, middle = high / (2 * (fov / 2).tan()), torch.tensor([wide / 2, high / 2])
        lens, distortion = torch.cat([focal[:, None].expand(-1, 2), middle.expand(len(fov), 2)], dim=1), None
    elif path == "test":
        c2w = test.c2w
    else:
        paths = {"orbit": orbit, "capture": capture}
        c2w = paths[path](scene.train, frames) if path in paths else spiral(scene.train, scene.near, scene.far, frames)
    lenses = lens.expand(len(c2w), 4).split(1)
    blank = test.images.new_zeros(1, round(scale * high), round(scale * wide), test.images.shape[-1])
    return [
        Views(blank, pose, scale * lens, ("frame",), distortion=distortion)
        for pose, lens in zip(c2w.split(1), lenses, strict=True)
    ]


def rendered(module: PosedBackbone, cameras: Iterable[Views]) -> Iterator[dict[str, Tensor]]:
    """Render cameras in turn by :meth:`~PosedBackbone.render_view`, one ray a pixel; results on the CPU."""
    for views in cameras:
        with torch.no_grad():
            yield {name: value.float().cpu() for name, value in module.render_view(views, 0, rays=1).items()}


def frame(*pictures: Float[Tensor, "h w 3"]) -> np.ndarray:
    """A film's frame, bytes ``[H, W, 3]``: pictures side by side, cut to even sides, as video codecs need."""
    joined = (beside(*pictures).clamp(0, 1) * 255).round().byte().numpy()
    return np.pad(joined, ((0, len(joined) % 2), (0, joined.shape[1] % 2), (0, 0)), mode="edge")


def write_video(path: Path, frames: Sequence[np.ndarray], fps: Number) -> None:
    """Write frames ``[F, H, W, 3]`` as a video file, see :func:`encoded`."""
    with replacing(path) as beside_path:
        beside_path.write_bytes(encoded(np.stack(frames), path.suffix, fps))


def encoded(frames: UInt8[np.ndarray, "f h w 3"], ending: str, fps: Number) -> bytes:
    """Encode a film's frames as GIF, WebP or H.264, by the file name's ``ending``."""
    mp4 = {"plugin": "FFMPEG", "fps": fps, "macro_block_size": 2, "output_params": FFMPEG_BT709}
    return iio.imwrite(
        "<bytes>", frames, extension=ending, **(mp4 if ending == ".mp4" else {"duration": 1000 / fps, "loop": 0})
    )
