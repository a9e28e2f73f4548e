"""Photographs with a camera each, as the layouts of real captures list them, made into a scene."""

from __future__ import annotations

import glob
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath, PurePosixPath

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Shaped, UInt8
from torch import Tensor

from ctm_plugin.data.config import CaptureConfig, PhotoConfig, check_matched_background
from ctm_plugin.data.develop import develop, develop_masks
from ctm_plugin.data.readers.folders import (
    IMAGE_SUFFIXES,
    RAW_HINT,
    fold,
    folded,
    inside,
    is_picture,
    look_for,
    others_hint,
    plain_name,
    view_names,
)
from ctm_plugin.data.readers.images import PICTURES, to_8_bits
from ctm_plugin.data.readers.lens import PINHOLE, Camera, check_lens
from ctm_plugin.data.readers.picture import UPRIGHT, Header, Reader, as_stored
from ctm_plugin.errors import DataError
from ctm_plugin.scene.views import Views

FEWEST = 3
"""Photographs of a scene, at least."""
MASKS = ("mask", "image_masks", "images_mask", "images_masks")
"""What others call the folder ``masks``."""


@dataclass(frozen=True)
class Photograph:
    """A picture and how it was taken.

    Attributes:
        path: the picture's file.
        c2w: ``[3, 4]`` camera to world, OpenGL axes.
        camera: what took it.
        mask: the picture of which pixels count, bright ones do; ``None``: all.
        pictured: whether the file is there; of a test view it need not be.
        lit: the same view in normal light, only for test views.
        shown: whether the camera is known to be of the picture as EXIF turns it.
    """

    path: Path
    c2w: Float64[np.ndarray, "3 4"]
    camera: Camera
    mask: Path | None = None
    pictured: bool = True
    lit: Path | None = None
    shown: bool = False


@dataclass(frozen=True)
class Pictures:
    """Where a data set's pictures lie.

    Attributes:
        folder: with the pictures.
        shrunk: whether they have been shrunk by ``dataset.downscale`` already.
        reader: of their files.
    """

    folder: Path
    shrunk: bool
    reader: Reader = PICTURES

    def listing(self, root: Path) -> list[Path]:
        """The pictures in the order of their names.

        Raises:
            DataError: there are none, or one lies outside the data set's folder ``root``.
        """
        names = sorted(path.name for path in self.folder.iterdir() if is_picture(path))
        if not names:
            there = sorted(self.folder.iterdir())
            raw = any(path.suffix.lower() == ".dng" for path in there)
            expected = f"files ending in {', '.join(IMAGE_SUFFIXES)}; {RAW_HINT if raw else others_hint(there)}"
            raise DataError(self.folder, "no pictures", expected)
        return [inside(root, f"{self.folder.name}/{name}") for name in names]


def first_of(pictures: Pictures, config: PhotoConfig) -> tuple[tuple[int, int], bool]:
    """Height and width of the first picture once it has shrunk, and whether it has alpha.

    Raises:
        DataError: there is none, or it cannot be read.
    """
    path = next((path for path in sorted(pictures.folder.rglob("*")) if is_picture(path)), None)
    header = pictures.reader.header(path or pictures.folder)
    size = header[:2] if pictures.shrunk else config.shrunk(header.height, header.width)
    return size, header.alpha


def find_pictures(root: Path, whole_factor: int, factor: int | None = None) -> Pictures:
    """The folder ``images_<whole_factor>`` where it is there, else ``images``; with ``factor`` ``images_<factor>``.

    Raises:
        DataError: it is not there; the message says which are.
    """
    if factor is None and has_shrunk(root, whole_factor):
        return Pictures(root / f"images_{whole_factor}", shrunk=True)
    chosen = root / (f"images_{factor}" if factor and factor > 1 else "images")
    if not chosen.is_dir():
        there = sorted(path.name for path in root.glob("images*") if path.is_dir())
        if factor is None and whole_factor == 1 and len(there) == 1:
            return Pictures(root / there[0], shrunk=False)
        found = f"only {', '.join(there)}" if there else "no folder of pictures"
        wanted = "images, or dataset.downscale=N for images_N that is there"
        raise DataError(root, found, wanted if factor is None else f"{chosen.name} (dataset.factor={factor})")
    return Pictures(chosen, shrunk=False)


