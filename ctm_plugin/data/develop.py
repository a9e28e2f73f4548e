"""Training images out of picture files: read, shrunk, dimmed, given noise, rounded; several at a time."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from ctm_plugin.color.light import brighten
from ctm_plugin.data.degrade import add_noise, view_generator
from ctm_plugin.data.readers.images import PictureFile, read_depth, read_image, to_8_bits
from ctm_plugin.data.readers.picture import MAX_PIXELS
from ctm_plugin.data.settings import PhotoConfig
from ctm_plugin.errors import DataError
from ctm_plugin.scene.shrink import shrink, shrink_depth, shrink_mask
from ctm_plugin.scene.views import DARK_LEVEL, Pixels

DYNAMIC_PREFIX = "dynamic_mask_"
"""instant-ngp's prefix of a mask's file name; its pixels that are not black are ignored."""
SAMPLE_PICTURES = 8
"""Pictures from which it is decided whether all are dark."""


def memory() -> int:
    """Bytes of this machine's memory."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def means_matter(pictures: Sequence[PictureFile | None], config: PhotoConfig) -> bool:
    """Whether pictures are shrunk and dark: the means of their few dark levels then deserve more than 8 bits.

    A few pictures are sampled. Pictures that are dimmed, or get noise, stay at a camera's 8 bits.
    """
    there = [picture for picture in pictures if picture]
    if config.exposure != 1 or not config.noise.off:
        return False
    if all(config.shrunk(*picture.header[:2]) == picture.header[:2] for picture in there):
        return False
    few = there[:: -(-len(there) // SAMPLE_PICTURES)]
    colours = [shrink(each.pixels()[..., :3], *config.shrunk(*each.header[:2])).clamp(0, 1).flatten() for each in few]
    return float(np.quantile(torch.cat(colours).numpy(), 0.99)) < DARK_LEVEL


def develop(
    pictures: Sequence[PictureFile | None], names: Sequence[str], config: PhotoConfig, noisy: bool,
    canvas: tuple[int, int], deep: bool = False,
) -> Pixels:  # fmt: skip
    """The images ``[N, H, W, C]`` of one split: read, clipped to [0, 1], shrunk, dimmed, given noise and rounded.

    Alpha is only shrunk. 8 bits are kept in uint8, more in float32, which is not rounded. Where only some have alpha
    the others are opaque, where only some are deep, or with ``deep``, all are. Linear light outside [0, 1] is clipped,
    with one warning.

    Pictures that are not there are black, without any alpha; one is there at least. Noise is decided by the seed and
    the view's name. ``canvas`` is the height and width in whose upper left corner
    images of several sizes lie once they have shrunk, 0 outside them. Raises a DataError where memory is too small.
    """
    there = [index for index, picture in enumerate(pictures) if picture]
    headers, folder = [pictures[index].header for index in there], pictures[there[0]].path.parent
    height, width = canvas
    deep = deep or any(header.deep for header in headers)
    channels = 4 if any(header.alpha for header in headers) else 3
    opaque, dtype = (1, torch.float32) if deep else (255, torch.uint8)
    needed = len(pictures) * height * width * channels * dtype.itemsize
    if needed > memory():
        found = f"{len(pictures)} pictures of {width}x{height}, {needed / 2**30:.0f} GiB"
        expected = f"less than the {memory() / 2**30:.0f} GiB of this machine: see dataset.downscale, dataset.skip"
        raise DataError(folder, found, expected)
    for colours in sorted({header.colours for header in headers if header.colours}):
        note = f"pictures have {colours}, which is not applied: turn them into sRGB"
        warnings.warn(f"{folder}: {note}", stacklevel=2)
    images = torch.zeros(len(pictures), height, width, channels, dtype=dtype)
    clipped = []

    def fill(index: int) -> None:
        image = pictures[index].pixels()
        if image.dtype != torch.uint8:
            if image.amin() < 0 or image.amax() > 1:
                clipped.append(pictures[index].path.name)
            image = image.clamp_(0.0, 1.0)
        image = shrink(image, *config.shrunk(*image.shape[:2]))
        colour, alpha = image[..., :3], image[..., 3:]
        if config.exposure != 1:
            colour = brighten(colour, config.exposure, "hard")
        if noisy:
            colour = add_noise(colour, config.noise, view_generator(config.noise.seed, names[index]))
        image = torch.cat([colour, alpha], dim=-1)
        if deep and image.shape[-1] == 4:
            image = torch.where(alpha > 0, image, 0.0)
        own = images[index, : image.shape[0], : image.shape[1]]
        own[..., 3:] = opaque
        own[..., : image.shape[-1]] = image if deep else to_8_bits(image)

    largest = max(header.height * header.width for header in headers)
    at_once = max(1, min(8, os.cpu_count() or 1, MAX_PIXELS // largest))  # large ones fill the memory
    with ThreadPoolExecutor(at_once) as pool:
        list(pool.map(fill, there))
    if clipped:
        note = f"{len(clipped)} of {len(there)} pictures have light outside [0, 1], which is clipped"
        warnings.warn(f"{folder}: {note}, such as {min(clipped)}", stacklevel=2)
    return images


def develop_depth(paths: Sequence[Path], scale: float, height: int, width: int) -> Float32[Tensor, "n h w"]:
    """Read one split's depth: distances along the ray ``[N, height, width]``, NaN for nothing, ``scale`` a step."""
    depths = []
    for path in paths:
        depth = read_depth(path, scale)
        check_covers(path, "depth", depth, height, width)
        depths.append(shrink_depth(depth, height, width))
    return torch.stack(depths)


def develop_masks(
    paths: Sequence[Path | None], sizes: Sequence[tuple[int, int]], canvas: tuple[int, int]
) -> Bool[Tensor, "n h w"] | None:
    """Find which pixels ``[N, *canvas]`` of one split count: those wholly inside a mask's area brighter than half.

    In instant-ngp's masks (``DYNAMIC_PREFIX``) the black area counts. Pixels of the canvas outside an image never
    count. Where a mask is transparent somewhere, its alpha stands for its brightness. ``None`` where all pixels count.
    Raises a DataError for a mask in which none counts.
    """
    if not any(paths) and {*sizes} == {canvas}:
        return None
    masks = torch.zeros(len(paths), *canvas, dtype=torch.bool)
    for index, (path, (height, width)) in enumerate(zip(paths, sizes, strict=True)):
        masks[index, :height, :width] = True
        if path is None:
            continue
        image, dynamic = read_image(path), path.name.startswith(DYNAMIC_PREFIX)
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
    """Refuse a mask or depth picture ``[H, W]`` that is smaller than the images or has another aspect ratio."""
    tall, wide = picture.shape
    if tall < height or wide < width or min(abs(tall * width / wide - height), abs(wide * height / tall - width)) > 1:
        raise DataError(path, f"{what} of {wide}x{tall} pixels", f"{width}x{height} as the images, or larger and alike")
