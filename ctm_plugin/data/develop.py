"""From files to training images: read, shrink, degrade, round; many at a time."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from ctm_plugin.data.config import PhotoConfig
from ctm_plugin.data.degrade import add_noise, dim, view_generator
from ctm_plugin.data.readers.images import (
    MAX_PIXELS,
    PICTURES,
    Header,
    Reader,
    read_depth,
    shrink,
    shrink_depth,
    to_8_bits,
)
from ctm_plugin.errors import ConfigError, DataError


def develop_image(
    image: Float32[Tensor, "h w c"], config: PhotoConfig, name: str, noisy: bool
) -> UInt8[Tensor, "h2 w2 c"]:
    """One image: shrink, dim, add noise, round. Alpha is only shrunk.

    Args:
        image: ``[H, W, 3]``, or ``[H, W, 4]`` with straight alpha, sRGB in [0, 1].
        config: by how much; ``config.downscale`` divides H and W.
        name: of the view; together with the noise's seed it decides the noise.
        noisy: whether to add noise.

    Returns:
        ``[H/downscale, W/downscale, C]``.
    """
    image = shrink(image, config.downscale)
    colour = dim(image[..., :3], config.exposure)
    if noisy:
        colour = add_noise(colour, config.noise, view_generator(config.noise.seed, name))
    return to_8_bits(torch.cat([colour, image[..., 3:]], dim=-1))


def common_size(paths: Sequence[Path], reader: Reader = PICTURES) -> Header:
    """Height and width that all images share, and whether any has alpha.

    Raises:
        DataError: one cannot be read, or has another size than the first.
    """
    headers = [reader.header(path) for path in paths]
    height, width, _ = headers[0]
    for path, header in zip(paths, headers, strict=True):
        if (header.height, header.width) != (height, width):
            found = f"an image of {header.width}x{header.height} pixels"
            raise DataError(path, found, f"{width}x{height} as in {paths[0].name}")
    return Header(height, width, any(header.alpha for header in headers))


def memory() -> int:
    """Bytes of this machine's memory."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def develop(
    paths: Sequence[Path], names: Sequence[str], config: PhotoConfig, noisy: bool, reader: Reader = PICTURES
) -> UInt8[Tensor, "n h w c"]:
    """The images of one split, see :func:`develop_image`. Where only some have alpha the others are opaque.

    Args:
        paths: of at least one image, all of one size.
        names: of the views.
        config: what to do with them.
        noisy: whether to add noise.
        reader: of such files.

    Raises:
        DataError: an image cannot be read or has another size than the first, or all are more than fits into memory.
        ConfigError: ``downscale`` does not divide the size.
    """
    height, width, alpha = common_size(paths, reader)
    factor = config.downscale
    if height % factor or width % factor:
        raise ConfigError("dataset.downscale", factor, f"a divisor of the image size {width}x{height}")
    channels = 4 if alpha else 3
    size = len(paths) * (height // factor) * (width // factor) * channels
    if size > memory():
        found = f"{len(paths)} pictures of {width}x{height}, {size / 2**30:.0f} GiB"
        expected = f"less than the {memory() / 2**30:.0f} GiB of this machine: see dataset.downscale, dataset.skip"
        raise DataError(paths[0].parent, found, expected)
    images = torch.full((len(paths), height // factor, width // factor, channels), 255, dtype=torch.uint8)

    def fill(index: int) -> None:
        image = develop_image(reader.image(paths[index]), config, names[index], noisy)
        images[index, ..., : image.shape[-1]] = image

    at_once = max(1, min(8, os.cpu_count() or 1, MAX_PIXELS // (height * width)))  # large ones fill the memory
    with ThreadPoolExecutor(at_once) as pool:
        list(pool.map(fill, range(len(paths))))
    return images


def develop_depth(
    paths: Sequence[Path], scale: float, factor: int, height: int, width: int
) -> Float32[Tensor, "n h w"]:
    """Depth pictures of one split.

    Args:
        paths: of at least one picture.
        scale: scene units a step.
        factor: how much the images were shrunk.
        height, width: of the images after that.

    Returns:
        ``[N, height, width]`` distance along the ray, NaN where nothing was hit.

    Raises:
        DataError: one cannot be read, or has another size than the images.
    """
    depths = []
    for path in paths:
        depth = read_depth(path, scale)
        if depth.shape != (height * factor, width * factor):
            found = f"depth of {depth.shape[1]}x{depth.shape[0]} pixels"
            raise DataError(path, found, f"{width * factor}x{height * factor} as the images")
        depths.append(shrink_depth(depth, factor))
    return torch.stack(depths)