def has_shrunk(root: Path, whole_factor: int) -> bool:
    """Whether ``images_<whole_factor>`` holds the pictures; not with fewer than ``images``, which a warning tells."""
    ready, whole = root / f"images_{whole_factor}", root / "images"
    if whole_factor == 1 or not ready.is_dir():
        return False
    found, wanted = (sum(map(is_picture, each.rglob("*"))) for each in (ready, whole))
    if found < wanted:
        warnings.warn(f"{ready} holds {found} of {wanted} pictures: {whole} is taken and shrunk", stacklevel=2)
    return found >= wanted


def masks_beside(root: Path, names: Sequence[PurePath]) -> list[Path | None]:
    """Masks of pictures: ``masks/NAME.EXT.png``, COLMAP's, ``NAME.png`` or ``NAME_mask.png``, in any case, of any kind.

    Args:
        root: the data set's folder.
        names: of the pictures in their own folder; those without a mask count whole, with one warning.

    Raises:
        DataError: ``masks`` is there, with none of these.
    """
    folder = folded(root).get("masks")
    if folder is None or not folder.is_dir():
        for other in (folded(root).get(name) for name in MASKS):
            if other is not None and other.is_dir():
                warnings.warn(f"{other}: not looked at; masks are to lie in {root / 'masks'}", stacklevel=2)
        return [None] * len(names)
    there = sorted(path.relative_to(folder) for path in folder.rglob("*") if is_picture(path))
    stems = {fold(str(path.with_suffix(""))): folder / path for path in there}

    def mask(name: PurePath) -> Path | None:
        stem = name.with_suffix("")
        return next((stems[key] for each in (name, stem, f"{stem}_mask") if (key := fold(str(each))) in stems), None)

    masks = [mask(name) for name in names]
    missing = [name.name for name, path in zip(names, masks, strict=True) if path is None]
    if len(missing) == len(names):
        lies = f"; {', '.join(map(str, there[:3]))} lie there" if there else ""
        expected = f"{missing[0]}.png and so on, or no folder masks"
        raise DataError(folder, f"no mask of any picture{lies}", expected)
    if missing:
        told = f"all pixels count of {len(missing)} of {len(names)} pictures, which have no mask, such as {missing[0]}"
        warnings.warn(f"{folder}: {told}", stacklevel=2)
    return masks


def find_listed(root: Path, name: str, source: Path) -> Path | None:
    """The picture that ``source`` calls ``name``, also with another suffix; ``None`` where there is none.

    One of a kind that is read here goes before one of another, such as ``a.jpg`` before ``a.HEIC``.

    Raises:
        DataError: it lies outside ``root``, or is a DNG.
    """
    path = PurePosixPath(plain_name(name))
    found = look_for(root, name, source)
    if found is None or found.suffix.lower() not in IMAGE_SUFFIXES:
        developed = look_for(root, str(path.parent / path.stem), source)
        if found is not None and developed is None and found.suffix.lower() == ".dng":
            raise DataError(found, "a raw picture", f"a developed one: {RAW_HINT}")
        return developed or found
    return found


def existing(root: Path, found: Sequence[Path | None], names: Sequence[str], source: Path) -> list[int]:
    """Numbers of the pictures that are there; one warning counts the others.

    Args:
        root: the data set's folder.
        found: the files, ``None`` for the missing.
        names: as ``source`` calls them.

    Raises:
        DataError: fewer than ``FEWEST`` are left.
    """
    missing = [name for path, name in zip(found, names, strict=True) if path is None]
    left = len(names) - len(missing)
    if left < FEWEST:
        what, expected = f"{left} pictures", f"at least {FEWEST} whose files exist"
        if missing:
            what += f"; {len(missing)} that it lists are missing, such as {missing[0]!r}"
            path = PurePosixPath(plain_name(missing[0]))
            homes = sorted(each.parent.name for each in root.glob(f"*/{glob.escape(path.stem)}.*"))
            if any(root.glob(f"{glob.escape(path.stem)}.*")):
                expected += f": {path.name} lies next to {source.name}, not in {path.parent}"
            expected += f": {path.name} lies in {' and '.join(homes)}" if homes else ""
            if homes and path.parts[0] == "images" and homes[0].startswith("images_"):
                expected += f", which is dataset.downscale={homes[0].removeprefix('images_')}"
        raise DataError(source, what, expected)
    if missing:
        message = f"{source}: {len(missing)} of {len(names)} pictures are missing and left out, such as {missing[0]!r}"
        warnings.warn(message, stacklevel=2)
    return [number for number, path in enumerate(found) if path is not None]


