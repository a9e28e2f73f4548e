"""Conversion between the browser's camera and views, rays and poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from ctm_plugin.rays.cameras import Rays, pixel_rays
from ctm_plugin.scene.camera_paths import focus
from ctm_plugin.scene.poses import is_field_of_view, looked_at
from ctm_plugin.scene.views import Scene, Views

OPENCV_TO_OPENGL = np.array([1.0, -1.0, -1.0])
"""Signs that take viser's axes, OpenCV's (x right, y down, z forward), to OpenGL's."""
MIN_ASPECT = 1e-3
"""Least aspect of a window, and the inverse of the largest."""


@dataclass(frozen=True)
class BrowserCamera:
    """The browser's camera in viser: a pinhole whose axis goes through the picture's centre.

    Attributes:
        wxyz: camera to world, OpenCV axes, a quaternion of unit length.
        position: the camera's centre in scene units.
        fov: vertical field of view in radians, over the whole height.
        aspect: width over height.
    """

    wxyz: tuple[float, ...]
    position: tuple[float, ...]
    fov: float
    aspect: float

    def usable(self) -> bool:
        """Whether the camera can render: a window without area has aspect 0 or NaN."""
        numbers = all(map(math.isfinite, (*self.wxyz, *self.position))) and any(self.wxyz)
        return numbers and is_field_of_view(self.fov) and MIN_ASPECT <= self.aspect <= 1 / MIN_ASPECT

    @classmethod
    def of(cls, c2w: Float[np.ndarray, "3 4"], fov: float, aspect: float = 1.0) -> BrowserCamera:
        """Make a browser camera from a camera-to-world matrix with OpenGL axes."""
        wxyz = np.roll(Rotation.from_matrix(c2w[:, :3] * OPENCV_TO_OPENGL).as_quat(), 1)
        return cls(tuple(wxyz.tolist()), tuple(c2w[:, 3].tolist()), fov, aspect)

    @property
    def c2w(self) -> Float32[Tensor, "3 4"]:
        """Camera to world, OpenGL axes."""
        turn = Rotation.from_quat(np.roll(self.wxyz, -1)).as_matrix() * OPENCV_TO_OPENGL
        return torch.from_numpy(np.column_stack([turn, self.position])).float()

    def size(self, longest: int) -> tuple[int, int]:
        """Height and width in pixels of a picture whose longer side is ``longest``."""
        if self.aspect >= 1:
            return max(1, round(longest / self.aspect)), longest
        return longest, max(1, round(longest * self.aspect))

    def views(self, height: int, width: int) -> Views:
        """A black view of this camera. At any size its edges are those of the field of view: where rounding changed
        the aspect, pixels are not quite square."""
        half = math.tan(self.fov / 2)
        lens = torch.tensor([[width / (2 * half * self.aspect), height / (2 * half), width / 2, height / 2]])
        return Views(torch.zeros(1, height, width, 3, dtype=torch.uint8), self.c2w[None], lens, ("view",))

    def rays(self, height: int, width: int) -> Rays:
        """Rays through the centres of all pixels of the camera's picture, row after row."""
        views = self.views(height, width)
        return pixel_rays(views.c2w, views.intrinsics, height, width, torch.arange(height * width))


def view_camera(views: Views, index: int) -> BrowserCamera:
    """The browser camera of a view; principal point and lens distortion are dropped."""
    fov = 2 * math.atan(views.height / (2 * views.intrinsics[index, 1].item()))
    return BrowserCamera.of(views.c2w[index].double().cpu().numpy(), fov, views.width / views.height)


def ahead(scene: Scene, c2w: Float[Tensor, "n 3 4"], times: float = 1.0) -> Float64[np.ndarray, "n 3"]:
    """Points on cameras' axes at ``times`` the depth of the point that all cameras look at.

    On forward-facing scenes that point is the focus of the spiral path.
    """
    eyes, forward = c2w.double().cpu().numpy()[..., 3], -c2w.double().cpu().numpy()[..., 2]
    if scene.geometry == "forward":
        return eyes + times * focus(scene.near, scene.far) * forward
    middle = looked_at(scene.train.c2w.cpu().double().numpy(), damping=1e-9)
    return eyes + times * ((middle - eyes) * forward).sum(1, keepdims=True).clip(scene.near) * forward


def extent(scene: Scene) -> Float64[np.ndarray, "2 3"]:
    """Two corners of a box round all training cameras and the space before them, to twice the depth looked at."""
    points = np.concatenate([ahead(scene, scene.train.c2w, 0.0), ahead(scene, scene.train.c2w, 2.0)])
    middle, half = (points.max(0) + points.min(0)) / 2, np.ptp(points, axis=0) / 2
    half = np.maximum(half, half.max() / 2)
    digits = 2 - math.floor(math.log10(half.max()))  # three of the longest side's
    return np.stack([middle - half, middle + half]).round(digits)
