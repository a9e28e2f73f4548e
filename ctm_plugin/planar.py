"""Scores and pictures of planar alignment: quadrilaterals, patches, the fused picture (paper, Table 3 and Figure 6)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor

from ctm_plugin.backbones.barf2d import BARF2D
from ctm_plugin.metrics.alignment import corner_errors, warp_errors
from ctm_plugin.metrics.enhance import enhancement_gain, lift, psnr_enhanced
from ctm_plugin.metrics.image import best_constant_psnr, converged, psnr
from ctm_plugin.pictures import below, beside, latent_picture, write_png
from ctm_plugin.rays.homography import patch_corners, sl3_exp, to_pixels, warp

COLORS = ("#e6194b", "#42d4f4", "#f032e6", "#ffe119", "#3cb44b")
"""Of the patches' outlines."""
DARK = 2.0
"""Pictures that would have to be lifted by more are shown lifted as well."""


def score_planar(module: BARF2D, folder: Path) -> dict[str, Any]:
    """Score the homographies and the patches; write the pictures of :func:`planar_pictures` into ``folder``.

    Returns:
        ``warp_error`` (mean over patches of ``|| h - h_true ||``), ``corner_error`` (pixels), ``patch_psnr`` (mean over
        patches, against patches without noise), ``patch_psnr_pooled`` (of all their pixels together, as BARF's code
        has it), ``patch_psnr_enhanced``, ``image_psnr`` of the whole picture in the first patch's frame, which is the
        picture's own, and ``seen_psnr`` of its pixels that some patch shows; ``constant_psnr``, ``converged`` and
        ``per_patch``. Infinite numbers are ``None``.
    """
    module.eval()
    scene = module.scene
    rendered = module.decode(module.render_patches()).float().cpu()
    fused = module.decode(module.render_image()).float().cpu()
    warps = module.warps.detach().cpu()
    errors = warp_errors(warps, scene.true_warps)
    corners = corner_errors(warps, scene.true_warps, scene.height, scene.width, scene.patch)
    scores = psnr(rendered, scene.clean)
    gain = enhancement_gain(list(scene.clean), scene.exposure)
    lifted = [psnr_enhanced(one, truth, gain) for one, truth in zip(rendered, scene.clean, strict=True)]
    seen = scene.seen()
    constant = best_constant_psnr(list(scene.clean))
    patch_psnr = float(scores.mean())
    for name, picture in planar_pictures(module).items():
        write_png(folder / f"{name}.png", picture)
    numbers = {
        "psnr": patch_psnr,
        "patch_psnr": patch_psnr,
        "patch_psnr_pooled": _pooled(rendered, scene.clean),
        "patch_psnr_enhanced": float(torch.stack(lifted).mean()),
        "image_psnr": float(psnr(fused, scene.image)),
        "seen_psnr": _pooled(fused[seen], scene.image[seen]),
        "constant_psnr": float(constant),
        "warp_error": float(errors.mean()),
        "corner_error": float(corners.mean()),
    }
    rows = [
        {"patch": index, "psnr": float(score), "warp_error": float(error), "corner_error": float(corner)}
        for index, (score, error, corner) in enumerate(zip(scores, errors, corners, strict=True))
    ]
    protocol = (
        f"{scene.name}, 5 patches of {scene.patch}x{scene.patch} out of {scene.width}x{scene.height}, "
        f"exposure {scene.exposure:g}, float RGB clipped to [0, 1]"
    )
    return {
        **_finite(numbers),
        "enhancement_gain": gain,
        "converged": converged(patch_psnr, float(constant)),
        "per_patch": [_finite(row) for row in rows],
        "protocol": protocol,
    }


def _pooled(a: Tensor, b: Tensor) -> float:
    return float(-10 * (a.double() - b.double()).square().mean().log10())


def _finite(numbers: dict[str, Any]) -> dict[str, Any]:
    return {name: value if np.isfinite(value) else None for name, value in numbers.items()}


@torch.no_grad()
def planar_pictures(module: BARF2D) -> dict[str, Float[Tensor, "h w 3"]]:
    """``warps`` (outlines where the patches lie, on the picture, the true ones thin and white), ``patches`` (as trained
    on, and below as rendered), ``fused`` and ``latent`` (the whole neural picture); of dark pictures ``*_lifted``."""
    scene = module.scene
    latent = module.render_image().float().cpu()
    fused = module.decode(latent.to(module.device)).cpu()
    rendered = module.decode(module.render_patches()).float().cpu()
    rows = below(beside(*scene.patches), beside(*rendered))
    gain = enhancement_gain(list(scene.clean), scene.exposure)
    shown = {"fused": fused, "patches": rows}
    outlined = scene.image
    if gain > DARK:
        shown |= {f"{name}_lifted": lift(picture, gain) for name, picture in shown.items()}
        outlined = lift(scene.image, gain)
    warps = module.warps.cpu()
    return {
        "warps": outlines(outlined, warps, scene.true_warps, scene.patch),
        "latent": latent_picture(latent),
        **shown,
    }


@torch.no_grad()
def film_frame(module: BARF2D, every: int) -> Float[Tensor, "h w 3"]:
    """The outlines beside the fused picture, at half size; dark ones lifted. Of the fused picture one of ``every`` so
    many rows and columns is rendered."""
    scene = module.scene
    fused = module.decode(module.render_image(every)).float().cpu()
    picture = scene.image
    gain = enhancement_gain(list(scene.clean), scene.exposure)
    if gain > DARK:
        fused, picture = lift(fused, gain), lift(picture, gain)
    outlined = outlines(picture, module.warps.cpu(), scene.true_warps, scene.patch)[::2, ::2]
    return beside(outlined, F.interpolate(fused.permute(2, 0, 1)[None], outlined.shape[:2])[0].permute(1, 2, 0))


def outlines(
    picture: Float[Tensor, "h w 3"], warps: Float[Tensor, "n 8"], true_warps: Float[Tensor, "n 8"], patch: int
) -> Float[Tensor, "h w 3"]:
    """A picture with the patches' quadrilaterals on it: true ones thin and white, estimated ones in colour."""
    height, width, _ = picture.shape
    canvas = Image.fromarray((picture.clamp(0, 1) * 255).round().byte().numpy())
    pen = ImageDraw.Draw(canvas)
    corners = patch_corners(height, width, patch)
    for of_all, colors, thick in ((true_warps, ["white"] * len(warps), 1), (warps, COLORS, 3)):
        quads = to_pixels(warp(corners, sl3_exp(of_all)), height, width) - 0.5
        for quad, color in zip(quads.tolist(), colors, strict=True):
            pen.line([tuple(point) for point in [*quad, quad[0]]], fill=color, width=thick, joint="curve")
    return torch.from_numpy(np.array(canvas)).float() / 255
