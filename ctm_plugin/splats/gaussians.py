"""3D Gaussians: their projection through a lens, and their colours from a camera's direction."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.rays.cameras import distort, distortion_slopes, undistort
from ctm_plugin.rays.spherical_harmonics import harmonics
from ctm_plugin.scene.views import Views

EPS2D = 0.3
"""Variance in pixels squared that is added to each projected Gaussian: none is narrower than a pixel (3DGS)."""
MIN_ALPHA = 1 / 255
"""Alpha below which a Gaussian does not change a pixel (3DGS)."""
MAX_ALPHA = 0.99
"""Largest alpha of one Gaussian (3DGS)."""
FRAME_MARGINS = 1.3, 1.05
"""Limits of |x / z| and |y / z|, as multiples of the picture's edge: for pinholes, and for lenses, whose polynomial
folds further out. Beyond them the projection is linear."""


class Gaussians(NamedTuple):
    """N Gaussians with k colour channels in B harmonics of the viewing direction.

    Opacity is ``sigmoid(opacities)``, a standard deviation ``exp(scales)`` in scene units, a colour
    ``1/2 + sum_i Y_i(d) c_i`` for the direction d from the camera.
    """

    means: Float[Tensor, "n 3"]
    scales: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    """Quaternions (w, x, y, z) of any length > 0."""
    opacities: Float[Tensor, "n 1"]
    sh0: Float[Tensor, "n k"]
    """Colour coefficients of the constant spherical harmonic."""
    shN: Float[Tensor, "n rest"]
    """Colour coefficients of the B - 1 other harmonics, ``[N, (B - 1) k]``, channels of one harmonic after another."""


class Camera(NamedTuple):
    """Pose and lens of a picture; OpenCV's axes (x right, y down, looking along z).

    Attributes:
        turn: rotation from world to camera.
        centre: the camera's centre in the world.
        lens: (fx, fy, cx, cy) in pixels, the first pixel's centre at (0.5, 0.5).
        distortion: (k1, k2, p1, p2, k3); zeros of a pinhole.
        reach: largest |x / z| and |y / z| where the projection follows the lens.
        near: distance of the near plane along z.
        height, width: size of the picture in pixels.
    """

    turn: Float[Tensor, "3 3"]
    centre: Float[Tensor, " 3"]
    lens: Float[Tensor, " 4"]
    distortion: Float[Tensor, " 5"]
    reach: Float[Tensor, " 2"]
    near: float
    height: int
    width: int

    def on(self, device: torch.device) -> Camera:
        """Give the same camera with its tensors on ``device``."""
        return Camera(*(each.to(device) if isinstance(each, Tensor) else each for each in self))


def camera_of(views: Views, index: int, near: float, every: int = 1) -> Camera:
    """A view's camera, for the pixels of each ``every``-th row and column, the first included."""
    c2w, lens = views.c2w[index].double(), views.intrinsics[index].double()
    height, width = -(-views.height // every), -(-views.width // every)
    lens = torch.cat([lens[:2] / every, (lens[2:] - 0.5) / every + 0.5])
    distortion = lens.new_zeros(5) if views.distortion is None else views.distortion[index].double()
    turn = (c2w[:, :3] * c2w.new_tensor([1.0, -1.0, -1.0])).T
    edge = torch.linspace(0, 1, 9, dtype=lens.dtype, device=lens.device)
    rims = torch.cat([torch.stack(torch.broadcast_tensors(edge, edge.new_tensor(side)), 1) for side in (0.0, 1.0)])
    rims = torch.cat([rims, rims.flip(1)]) * -(-views.extents[index] // every).to(lens)
    across = torch.stack(undistort(*((rims - lens[2:]) / lens[:2]).unbind(1), distortion), 1)
    reach = across.abs().amax(0) * FRAME_MARGINS[bool(distortion.any())]
    parts = (turn.contiguous(), c2w[:, 3].contiguous(), lens, distortion, reach)
    return Camera(*(part.float() for part in parts), near, height, width)


class ProjectedGaussians(NamedTuple):
    """Gaussians projected onto a picture.

    Attributes:
        means: ``[N, 2]`` projected means in pixels, x right, y down.
        conics: ``[N, 3]`` the inverse covariance's xx, xy and yy.
        opacities: ``[N]``.
        colors: ``[N, k]``.
        depths: ``[N]`` along the camera's axis.
        slopes: ``[N, 2]``, change of the Gaussian's expected depth a pixel.
        extents: ``[N, 2]`` half the width and height in pixels of the area where alpha may reach 1/255; 0: invisible.
    """

    means: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    depths: Tensor
    slopes: Tensor
    extents: Tensor


def rotations(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Quaternions (w, x, y, z) of any length > 0 as matrices."""
    w, x, y, z = F.normalize(quats, dim=-1).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def colors_seen(gaussians: Gaussians, centre: Tensor, degrees: int, floor: float) -> Float[Tensor, "n k"]:
    """Colours from a camera's centre ``[3]``, at least ``floor``, by harmonics of l < ``degrees``.

    The direction is not differentiated.
    """
    directions = F.normalize(gaussians.means.detach() - centre, dim=-1)
    basis = harmonics(directions, degrees)
    channels = gaussians.sh0.shape[1]
    higher = gaussians.shN.unflatten(1, (-1, channels))[:, : degrees**2 - 1]
    colors = basis[:, :1] * gaussians.sh0 + (basis[:, 1:, None] * higher).sum(1)
    return (0.5 + colors).clamp_min(floor)


def project(gaussians: Gaussians, camera: Camera, shift: Tensor, degrees: int, floor: float) -> ProjectedGaussians:
    """Project by the local affine map of the lens at each mean (EWA splatting, Zwicker et al. 2002).

    A Gaussian of covariance V in the camera's frame has ``J V J' + 0.3`` on the picture, J the derivative of the
    projection at its mean. The lens' own derivative counts as constant in gradients.

    Args:
        gaussians: N of them.
        camera: pose and lens.
        shift: ``[N, 2]`` zeros, added to the projected means, whose gradient it receives.
        degrees, floor: see :func:`colors_seen`.
    """
    local = (gaussians.means - camera.centre) @ camera.turn.T
    there = local[:, 2] > camera.near
    x, y = local[:, 0], local[:, 1]
    z = torch.where(there, local[:, 2], camera.near)
    u, v = x / z, y / z
    cu, cv = u.clamp(-camera.reach[0], camera.reach[0]), v.clamp(-camera.reach[1], camera.reach[1])
    with torch.no_grad():
        xx, xy, yy = distortion_slopes(cu, cv, camera.distortion)
        at = torch.stack(distort(cu, cv, camera.distortion), 1)
    fx, fy, cx, cy = camera.lens
    # Its value is the lens' own, its derivative the local map's.
    du, dv = u - cu.detach(), v - cv.detach()
    means = torch.stack([fx * (at[:, 0] + xx * du + xy * dv) + cx, fy * (at[:, 1] + xy * du + yy * dv) + cy], 1)
    means = means + shift
    across, down = (fx / z)[:, None], (fy / z)[:, None]
    jacobian = torch.stack(
        [
            across * torch.stack([xx, xy, -(xx * cu + xy * cv)], 1),
            down * torch.stack([xy, yy, -(xy * cu + yy * cv)], 1),
        ],
        dim=1,
    )
    spread = rotations(gaussians.quats) * gaussians.scales.exp()[:, None, :]
    rows = jacobian @ camera.turn @ spread
    covariance = rows @ rows.transpose(1, 2) + EPS2D * torch.eye(2, dtype=rows.dtype, device=rows.device)
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    conics = torch.stack([c, -b, a], 1) / (a * c - b * b)[:, None]
    opacities = gaussians.opacities[:, 0].sigmoid()
    with torch.no_grad():
        along = (rows @ (camera.turn[2] @ spread)[:, :, None])[:, :, 0]
        slopes = conics[:, :2] * along[:, :1] + conics[:, 1:] * along[:, 1:]
        reach = 2 * (opacities / MIN_ALPHA).log()
        extents = (torch.stack([a, c], 1) * reach.clamp_min(0)[:, None]).sqrt() * there[:, None]
    return ProjectedGaussians(
        means, conics, opacities, colors_seen(gaussians, camera.centre, degrees, floor), z, slopes, extents
    )


def secants(camera: Camera) -> Float[Tensor, "h w"]:
    """Ratio of distance along the ray to depth along the camera's axis, for each pixel."""
    fx, fy, cx, cy = camera.lens
    x = (torch.arange(camera.width, device=fx.device) + 0.5 - cx) / fx
    y = (torch.arange(camera.height, device=fx.device)[:, None] + 0.5 - cy) / fy
    if camera.distortion.any():
        x, y = undistort(*torch.broadcast_tensors(x, y), camera.distortion)
    return (1 + x * x + y * y).sqrt()
