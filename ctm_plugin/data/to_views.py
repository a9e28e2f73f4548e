"""Views out of photographs: orientation, size, pixels and cameras."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from ctm_plugin.data.capture import Capture, Photograph
from ctm_plugin.data.develop import develop, develop_depth, develop_masks, means_matter
from ctm_plugin.data.readers.images import to_8_bits
from ctm_plugin.data.readers.lens import PINHOLE, Intrinsics, check_lens
from ctm_plugin.data.readers.picture import UPRIGHT_ORIENTATION, Header
from ctm_plugin.data.settings import BoundsConfig, PhotoConfig
from ctm_plugin.errors import ConfigError, DataError
from ctm_plugin.scene.views import Views


def develop_photographs(capture: Capture, config: BoundsConfig) -> tuple[Views, Views]:
    """Develop a capture's photographs into training views, thinned by ``config.skip``, and test views.

    Raises a DataError without either, a ConfigError for ``random_matched`` without alpha."""
    source, photographs = capture.source, as_stored(capture.photographs, capture.source)
    headers = headers_of(photographs)
    photo = replace(config, downscale=1) if capture.shrunk else config
    cameras = [camera_of(photograph, header, source) for photograph, header in zip(photographs, headers, strict=True)]
    photo, sizes, canvas = on_one_canvas(headers, photo, source)
    for camera in dict.fromkeys(cameras):
        if camera.distortion != PINHOLE:
            check_lens(camera, source)
    distorted = any(camera.distortion != PINHOLE for camera in cameras)
    names, there = np.array(capture.views), np.array([each.picture is not None for each in photographs])
    training, views = config.trained_on(capture.testing), []
    deep = means_matter([photographs[i].picture for i in training], photo)
    for chosen, noisy in ((training, True), (np.flatnonzero(capture.testing), False)):
        if not len(chosen):
            found = f"no pictures for {'training' if noisy else 'testing'}"
            raise DataError(source, found, f"at least one for training and one for testing of {len(photographs)}")
        taken, own = [photographs[i] for i in chosen], [sizes[i] for i in chosen]
        if there[chosen].any():
            images = develop([each.picture for each in taken], names[chosen].tolist(), photo, noisy, canvas, deep)
        else:
            images = views[0].images.new_zeros(len(chosen), *views[0].images.shape[1:])
        depths = [each.depth for each in taken if each.depth]
        views.append(
            Views(
                images=images,
                c2w=torch.from_numpy(np.stack([each.c2w for each in taken])).to(torch.float32),
                intrinsics=torch.tensor([cameras[i].scaled(*sizes[i][::-1]).pinhole for i in chosen]),
                names=tuple(names[chosen].tolist()),
                distortion=torch.tensor([cameras[i].distortion for i in chosen]) if distorted else None,
                mask=develop_masks([each.mask for each in taken], own, canvas),
                pictured=None if there[chosen].all() else torch.from_numpy(there[chosen]),
                depth=develop_depth(depths, capture.depth_scale, *canvas) if depths and not noisy else None,
                lit=None if noisy else develop_lit(taken, photo, own, canvas),
                exposures=exposures_told([headers[i] for i in chosen]) if noisy else None,
                sizes=torch.tensor(own) if {*sizes} != {canvas} else None,
            )
        )
    train, test = views
    if config.background == "random_matched" and not train.has_alpha:
        expected = f"black, white or random: the images of {capture.root} have no alpha to composite with"
        raise ConfigError("dataset.background", config.background, expected)
    return train, test


def as_stored(photographs: Sequence[Photograph], source: Path) -> list[Photograph]:
    """Take pictures as they are stored where EXIF would turn them away from their cameras, with one warning.

    COLMAP and nerfstudio look at stored pixels.
    """

    def lies(photograph: Photograph) -> bool:
        header, camera = photograph.picture and photograph.picture.header, photograph.camera
        turned = header is not None and header.orientation > 4
        return turned and (header.width - header.height) * (camera.width - camera.height) < 0

    if paths := [each.path for each in photographs if lies(each)]:
        warning = f"{len(set(paths))} pictures are read as they are stored, without EXIF's rotation"
        warnings.warn(f"{min(paths)}: {warning}, as {source.name} has them", stacklevel=3)
    return [replace(each, picture=each.picture.as_stored()) if lies(each) else each for each in photographs]


def headers_of(photographs: Sequence[Photograph]) -> list[Header]:
    """Each photograph's header; a missing picture gets the size of the one with the shape nearest to its camera's."""
    known = [each.picture.header for each in photographs if each.picture]

    def like(camera: Intrinsics) -> Header:
        nearest = min(known, key=lambda header: abs(header.width * camera.height - header.height * camera.width))
        return Header(nearest.height, nearest.width, alpha=False)

    return [each.picture.header if each.picture else like(each.camera) for each in photographs]


def on_one_canvas(
    headers: Sequence[Header], config: PhotoConfig, source: Path
) -> tuple[PhotoConfig, list[tuple[int, int]], tuple[int, int]]:
    """Factor by which all pictures shrink (``width`` is the widest one's), their sizes then, and the canvas that holds
    each.

    One warning tells of several sizes.
    """
    given = {(header.width, header.height) for header in headers}
    if len(given) > 1:
        if config.width is not None:
            width, height = max(given)
            config.shrunk(height, width)
            config = replace(config, width=None, downscale=width / config.width)
        text = ", ".join(f"{width}x{height}" for width, height in sorted(given)[:4])
        what = f"pictures of {len(given)} sizes ({text}): they are put on one canvas, whose pixels outside them"
        warnings.warn(f"{source}: {what} do not count", stacklevel=3)
    sizes = [config.shrunk(header.height, header.width) for header in headers]
    return config, sizes, (max(height for height, _ in sizes), max(width for _, width in sizes))


def camera_of(photograph: Photograph, header: Header, source: Path) -> Intrinsics:
    """Intrinsics of a photograph, upright, see :meth:`~ctm_plugin.data.readers.lens.Intrinsics.of_picture`.

    Raises a DataError where EXIF turns the picture away from its camera.
    """
    path, camera, (height, width, *_) = photograph.path, photograph.camera, header
    turned = photograph.shown or (header.orientation > 4 and (width - height) * (camera.width - camera.height) > 0)
    if header.orientation != UPRIGHT_ORIENTATION and not turned:
        found = f"a picture that EXIF's orientation {header.orientation} turns to {width}x{height}"
        said = f"{camera.width:g}x{camera.height:g}, as {camera.where} of {source.name}"
        expected = f"{said}, beyond doubt: take the tag off, or find the cameras anew by ctm cameras"
        raise DataError(path, found, expected)
    return camera.of_picture(width, height, path, source)


def exposures_told(headers: Sequence[Header]) -> Float32[Tensor, " n"] | None:
    """The pictures' exposures ``[N]`` by their EXIF; NaN where EXIF does not give one, ``None`` where none does.

    Those of several cameras, whose own factors differ, are relative to the median of each camera's.
    """
    exposures = torch.tensor([math.nan if header.exposure is None else header.exposure for header in headers])
    cameras = [header.lens[:2] for header in headers]
    for camera in {*cameras} if len({*cameras}) > 1 else ():
        own = torch.tensor([each == camera for each in cameras])
        exposures[own] /= exposures[own].nanmedian()
    return None if exposures.isnan().all() else exposures


def develop_lit(
    photographs: Sequence[Photograph], config: PhotoConfig, sizes: Sequence[tuple[int, int]], canvas: tuple[int, int]
) -> UInt8[Tensor, "n h w 3"] | None:
    """Develop the lit references of test views, shrunk like their pictures, not dimmed; ``None`` without any.

    ``sizes`` are height and width of the shrunk pictures, else a DataError; ``canvas`` holds each, see
    :func:`~ctm_plugin.data.develop.develop`.
    """
    pictures = [photograph.lit for photograph in photographs if photograph.lit is not None]
    if not pictures:
        return None
    for picture, (height, width) in zip(pictures, sizes, strict=True):
        tall, wide = config.shrunk(*picture.header[:2])
        if (tall, wide) != (height, width):
            found = f"a lit reference that becomes {wide}x{tall} pixels"
            raise DataError(picture.path, found, f"{width}x{height} as the picture itself")
    names = [photograph.path.stem for photograph in photographs]
    lit = develop(pictures, names, replace(config, exposure=1.0), False, canvas)
    return lit[..., :3] if lit.dtype == torch.uint8 else to_8_bits(lit[..., :3])
