"""What a run found, for other programs: splats, points, a mesh, depth, cameras; in the data set's own units."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import tifffile
import torch
from torch import Tensor

from ctm_plugin.backbones.posed import PosedBackbone
from ctm_plugin.backbones.splat import Splat
from ctm_plugin.color.light import Light, chosen_light
from ctm_plugin.data.load import NEAREST
from ctm_plugin.errors import ConfigError
from ctm_plugin.files import replacing, write_json
from ctm_plugin.metrics.precision import full_float32
from ctm_plugin.runs.load import load_posed
from ctm_plugin.runs.settings import ExportConfig
from ctm_plugin.runs.splats import likeness, plain, read_splats, write_splats
from ctm_plugin.runs.surface import Surface, cloud, mesh
from ctm_plugin.runs.video import check_new
from ctm_plugin.scene.poses import STILL
from ctm_plugin.scene.views import Scene, Views
from ctm_plugin.show.ply import write_ply
from ctm_plugin.splats.gaussians import Gaussians

CODES = 65535
"""Of a depth picture of 16 bits; 0 stands for nothing."""


def export(run: Path, settings: ExportConfig) -> None:
    """Write what a run found for other programs: splats, points, a mesh, depth or cameras, in the files' units.

    - ``splats``: the Gaussians as a PLY of 3DGS, in lit RGB. The verb says how close its pictures are to the run's.
    - ``points``: where the training views' rays end, with colours and normals, as a binary PLY.
    - ``mesh``: marching cubes, with colours as seen head-on, of what the training views see up to far; of unbounded
      scenes, of the ball of cameras.
    - ``depth``: distances along the rays of the test views.
    - ``cameras``: ``transforms.json`` as nerfstudio has it, with the pictures that the run was trained on.

    Raises:
        CTMError: the folder is no run, its checkpoint cannot be used, it is not of a scene with cameras, there are no
            splats, there is no surface, or files are there already.
    """
    posed = load_posed(run, settings.dataset.root, pictures=False)
    module, out = posed.module, Path(settings.out) if settings.out else run / "export"
    light, splats = chosen_light(settings, posed.light), isinstance(module, Splat)
    what = settings.what or ("splats" if splats else "points")
    if what == "splats" and not splats:
        raise ConfigError("what", what, f"points or mesh: a {type(module).__name__} has no Gaussians")
    place = out / (what if what in ("depth", "cameras") else f"{what}.ply")
    if not settings.overwrite:
        there = place.rglob(f"*.{settings.depth}" if what == "depth" else "*") if place.is_dir() else [place]
        check_new(sorted(path for path in there if path.is_file()))
    if what == "splats":
        write_lit(place, module, light)
    elif what == "depth":
        write_depths(place, module, settings.depth)
    elif what == "cameras":
        write_cameras(place, module.scene)
    else:
        surface, fine = (cloud, settings.points) if what == "points" else (mesh, settings.cells)
        write_surface(place, surface(module, fine, settings.opaque), module.scene, light)
    print(f"written to {place}")


def write_lit(path: Path, module: Splat, light: Light) -> None:
    """Write a run's Gaussians, their colours lit, and tell how close the file is to the run."""
    gaussians = plain(module, light)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_splats(path, gaussians)
    back = Gaussians(*(table.to(module.device) for table in read_splats(path)))
    print(f"the test views from this file are {likeness(module, back, light):.1f} dB (PSNR) from the run's pictures")


def write_surface(path: Path, surface: Surface, scene: Scene, light: Light) -> None:
    """Write a surface in the files' world, its colours lit."""
    back = (scene.world or STILL).inverse()
    points, normals = back.moved(surface.points.double().numpy()), surface.normals.double().numpy() @ back.turn.T
    colors = light.apply(surface.colors)
    levels = (colors * 255).round().to(torch.uint8).numpy()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(path, points, normals, levels, None if surface.faces is None else surface.faces.numpy())


def write_depths(folder: Path, module: PosedBackbone, kind: str) -> None:
    """Write distances along the rays of the test views: ``.npy``, or ``.png`` with the units a step, ``scale.json``."""
    scene, views = module.scene, module.scene.test
    size = (scene.world or STILL).scale
    scale = scene.far / size / CODES
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(views.names):
        with full_float32(module.device):
            distances = module.render_view(views, index, rays=1)["depth"].cpu().numpy() / size
        with replacing(folder / f"{name}.{kind}") as beside, beside.open("wb") as file:
            if kind == "npy":
                np.save(file, distances.astype(np.float32))
            else:
                iio.imwrite(file, (distances / scale).round().clip(1, CODES).astype(np.uint16), extension=".png")
    if kind == "png":
        told = {"depth_scale": scale, "what": "distance along the ray, in units of the poses"}
        write_json(folder / "scale.json", told)


def write_cameras(folder: Path, scene: Scene) -> None:
    """Write ``transforms.json`` as nerfstudio has it, with the pictures as they were trained on and masks."""
    size = (scene.world or STILL).scale
    near = scene.near if scene.world is None else 1 / (NEAREST * size)  # what becomes NDC's near plane
    frames, lists = [], {}
    for split, views in (("train", scene.train), ("test", scene.test)):
        for kind in ("images", "masks")[: 1 if views.mask is None else 2]:
            (folder / kind / split).mkdir(parents=True, exist_ok=True)
        poses = (scene.world or STILL).inverse().of_poses(views.c2w.double().numpy())
        added = [frame_of(folder, split, views, index, pose.tolist()) for index, pose in enumerate(poses)]
        frames += added
        lists[f"{split}_filenames"] = [each["file_path"] for each in added]
    lists["val_filenames"] = lists["test_filenames"]  # nerfstudio wants all lists or none, and these while it trains
    sizes = {"w": scene.train.width, "h": scene.train.height}
    content = {"camera_model": "OPENCV", **sizes, "near": near, "far": scene.far / size, **lists, "frames": frames}
    write_json(folder / "transforms.json", content)


def frame_of(folder: Path, split: str, views: Views, index: int, pose: list[list[float]]) -> dict[str, Any]:
    """Write a view's picture, where there is one, and its mask; give its entry among the frames."""
    image, name = views.images[index], views.names[index]
    file = f"images/{split}/{name}.{'png' if image.dtype == torch.uint8 else 'tif'}"
    if views.pictured is None or views.pictured[index]:
        write_pixels(folder / file, image)
    numbers = dict(zip(("fl_x", "fl_y", "cx", "cy"), views.intrinsics[index].tolist(), strict=True))
    if views.distortion is not None:
        numbers |= dict(zip(("k1", "k2", "p1", "p2", "k3"), views.distortion[index].tolist(), strict=True))
    frame = {"file_path": file, **numbers, "transform_matrix": [*pose, [0.0, 0.0, 0.0, 1.0]]}
    if views.mask is not None:
        frame["mask_path"] = f"masks/{split}/{name}.png"
        write_pixels(folder / frame["mask_path"], views.mask[index, ..., None].to(torch.uint8) * 255)
    return frame


def write_pixels(path: Path, image: Tensor) -> None:
    """Write ``[H, W, C]`` of 8 bits as PNG, floats as TIFF of 16 bits."""
    with replacing(path) as beside:
        if image.dtype == torch.uint8:
            iio.imwrite(beside, image.squeeze(-1).numpy(), extension=".png")
        else:
            tifffile.imwrite(beside, (image.numpy() * 65535).round().astype(np.uint16), photometric="rgb")