def every(step: int, count: int) -> np.ndarray:
    """``[count]`` booleans, true for each number divisible by ``step``."""
    return np.arange(count) % step == 0


def unturned(
    photographs: Sequence[Photograph], headers: Sequence[Header | None], reader: Reader, source: Path
) -> Reader:
    """The reader that takes pictures as they are stored where EXIF would turn them away from their cameras.

    COLMAP and nerfstudio look at stored pixels. One warning tells of such pictures.
    """
    paths = {
        photograph.path
        for photograph, header in zip(photographs, headers, strict=True)
        if header is not None
        and header.orientation > 4
        and (header.width - header.height) * (photograph.camera.width - photograph.camera.height) < 0
    }
    if paths:
        told = f"{len(paths)} pictures are read as they are stored, without EXIF's rotation"
        warnings.warn(f"{min(paths)}: {told}, as {source.name} has them", stacklevel=3)
    return as_stored(reader, paths)


def on_one_canvas(
    headers: Sequence[Header], config: PhotoConfig, source: Path
) -> tuple[PhotoConfig, list[tuple[int, int]], tuple[int, int]]:
    """How pictures shrink, by one factor for all (``width`` is the widest one's), to what, and what holds each of them.

    One warning tells of several sizes.

    Returns:
        Settings; height and width of each picture once it has shrunk; and those of what they lie on.

    Raises:
        ConfigError: ``downscale`` or ``width`` do not suit the sizes.
    """
    given = {(header.width, header.height) for header in headers}
    if len(given) > 1:
        if config.width is not None:
            width, height = max(given)
            config.shrunk(height, width)
            config = replace(config, width=None, downscale=width / config.width)
        told = ", ".join(f"{width}x{height}" for width, height in sorted(given)[:4])
        what = f"pictures of {len(given)} sizes ({told}): they are put on one canvas, whose pixels outside them"
        warnings.warn(f"{source}: {what} do not count", stacklevel=3)
    sizes = [config.shrunk(header.height, header.width) for header in headers]
    return config, sizes, (max(height for height, _ in sizes), max(width for _, width in sizes))


def camera_of(photograph: Photograph, header: Header, source: Path, crop: tuple[int, ...] | None) -> Camera:
    """The camera of a photograph's file as it is shown, see :meth:`~ctm_plugin.data.readers.lens.Camera.of_picture`.

    Raises:
        DataError: it does not fit the file; or EXIF turns the file, and its size does not tell whether the camera is
            of the picture as shown or as stored.
    """
    path, camera, (height, width, *_) = photograph.path, photograph.camera, header
    told = photograph.shown or (header.orientation > 4 and (width - height) * (camera.width - camera.height) > 0)
    if header.orientation != UPRIGHT and not told:
        found = f"a picture that EXIF's orientation {header.orientation} turns to {width}x{height}"
        said = f"{camera.width:g}x{camera.height:g}, as {camera.where} of {source.name}"
        expected = f"{said}, beyond doubt: take the tag off, or find the cameras anew by ctm cameras"
        raise DataError(path, found, expected)
    return camera.of_picture(width, height, path, source, crop)


