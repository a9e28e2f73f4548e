"""Gaussians to a picture: alpha compositing front to back, tile by tile."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.door import looped
from ctm_plugin.splats.gaussians import MAX_ALPHA, MIN_ALPHA, Camera, Gaussians, ProjectedGaussians, project, secants

TILE_SIDE = 16
"""Pixels along a tile's side."""
PLANE_CHANNELS = 3
"""Number of channels that :func:`with_plane` adds to the colours, for depth."""
INVERSE_CHANNELS = 1
"""Number of channels after the colours for inverse depth ``near / z``, z along the camera's axis."""
STRIDES = (1, 4)
"""Pixels from one of the three pixels whose depths :func:`bends` compares to the next."""
EDGE_WIDTH = 0.03
"""Difference of two colours, as a share of the scene's range, at which a bend weighs 1 / e."""
MIN_EXPONENT = -8
"""Least exponent of a bend's weight, see :func:`bends`: the strongest edges of colour still weigh exp(-8)."""
MIN_OPACITY = 0.1
"""Least opacity of a pixel that its depth is divided by."""


def with_plane(projected: ProjectedGaussians, camera: Camera) -> Tensor:
    """Colours ``[N, k + 3]`` whose rendering holds expected depth as a plane ``d + x s_x + y s_y`` of each pixel.

    x and y are counted from the picture's middle.
    """
    middle = projected.means.new_tensor([camera.width / 2, camera.height / 2])
    plane = projected.depths.detach() - (projected.slopes * (projected.means - middle)).sum(1)
    return torch.cat([projected.colors, plane[:, None], projected.slopes], 1).contiguous()


@looped("splats:picture")
def picture(
    gaussians: Gaussians, camera: Camera, shift: Tensor, degrees: int, floor: float, more: int
) -> tuple[Tensor, Tensor]:
    """Render Gaussians without a background.

    A pixel p gets ``sum_i c_i alpha_i T_i``, front to back by depth, with ``alpha_i = o_i exp(-q / 2)``, q the squared
    distance of p from the mean under the conic, at most 0.99 and 0 below 1/255, and ``T_i`` the product of all
    ``1 - alpha_j`` in front.

    Args:
        gaussians: N of them, of k channels.
        camera: pose and lens.
        shift: ``[N, 2]`` zeros, whose gradient is that of the means on the picture, in pixels.
        degrees, floor: see :func:`~ctm_plugin.splats.gaussians.colors_seen`.
        more: number of further channels: 0, :data:`PLANE_CHANNELS` (without gradients) or :data:`INVERSE_CHANNELS`.

    Returns:
        ``[k + more, H, W]``, and ``[H, W]``, the transmittance.
    """
    projected = project(gaussians, camera, shift, degrees, floor)
    colors = projected.colors
    if more == PLANE_CHANNELS:
        colors = with_plane(projected, camera)
    elif more == INVERSE_CHANNELS:
        colors = torch.cat([colors, (camera.near / projected.depths)[:, None]], 1)
    tables = projected.means, projected.conics, projected.opacities, projected.extents, projected.depths
    return rasterize(*tables, colors, camera.width, camera.height)


@looped(kernel="splats:rasterize")
def rasterize(
    means: Tensor, conics: Tensor, opacities: Tensor, extents: Tensor, depths: Tensor, colors: Tensor, width: int,
    height: int,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Composite :class:`ProjectedGaussians` of colours ``[N, c]`` in plain torch, see :func:`picture`."""
    order = depths.detach().argsort(stable=True)
    means, conics, opacities, extents = (each[order] for each in (means, conics, opacities, extents))
    colors, bands = colors[order], []
    for top in range(0, height, TILE_SIDE):
        bottom, row = min(top + TILE_SIDE, height), []
        for left in range(0, width, TILE_SIDE):
            right = min(left + TILE_SIDE, width)
            low, high = means.new_tensor([left, top]), means.new_tensor([right, bottom])
            meets = (extents > 0).all(1) & (means + extents > low).all(1) & (means - extents < high).all(1)
            here = meets.nonzero().squeeze(1)
            ys, xs = torch.meshgrid(
                torch.arange(top, bottom, device=means.device) + 0.5,
                torch.arange(left, right, device=means.device) + 0.5,
                indexing="ij",
            )
            dx, dy = xs[..., None] - means[here, 0], ys[..., None] - means[here, 1]
            a, b, c = conics[here].unbind(1)
            alpha = (opacities[here] * (-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy).exp()).clamp_max(MAX_ALPHA)
            alpha = alpha * (alpha >= MIN_ALPHA)
            passed = torch.cat([alpha.new_ones(*alpha.shape[:2], 1), 1 - alpha], -1).cumprod(-1)
            row.append(torch.cat([(alpha * passed[..., :-1]) @ colors[here], passed[..., -1:]], -1))
        bands.append(torch.cat(row, 1))
    whole = torch.cat(bands).permute(2, 0, 1)
    return whole[:-1], whole[-1]


def expected_depth(
    image: Float[Tensor, "c h w"], left: Float[Tensor, "h w"], camera: Camera, far: float
) -> Float[Tensor, "h w"]:
    """Distances along the rays out of a picture's depth channels; light that nothing stops counts as at ``far``."""
    x = torch.arange(camera.width, device=image.device) + (0.5 - camera.width / 2)
    y = torch.arange(camera.height, device=image.device) + (0.5 - camera.height / 2)
    plane = image[-3] + x * image[-2] + y[:, None] * image[-1]
    return (plane * secants(camera)).clamp(0, None) + left * far


@looped("bends:bends")
def bends(
    inverse: Float[Tensor, "h w"], stopped: Float[Tensor, "h w"], colors: Float[Tensor, "h w k"]
) -> Float[Tensor, ""]:
    """Measure how far surfaces are from planes: mean ``|d(p - s) - 2 d(p) + d(p + s)| exp(-min(e / 0.03, 8)) W / s``.

    d is the inverse depth, which is linear across the picture of a plane; s goes one way and the other; e is the larger
    of the two differences of colour. Large at a fold within one colour, nearly nothing where the picture has an edge.

    Args:
        inverse: rendered inverse depth in any unit, not divided by opacity; it gets a gradient.
        stopped: opacity of each pixel, the share of light that the Gaussians stop.
        colors: rendered colours, without gradient; the scene's colours fill [0, 1].
    """
    surface, terms = inverse / stopped.detach().clamp_min(MIN_OPACITY), []
    for axis in (0, 1):
        for stride in STRIDES:
            count = surface.shape[axis] - 2 * stride
            if count > 0:
                before, here, after = (surface.narrow(axis, i * stride, count) for i in range(3))
                first, middle, last = (colors.narrow(axis, i * stride, count) for i in range(3))
                edge = torch.maximum((middle - first).abs().mean(-1), (last - middle).abs().mean(-1))
                fold = (before - 2 * here + after).abs() * (-edge / EDGE_WIDTH).clamp_min(MIN_EXPONENT).exp()
                terms.append(fold.mean() * (surface.shape[1] / stride / len(STRIDES)))
    return sum(terms, inverse.new_zeros(()))
