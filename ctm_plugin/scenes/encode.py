"""From linear renderings to files: sRGB with straight alpha, 16-bit depth, files that are whole or absent."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.files import replacing
from ctm_plugin.settings.setting import Number

DEPTH_SCALE = 1.0 / 4096.0
"""Scene units in one step of a depth picture; the largest depth is just under 16 units."""


def to_rgba8(premultiplied: np.ndarray) -> np.ndarray:
    """Turn linear colour with premultiplied alpha, as renderers give it, into 8-bit sRGB with straight alpha.

    ``colour = round(255 sRGB(premultiplied / alpha))``; colour is 0 where the rounded alpha is 0.

    Args:
        premultiplied: ``[H, W, 4]`` float, linear.

    Returns:
        ``[H, W, 4]`` uint8.
    """
    alpha = np.clip(premultiplied[..., 3:].astype(np.float64), 0.0, 1.0)
    light = np.clip(premultiplied[..., :3] / np.maximum(alpha, 1e-6), 0.0, 1.0)
    colour = linear_to_srgb(torch.from_numpy(light)).numpy()
    rgba = np.rint(255.0 * np.concatenate([colour, alpha], axis=-1)).astype(np.uint8)
    rgba[rgba[..., 3] == 0] = 0
    return rgba


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """Turn distance along the ray into 16 bits: ``round(depth / DEPTH_SCALE)``, 0 where nothing was hit (NaN).

    Args:
        depth: ``[...]`` in scene units, in (0, 65535 DEPTH_SCALE], or NaN.

    Returns:
        ``[...]`` uint16; decoding is off by at most ``DEPTH_SCALE / 2``.

    Raises:
        ValueError: a depth does not fit.
    """
    code = np.rint(depth / DEPTH_SCALE)
    if np.any(code < 1) or np.any(code > 65535):
        raise ValueError(f"encode_depth: depth outside ({DEPTH_SCALE}, {65535 * DEPTH_SCALE}]")
    return np.nan_to_num(code, nan=0.0).astype(np.uint16)


def decode_depth(code: np.ndarray, scale: Number = DEPTH_SCALE) -> np.ndarray:
    """Undo :func:`encode_depth`: ``[...]`` uint16 to float32 scene units, NaN where the code is 0."""
    return np.where(code == 0, np.nan, code * scale).astype(np.float32)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write ``[H, W]`` uint16 or ``[H, W, C]`` uint8 as a PNG, compressed as far as zlib goes, whole or not at all."""
    with replacing(path) as beside:
        beside.write_bytes(iio.imwrite("<bytes>", image, extension=".png", optimize=True, compress_level=9))


def write_npy(path: Path, array: np.ndarray) -> None:
    """Write an array ``[...]``, whole or not at all."""
    with replacing(path) as beside, open(beside, "wb") as file:
        np.save(file, array, allow_pickle=False)
