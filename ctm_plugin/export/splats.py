"""Export of a run's Gaussians in plain RGB, lit, as a PLY file that splat viewers open."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from ctm_plugin.backbones.posed import PosedBackbone
from ctm_plugin.backbones.splat import NEAR_FRACTION, Splat
from ctm_plugin.color.light import Light
from ctm_plugin.files import replacing
from ctm_plugin.metrics.image import psnr
from ctm_plugin.metrics.precision import full_float32
from ctm_plugin.optim.grid_adam import GridAdam
from ctm_plugin.scene.poses import IDENTITY
from ctm_plugin.scene.views import Scene, Views
from ctm_plugin.show.bars import tracked
from ctm_plugin.splats.gaussians import Camera, Gaussians, camera_of, colors_seen
from ctm_plugin.splats.render import picture
from ctm_plugin.splats.start import SH_C0

TRAIN_STEPS = 600
"""Steps of training the exported colours; after half of them pictures are 0.3 dB further from the run's."""
LEARNING_RATES = {"sh0": 3e-2, "shN": 6e-3, "opacities": 6e-2}
"""Learning rates of the exported Gaussians' colours and opacities."""
LR_FINAL = 0.05
"""Factor that the learning rates have fallen to at the last step."""
MIN_START = 0.02
"""Least initial colour: colours at 0, where they are clipped, would not learn."""
MAX_CAMERAS = 32
"""Most cameras over which a Gaussian's initial colour is the mean."""
HARMONIC_SIGNS = torch.tensor([(-1.0) ** order for degree in (1, 2, 3) for order in range(-degree, degree + 1)])
"""Signs that turn harmonics above degree 0, without Condon-Shortley phase here, into those of 3DGS's files."""
PROPERTY_GROUPS = {"f_dc": 3, "f_rest": 3 * len(HARMONIC_SIGNS), "opacity": 1, "scale": 3, "rot": 4}
"""Groups of properties in 3DGS's PLY files, and the number of properties in each."""
PROPERTIES = [
    "x",
    "y",
    "z",
    "nx",
    "ny",
    "nz",
    *(f"{group}_{i}" for group, size in PROPERTY_GROUPS.items() for i in range(size)),
]
"""Names of the properties of 3DGS's PLY files, in order."""
PROPERTIES[PROPERTIES.index("opacity_0")] = "opacity"


def plain(module: Splat, light: Light, steps: int, sided: bool = True, every: int = 1) -> Gaussians:
    """Train RGB colours and opacities to reproduce the run's own pictures.

    Colours that are decoded one by one show something else: decoding and blending do not commute.

    Args:
        module: the backbone with trained weights.
        light: light of the run's pictures.
        steps: number of training steps.
        sided: whether colours depend on the view direction.
        every: train on each ``every``-th row and column of pixels.

    Returns:
        Gaussians of three channels in the files' world, on the module's device.
    """
    scene, wanted = module.scene, {}
    cameras, behind = cameras_in_files(module, scene.train, every), module.constant_background()[0]
    sh0 = (first_colors(module, light).clamp_min(MIN_START) - 0.5) / SH_C0
    shN = sh0.new_zeros(len(sh0), PROPERTY_GROUPS["f_rest"] * sided)
    start = in_files(module.gaussians, scene)._replace(sh0=sh0, shN=shN)
    tables = {name: getattr(start, name).clone().requires_grad_() for name in LEARNING_RATES if sided or name != "shN"}
    groups = [{"params": [table], "lr": LEARNING_RATES[name]} for name, table in tables.items()]
    optimizer = GridAdam(groups, betas=module.betas, eps=1e-15)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, LR_FINAL ** (1 / steps))
    for step in tracked(range(steps), "colours"):
        view = module.view_of(step)
        if view not in wanted:
            wanted[view] = lit_view(module, scene.train, view, light, every).permute(2, 0, 1).half()
        optimizer.zero_grad()
        F.mse_loss(render_splats(start._replace(**tables), cameras[view], behind), wanted[view].float()).backward()
        optimizer.step()
        schedule.step()
    return start._replace(**{name: table.detach() for name, table in tables.items()})