def develop_photographs(
    photographs: Sequence[Photograph], testing: np.ndarray, pictures: Pictures, config: CaptureConfig, source: Path
) -> tuple[Views, Views]:
    """Training views, thinned by ``config.skip``, and test views.

    Args:
        photographs: in the order of the data set.
        testing: ``[N]`` booleans, whether one is for testing.
        pictures: where they come from.
        config: what to do with them.
        source: the file with their cameras, for messages.

    Raises:
        DataError: a picture or a mask cannot be read or has another size than its camera's, a lens folds, or a split
            is empty.
        ConfigError: ``downscale`` or ``width`` do not suit the size, or ``random_matched`` lacks alpha.
    """
    there = np.array([photograph.pictured for photograph in photographs])
    known = [pictures.reader.header(each.path) if each.pictured else None for each in photographs]
    reader = unturned(photographs, known, pictures.reader, source)
    headers = known
    if reader is not pictures.reader:
        headers = [reader.header(each.path) if each.pictured else None for each in photographs]
    headers = [header or alike(each.camera, headers) for each, header in zip(photographs, headers, strict=True)]
    photo = replace(config, downscale=1) if pictures.shrunk else config
    cameras = [
        camera_of(photograph, header, source, config.crop)
        for photograph, header in zip(photographs, headers, strict=True)
    ]
    photo, sizes, canvas = on_one_canvas(headers, photo, source)
    for camera in dict.fromkeys(cameras):
        if camera.distortion != PINHOLE:
            check_lens(camera.distortion, camera.pinhole, camera.height, camera.width, source, camera.where)
    distorted = any(camera.distortion != PINHOLE for camera in cameras)
    names = np.array(view_names([photograph.path for photograph in photographs]))
    views = []
    for chosen, noisy in ((config.trained_on(testing), True), (np.flatnonzero(testing), False)):
        if not len(chosen):
            found = f"no pictures for {'training' if noisy else 'testing'}"
            raise DataError(source, found, f"at least one for training and one for testing of {len(photographs)}")
        seen = chosen[there[chosen]]
        images = views[0].images[:0] if views else torch.empty(0)
        if len(seen):
            paths = [photographs[i].path for i in seen]
            images = develop(paths, names[seen].tolist(), photo, noisy, reader, canvas)
        own, taken = [sizes[i] for i in chosen], [photographs[i] for i in chosen]
        lenses = torch.tensor([cameras[i].distortion for i in chosen]) if distorted else None
        views.append(
            Views(
                images=with_blanks(images, torch.from_numpy(there[chosen])),
                c2w=torch.from_numpy(np.stack([each.c2w for each in taken])).to(torch.float32),
                intrinsics=torch.tensor([cameras[i].scaled(*sizes[i][::-1]).pinhole for i in chosen]),
                names=tuple(names[chosen].tolist()),
                distortion=lenses,
                mask=develop_masks([each.mask for each in taken], own, canvas),
                pictured=None if there[chosen].all() else torch.from_numpy(there[chosen]),
                lit=None if noisy else develop_lit(taken, photo, pictures.reader, own, canvas),
                exposures=exposures_told([headers[i] for i in chosen]) if noisy else None,
            )
        )
    train, test = views
    check_matched_background(config, train, source.parent)
    return train, test


def alike(camera: Camera, headers: Sequence[Header | None]) -> Header:
    """The header of the picture whose sides are most like a camera's: the size of one that is not there."""
    known = [header for header in headers if header is not None]
    header = min(known, key=lambda each: abs(each.width * camera.height - each.height * camera.width))
    return Header(header.height, header.width, alpha=False)


def exposures_told(headers: Sequence[Header]) -> Float32[Tensor, " n"] | None:
    """The light that training pictures took by their EXIF; NaN where EXIF does not tell.

    Returns:
        ``[N]``; ``None`` where it tells of none.
    """
    told = torch.tensor([math.nan if header.exposure is None else header.exposure for header in headers])
    return None if told.isnan().all() else told


def with_blanks(images: Shaped[Tensor, "p h w c"], there: Bool[Tensor, " n"]) -> Shaped[Tensor, "n h w c"]:
    """Put black pictures, without any alpha, in the place of those that are not there."""
    if there.all():
        return images
    whole = images.new_zeros(len(there), *images.shape[1:])
    whole[there] = images
    return whole


def develop_lit(
    photographs: Sequence[Photograph],
    config: PhotoConfig,
    reader: Reader,
    sizes: Sequence[tuple[int, int]],
    canvas: tuple[int, int],
) -> UInt8[Tensor, "n h w 3"] | None:
    """Develop the lit references of test views, shrunk as their pictures and else as they are; ``None`` without any.

    Raises:
        DataError: one cannot be read or has another size than its picture.
    """
    paths = [photograph.lit for photograph in photographs if photograph.lit is not None]
    if not paths:
        return None
    names = [photograph.path.stem for photograph in photographs]
    shrunk = [config.shrunk(*reader.header(path)[:2]) for path in paths]
    for path, found, (height, width) in zip(paths, shrunk, sizes, strict=True):
        if found != (height, width):
            expected = f"{width}x{height} as the picture itself"
            raise DataError(path, f"a lit reference that becomes {found[1]}x{found[0]} pixels", expected)
    lit = develop(paths, names, replace(config, exposure=1.0), noisy=False, reader=reader, canvas=canvas)
    return lit[..., :3] if lit.dtype == torch.uint8 else to_8_bits(lit[..., :3])
