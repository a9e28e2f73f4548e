"""A camera path through cameras that a person chose."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor


@dataclass(frozen=True, eq=False)
class KeyFrames:
    """N cameras, as long from one to the next.

    Attributes:
        c2w: ``[N, 3, 4]`` camera to world, OpenGL axes.
        fov: ``[N]`` vertical fields of view in radians.
        closed: whether the path goes on from the last to the first.
    """

    c2w: Float64[np.ndarray, "n 3 4"]
    fov: Float64[np.ndarray, " n"]
    closed: bool = False

    def path(self, frames: int) -> tuple[Float32[Tensor, "f 3 4"], Float32[Tensor, " f"]]:
        """A smooth path through all key frames.

        Centres lie on a uniform Catmull-Rom spline: between keys a cubic whose slope at key i is
        ``(p[i+1] - p[i-1]) / 2``, at an open end the difference to the only neighbour (Catmull and Rom 1974). Turns are
        scipy's cubic spline of rotations, which is slerp between two; fields of view are monotone between keys.

        Args:
            frames: F >= 1, evenly in time; an open path's last is the last key, a closed one's comes before the first.

        Returns:
            ``[F, 3, 4]`` camera to world, OpenGL axes, and ``[F]`` fields of view in radians.
        """
        c2w, fov = self.c2w, self.fov
        if len(c2w) == 1:
            return torch.from_numpy(c2w).float().expand(frames, 3, 4), torch.from_numpy(fov).float().expand(frames)
        if self.closed:
            c2w, fov = np.concatenate([c2w, c2w[:1]]), np.append(fov, fov[0])
        keys, eyes = np.arange(len(c2w)), c2w[:, :, 3]
        slopes = np.gradient(eyes, axis=0)
        if self.closed:
            slopes[0] = slopes[-1] = (eyes[1] - eyes[-2]) / 2
        at = np.linspace(0, keys[-1], frames, endpoint=not self.closed)
        turns = RotationSpline(keys, Rotation.from_matrix(c2w[:, :, :3]))(at).as_matrix()
        poses = np.concatenate([turns, CubicHermiteSpline(keys, eyes, slopes)(at)[:, :, None]], axis=2)
        return torch.from_numpy(poses).float(), torch.from_numpy(PchipInterpolator(keys, fov)(at)).float()

    def content(self) -> dict[str, Any]:
        """What a file of them holds, as :func:`ctm_plugin.data.readers.key_frames.read_key_frames` reads it."""
        keys = [
            {"camera_to_world": pose.tolist(), "fov": math.degrees(fov)}
            for pose, fov in zip(self.c2w, self.fov, strict=True)
        ]
        return {"closed": self.closed, "keys": keys}
