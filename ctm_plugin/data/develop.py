"""From files to training images: read, shrink, degrade, round; many at a time."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from ctm_plugin.data.config import PhotoConfig
from ctm_plugin.data.degrade import add_noise, dim, view_generator
from ctm_plugin.data.readers.images import PICTURES, read_depth, read_image, to_8_bits
from ctm_plugin.data.readers.picture import MAX_PIXELS, Header, Reader
from ctm_plugin.data.resample import shrink, shrink_depth, shrink_mask
from ctm_plugin.errors import DataError
from ctm_plugin.scene.views import Pixels

DYNAMIC = "dynamic_mask_"
"""instant-ngp's prefix of a picture's name for the mask next to it, whose pixels that are not black are ignored."""


def develop_image(image: Float32[Tensor, "h w c"], config: PhotoConfig, name: str, noisy: bool, deep: bool) -> Pixels:
    """One image: shrink, dim, add noise, round unless it is deep. Alpha is only shrunk.

    Args:
        image: ``[H, W, 3]``, or ``[H, W, 4]`` with straight alpha, sRGB in [0, 1].
        config: by how much.
        name: of the view; together with the noise's seed it decides the noise.
        noisy: whether to add noise.
        deep: whether more than 8 bits are to be kept.

    Returns:
        ``[H2, W2, C]``, uint8, or float32 where it is deep.
    """
    image = shrink(image, *config.shrunk(*image.shape[:2]))
    colour = dim(image[..., :3], config.exposure)
    if noisy:
        colour = add_noise(colour, config.noise, view_generator(config.noise.seed, name))
    image = torch.cat([colour, image[..., 3:]], dim=-1)
    if not deep:
        return to_8_bits(image)
    return torch.where(image[..., 3:] > 0, image, 0.0) if image.shape[-1] == 4 else image


def read_headers(paths: Sequence[Path], reader: Reader = PICTURES) -> list[Header]:
    """The pictures' headers.

    Raises:
        DataError: one cannot be read, or has another size than the first.
    """
    headers = [reader.header(path) for path in paths]
    height, width = headers[0][:2]
    for path, header in zip(paths, headers, strict=True):
        if (header.height, header.width) != (height, width):
            found = f"an image of {header.width}x{header.height} pixels"
            raise DataError(path, found, f"{width}x{height} as in {paths[0].name}")
    return headers


def common_size(paths: Sequence[Path], reader: Reader = PICTURES) -> Header:
    """Height and width that all images share, whether any has alpha and whether any is deep.

    Raises:
        DataError: see :func:`read_headers`.
    """
    headers = read_headers(paths, reader)
    return Header(*headers[0][:2], *(any(header[kind] for header in headers) for kind in (2, 3)))


def memory() -> int:
    """Bytes of this machine's memory."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def develop(
    paths: Sequence[Path],
    names: Sequence[str],
    config: PhotoConfig,
    noisy: bool,
    reader: Reader = PICTURES,
    canvas: tuple[int, int] | None = None,
) -> Pixels:
    """The images ``[N, H, W, C]`` of one split, see :func:`develop_image`.

    Where only some have alpha the others are opaque, where only some are deep all keep more than 8 bits. Linear light
    outside [0, 1] is clipped, with one warning.

    Args:
        paths: of at least one image.
        names: of the views.
        config: what to do with them.
        noisy: whether to add noise.
        reader: of such files.
        canvas: height and width in whose upper left corner images of several sizes lie once they have shrunk, 0 outside
            them; ``None``: all are of one size.

    Raises:
        DataError: an image cannot be read, has another size than the first without a canvas, or all are more than fits
            into memory.
        ConfigError: ``downscale`` or ``width`` do not suit the size.
    """
    headers = [reader.header(path) for path in paths] if canvas else read_headers(paths, reader)
    sizes = [config.shrunk(header.height, header.width) for header in headers]
    height, width = canvas or sizes[0]
    deep = any(header.deep for header in headers)
    channels = 4 if any(header.alpha for header in headers) else 3
    opaque, dtype = (1, torch.float32) if deep else (255, torch.uint8)
    needed = len(paths) * height * width * channels * dtype.itemsize
    if needed > memory():
        found = f"{len(paths)} pictures of {width}x{height}, {needed / 2**30:.0f} GiB"
        expected = f"less than the {memory() / 2**30:.0f} GiB of this machine: see dataset.downscale, dataset.skip"
        raise DataError(paths[0].parent, found, expected)
    for colours in sorted({header.colours for header in headers if header.colours}):
        told = f"pictures have {colours}, which is not applied: turn them into sRGB"
        warnings.warn(f"{paths[0].parent}: {told}", stacklevel=2)
    images = torch.zeros(len(paths), height, width, channels, dtype=dtype)
    clipped = []

    def fill(index: int) -> None:
        image = reader.image(paths[index])
        if image.amin() < 0 or image.amax() > 1:
            clipped.append(paths[index])
        image = develop_image(image.clamp_(0.0, 1.0), config, names[index], noisy, deep)
        own = images[index, : image.shape[0], : image.shape[1]]
        own[..., 3:] = opaque
        own[..., : image.shape[-1]] = image

    largest = max(header.height * header.width for header in headers)
    at_once = max(1, min(8, os.cpu_count() or 1, MAX_PIXELS // largest))  # large ones fill the memory
    with ThreadPoolExecutor(at_once) as pool:
        list(pool.map(fill, range(len(paths))))
    if clipped:
        told = f"{len(clipped)} of {len(paths)} pictures have light outside [0, 1], which is clipped"
        warnings.warn(f"{paths[0].parent}: {told}, such as {min(clipped).name}", stacklevel=2)
    return images


def develop_depth(paths: Sequence[Path], scale: float, height: int, width: int) -> Float32[Tensor, "n h w"]:
    """Depth pictures of one split.

    Args:
        paths: of at least one picture.
        scale: scene units a step.
        height, width: of the images as they were developed.

    Returns:
        ``[N, height, width]`` distance along the ray, NaN where nothing was hit.

    Raises:
        DataError: one cannot be read, is smaller than the images, or has another ratio.
    """
    depths = []
    for path in paths:
        depth = read_depth(path, scale)
        check_covers(path, "depth", depth, height, width)
        depths.append(shrink_depth(depth, height, width))
    return torch.stack(depths)


def develop_masks(
    paths: Sequence[Path | None], sizes: Sequence[tuple[int, int]], canvas: tuple[int, int]
) -> Bool[Tensor, "n h w"] | None:
    """Find which pixels of one split count: those wholly inside a mask's area that is brighter than half.

    Of instant-ngp's masks, ``DYNAMIC``, the black area counts. Pixels of a canvas outside its image never count.
    Where a mask is transparent somewhere, its alpha stands for its brightness.

    Args:
        paths: of the masks; where there is none, all of the image's pixels count.
        sizes: height and width of each image as it was developed.
        canvas: height and width of what they lie on.

    Returns:
        ``[N, *canvas]``; ``None`` where all pixels count.

    Raises:
        DataError: one cannot be read, is smaller than the images, has another ratio, or leaves nothing.
    """
    if not any(paths) and {*sizes} == {canvas}:
        return None
    masks = torch.zeros(len(paths), *canvas, dtype=torch.bool)
    for index, (path, (height, width)) in enumerate(zip(paths, sizes, strict=True)):
        masks[index, :height, :width] = True
        if path is None:
            continue
        image, dynamic = read_image(path), path.name.startswith(DYNAMIC)
        cut_out = image.shape[-1] == 4 and bool((image[..., 3] < 1).any())
        level = image[..., 3] if cut_out else image[..., :3].amax(-1)
        mask = level == 0 if dynamic else level > 127.5 / 255
        check_covers(path, "a mask", mask, height, width)
        masks[index, :height, :width] = shrink_mask(mask, height, width)
        if not masks[index].any():
            found = f"a mask that leaves no pixel of {width}x{height}"
            raise DataError(path, found, f"one with some {'black' if dynamic else 'brighter than half'}: those count")
    return masks


def check_covers(path: Path, what: str, picture: Tensor, height: int, width: int) -> None:
    """Refuse what is smaller than the images or has another ratio.

    Raises:
        DataError: ``picture``, ``[H, W]``, is or has.
    """
    tall, wide = picture.shape
    if tall < height or wide < width or min(abs(tall * width / wide - height), abs(wide * height / tall - width)) > 1:
        raise DataError(path, f"{what} of {wide}x{tall} pixels", f"{width}x{height} as the images, or larger and alike")