@torch.no_grad()
def first_colors(module: Splat, light: Light) -> Float[Tensor, "n 3"]:
    """Each Gaussian's colour, decoded and lit, as the mean over the directions of the training cameras."""
    centres, floor = module.c2w[:: math.ceil(len(module.c2w) / MAX_CAMERAS), :, 3], -module.low / module.range
    seen = (module.low + module.range * colors_seen(module.gaussians, at, module.degrees, floor) for at in centres)
    return sum(light.apply(module.decode(latent)) for latent in seen) / len(centres)


@torch.no_grad()
def lit_view(module: PosedBackbone, views: Views, index: int, light: Light, every: int = 1) -> Float[Tensor, "h w 3"]:
    """Render the run's picture of a view, lit; only each ``every``-th row and column."""
    with full_float32(module.device):
        return light.apply(module.render_view(views, index, every)["rgb"])


def render_splats(gaussians: Gaussians, camera: Camera, behind: Float[Tensor, " 3"]) -> Float[Tensor, "3 h w"]:
    """Render Gaussians of three channels in front of a background colour ``behind``."""
    degrees, shift = math.isqrt(gaussians.shN.shape[1] // 3 + 1), torch.zeros_like(gaussians.means[:, :2])
    image, left = picture(gaussians, camera, shift, degrees, 0.0, 0)
    return image + left * behind[:, None, None]


@torch.no_grad()
def likeness(module: Splat, gaussians: Gaussians, light: Light) -> float:
    """Mean PSNR of the test views rendered from exported Gaussians, against the run's own pictures."""
    views, behind = module.scene.test, module.constant_background()[0]
    pictures = (render_splats(gaussians, camera, behind).permute(1, 2, 0) for camera in cameras_in_files(module, views))
    scores = [psnr(each.clamp(0, 1), lit_view(module, views, index, light)) for index, each in enumerate(pictures)]
    return float(torch.stack(scores).mean())


@torch.no_grad()
def in_files(gaussians: Gaussians, scene: Scene) -> Gaussians:
    """Transform means, scales and quaternions into the files' world; harmonics keep the axes of the scene."""
    back = (scene.world or IDENTITY).inverse()
    quats = Rotation.from_matrix(back.turn) * Rotation.from_quat(np.roll(gaussians.quats.cpu().numpy(), -1, 1))
    means, quats = back.moved(gaussians.means.double().cpu().numpy()), np.roll(quats.as_quat(), 1, 1)
    return Gaussians(*(table.detach() for table in gaussians))._replace(
        means=torch.from_numpy(means).to(gaussians.means),
        scales=gaussians.scales + math.log(back.scale),
        quats=torch.from_numpy(quats).to(gaussians.quats),
    )


def cameras_in_files(module: Splat, views: Views, every: int = 1) -> list[Camera]:
    """The views' cameras in the files' world, on the module's device; see :func:`camera_of`."""
    back = (module.scene.world or IDENTITY).inverse()
    c2w = torch.from_numpy(back.of_poses(views.c2w.double().numpy())).float()
    near, there = NEAR_FRACTION * module.scene.near * back.scale, replace(views, c2w=c2w)
    return [camera_of(there, index, near, every).on(module.device) for index in range(len(views))]


def write_splats(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians as 3DGS's PLY, whole or not at all; they have three channels, harmonics up to degree 3."""
    shN = (gaussians.shN.cpu().unflatten(1, (-1, 3)) * HARMONIC_SIGNS[:, None]).transpose(1, 2).flatten(1)
    means, scales, quats, opacities, sh0, _ = (table.cpu() for table in gaussians)
    table = torch.cat([means, torch.zeros_like(means), sh0, shN, opacities, scales, F.normalize(quats, dim=1)], 1)
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(means)}"]
    head += [f"property float {name}" for name in PROPERTIES]
    with replacing(path) as beside:
        beside.write_bytes("\n".join([*head, "end_header\n"]).encode() + table.numpy().astype("<f4").tobytes())


def read_splats(path: Path) -> Gaussians:
    """Read Gaussians from a file that :func:`write_splats` wrote."""
    body = path.read_bytes().partition(b"end_header\n")[2]
    table = torch.from_numpy(np.frombuffer(body, "<f4").reshape(-1, len(PROPERTIES)).astype(np.float32))
    means, _, sh0, shN, opacities, scales, quats = table.split([3, 3, *PROPERTY_GROUPS.values()], 1)
    shN = shN.unflatten(1, (3, -1)).transpose(1, 2) * HARMONIC_SIGNS[:, None]
    return Gaussians(means, scales, quats, opacities, sh0, shN.flatten(1))
