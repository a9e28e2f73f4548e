"""Camera paths around and in front of things: pure functions, z up, OpenGL cameras (x right, y up, looking at -z)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctm_plugin.scene.poses import facing
from ctm_plugin.settings.setting import Number

GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def look_at(eye: np.ndarray, target: np.ndarray | None = None) -> np.ndarray:
    """Make camera-to-world matrices of cameras at ``eye`` that look at ``target`` with z up.

    Args:
        eye: ``[..., 3]``, to ``[..., 4, 4]``.
        target: ``[3]`` the point in the middle of the picture, the origin by default.

    Raises:
        ValueError: a camera stands on its target or looks straight up or down, where "up" has no meaning.
    """
    back = np.asarray(eye, dtype=np.float64) - (0.0 if target is None else np.asarray(target, dtype=np.float64))
    if np.any(np.hypot(back[..., 0], back[..., 1]) < 1e-9):
        raise ValueError("look_at: a camera lies straight above or below its target")
    pose = np.zeros((*back.shape[:-1], 4, 4))
    pose[..., :3, :] = facing(back / np.linalg.norm(back, axis=-1, keepdims=True), [0.0, 0.0, 1.0], eye)
    pose[..., 3, 3] = 1.0
    return pose


def on_sphere(radius: Number, azimuth: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Place points ``[..., 3]`` at ``radius (cos e cos a, cos e sin a, sin e)``: azimuth a in radians, height sin e."""
    ring = np.sqrt(1.0 - np.square(height))
    return radius * np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), height], axis=-1)


def hemisphere(
    count: int, radius: Number, elevation: tuple[Number, Number] = (2.0, 75.0), jitter: Number = 0.25, seed: int = 0
) -> np.ndarray:
    """Spread cameras evenly by area over a band of the sphere: a golden spiral with seeded jitter.

    View ``i`` has ``azimuth = i * golden angle`` and ``height = lo + (hi - lo)(i + 1/2)/count``, where lo and hi are
    the sines of the elevations; both are then moved by up to ``jitter`` of the mean spacing and clipped to the band.

    Args:
        count, radius: how many cameras, >= 1, at this distance from the origin, which they look at.
        elevation: lowest and highest elevation in degrees, within (-90, 90).
        jitter: 0 for the plain spiral; 1 moves a camera by up to about one spacing.
        seed: of the jitter.

    Returns:
        ``[count, 4, 4]``.
    """
    low, high = np.sin(np.deg2rad(elevation))
    index = np.arange(count)
    noise = np.random.default_rng(seed).uniform(-jitter, jitter, size=(2, count))
    # The band has area 2 pi (high - low) on the unit sphere; one camera's share is a square of this side.
    spacing = np.sqrt(2.0 * np.pi * (high - low) / count)
    height = low + (high - low) * (index + 0.5) / count
    # On the unit sphere a step dh in height is dh / cos e long, a step da in azimuth is cos e da long.
    ring = np.sqrt(1.0 - np.square(height))
    azimuth = index * GOLDEN_ANGLE + noise[0] * spacing / ring
    height = np.clip(height + noise[1] * spacing * ring, low, high)
    return look_at(on_sphere(radius, azimuth, height))


def orbit(count: int, radius: Number, elevation: tuple[Number, Number] = (20.0, 50.0), turns: int = 1) -> np.ndarray:
    """Lead cameras along a closed path round the origin that rises and sinks once; a circle if both elevations are one.

    With ``t = i / count``: ``azimuth = 2 pi turns t``, ``elevation = lo + (hi - lo)(1 - cos 2 pi t)/2``.

    Args:
        count, radius, elevation: see :func:`hemisphere`.
        turns: times around.

    Returns:
        ``[count, 4, 4]``.
    """
    low, high = np.deg2rad(elevation)
    t = 2.0 * np.pi * np.arange(count) / count
    return look_at(on_sphere(radius, turns * t, np.sin(low + (high - low) * (1.0 - np.cos(t)) / 2.0)))


def forward_facing(
    count: int,
    eye: Sequence[Number] | np.ndarray,
    target: Sequence[Number] | np.ndarray,
    extent: tuple[Number, Number],
    jitter: Number = 0.25,
    seed: int = 0,
) -> np.ndarray:
    """Place cameras on a jittered grid in a plane, all looking at one point: how LLFF's scenes were taken by hand.

    The grid has ``ceil(sqrt(count))`` columns (49 views: 7 x 7), is centred at ``eye``, faces ``target`` and is walked
    row by row from above; each camera is moved in the plane by up to ``jitter`` of the grid's spacing.

    Args:
        count: >= 1.
        eye, target: ``[3]`` the grid's middle, and the point in the middle of each picture.
        extent: width and height of the grid in scene units.
        jitter: 0 for the plain grid.
        seed: of the jitter.

    Returns:
        ``[count, 4, 4]``.
    """
    eye, target = np.asarray(eye, dtype=np.float64), np.asarray(target, dtype=np.float64)
    columns = int(np.ceil(np.sqrt(count)))
    rows = int(np.ceil(count / columns))
    index = np.arange(count)
    # Cell centres in [-1/2, 1/2] of each side's cells, jittered by a share of a cell.
    noise = np.random.default_rng(seed).uniform(-jitter, jitter, size=(2, count))
    across = (index % columns + 0.5 + noise[0]) / columns - 0.5
    down = (index // columns + 0.5 + noise[1]) / rows - 0.5
    frame = look_at(eye, target)
    offset = across[:, None] * extent[0] * frame[:3, 0] - down[:, None] * extent[1] * frame[:3, 1]
    return look_at(eye + offset, target)
