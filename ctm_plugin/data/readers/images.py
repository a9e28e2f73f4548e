"""Picture files by suffix: format and size checks, headers, and pixels decoded on demand."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8, UInt16
from PIL import ExifTags, Image
from torch import Tensor

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.readers.deep import colored, numbers, open_deep, opened_file
from ctm_plugin.data.readers.folders import (
    LFS_POINTER,
    PHONE_SUFFIXES,
    as_data_error,
    check_head,
    others_hint,
    require_file,
    state_of,
)
from ctm_plugin.data.readers.picture import (
    MAX_PIXELS,
    UPRIGHT_ORIENTATION,
    Decoder,
    Header,
    Opened,
    check_size,
    exposure_of,
    lens_of,
    turn,
    upright_header,
)
from ctm_plugin.data.readers.profiles import as_srgb, foreign, heif_colours, png_colours, png_gamma
from ctm_plugin.errors import CTMError, DataError
from ctm_plugin.scene.views import Pixels, unit

PILLOW_FORMATS = ("PNG", "JPEG", "WEBP", "AVIF")
"""Formats that Pillow decodes here."""
FOREIGN_SIGNATURES = {
    b"GIF8": "GIF", b"BM": "BMP", b"P5": "PGM", b"P6": "PPM", b"II*\0": "TIFF", b"MM\0*": "TIFF"
}  # fmt: skip
"""First bytes of formats that are not read under such a suffix."""
AVIF_BRANDS = (b"avif", b"avis")
"""Brands of an ``ftyp`` box that Pillow reads without a plug-in."""
GREY_MODES = ("1", "L", "LA", "I;16", "I")
"""Pillow's modes without colour."""


warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)  # the limit is ours


@contextmanager
def opened(path: Path) -> Iterator[Image.Image]:
    """Context with Pillow's picture of a file, not yet decoded; DataError: it is no ``PILLOW_FORMATS`` or HEIC."""
    expected = f"a whole image ({', '.join(PILLOW_FORMATS)}, HEIC) of at most {MAX_PIXELS} pixels"
    require_file(path, expected)
    expected_whole = f"{expected}: copy it here again, or leave it out"
    with as_data_error(path, "an image that cannot be read", expected_whole), path.open("rb") as file:
        head = file.read(len(LFS_POINTER))
        file.seek(0)
        heif = head[4:8] == b"ftyp" and head[8:12] not in AVIF_BRANDS
        try:
            image = Image.open(file, formats=(*PILLOW_FORMATS, *heif_formats()) if heif else PILLOW_FORMATS)
        except Image.UnidentifiedImageError as error:
            if head[4:8] == b"ftyp":
                raise OSError("damaged, or of no kind that is known") from error
            check_head(path, head, expected)
            kind = next((kind for start, kind in FOREIGN_SIGNATURES.items() if head.startswith(start)), None)
            found = f"a picture of {kind}'s kind" if kind else "something that is not an image"
            raise DataError(path, found, f"{expected}; {others_hint([path])}") from error
        with image:
            check_size(path, *image.size, expected)
            yield image


def heif_formats() -> tuple[str, ...]:
    """Register pillow-heif with Pillow, and name the formats that it opens: HEIC and others, upright.

    Raises a CTMError that names the extra where it is not installed.
    """
    try:
        from pillow_heif import register_heif_opener
    except ImportError as error:
        raise CTMError(f"reading HEIC needs pillow-heif: pip install -e '.[photos]' ({error})") from error
    register_heif_opener()
    return ("HEIF",)


def deep_heic(path: Path) -> UInt16[np.ndarray, "h w c"]:
    """The upright pixels of a HEIC of more than 8 bits, in the upper ones of 16."""
    from pillow_heif import open_heif

    pixels = np.asarray(open_heif(path, convert_hdr_to_8bit=False))
    return colored(pixels.reshape(*pixels.shape[:2], -1))


def is_adobe_rgb(exif: Image.Exif) -> bool:
    """Whether EXIF says that a picture's colours are Adobe RGB."""
    with suppress(KeyError):  # Pillow before 13, where there is no such part
        return exif.get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex) == "R03"
    return False


@contextmanager
def open_usual(path: Path) -> Iterator[Opened]:
    """Open a PNG, JPEG, WebP, AVIF or HEIC. Grey becomes colour, palettes are looked up, 10 to 16 bits are kept.

    ICC profiles (of 8 bits) and PNG's gAMA are converted to sRGB; the header names other colours.
    """
    with opened(path) as image:
        # A PNG's own getexif would decode the whole picture.
        exif = Image.Image.getexif(image)
        orientation = exif.get(ExifTags.Base.Orientation, UPRIGHT_ORIENTATION)
        grey, profile = image.mode in GREY_MODES, image.info.get("icc_profile")
        # Of more than 8 bits Pillow unpacks only the upper ones. Those of a profile that is converted go without.
        of_heic = image.info.get("bit_depth", 8) > 8 and foreign(profile, grey, True) is None
        deep = of_heic or (image.format == "PNG" and image.tile[0][3].endswith("16B"))
        colours = foreign(profile, grey, deep) or png_colours(image) or heif_colours(image)
        if not profile and is_adobe_rgb(exif):
            colours = "Adobe RGB by its EXIF"
        header = upright_header(image.height, image.width, image.has_transparency_data, deep, orientation)
        camera_tags = exif.get_ifd(ExifTags.IFD.Exif)
        header = header._replace(exposure=exposure_of(camera_tags), colours=colours, lens=lens_of(exif, camera_tags))

        def pixels() -> Tensor:
            gamma = None if colours else png_gamma(image)
            if of_heic:
                stored = deep_heic(path)
            elif deep:
                with opened_file(path) as file:
                    stored = colored(numbers(file))
            else:
                stored = as_srgb(np.array(image.convert("RGBA" if header.alpha else "RGB")), profile, grey)
            if stored.dtype == np.uint8 and gamma is None:
                return torch.from_numpy(stored)
            levels = float(np.iinfo(stored.dtype).max)
            picture = torch.from_numpy(stored.astype(np.float32)).div_(levels)
            if gamma is not None:
                picture[..., :3] = linear_to_srgb(picture[..., :3] ** (1 / gamma))
            return picture

        yield Opened(header, pixels)


DECODERS: dict[str, Decoder] = {
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".webp", *PHONE_SUFFIXES), open_usual),
    **dict.fromkeys((".tif", ".tiff", ".exr"), open_deep),
}
"""Decoder of a picture by its file's suffix; other suffixes get PNG's decoder."""


def open_picture(path: Path) -> AbstractContextManager[Opened]:
    """Open a picture by the one of :data:`DECODERS` for its suffix."""
    return DECODERS.get(path.suffix.lower(), open_usual)(path)


@dataclass(frozen=True)
class PictureFile:
    """A picture's file: the header is read, pixels are decoded when asked for.

    Attributes:
        path: the file.
        header: its size, depth, orientation and other metadata.
        decode: the decoder that opens it.
    """

    path: Path
    header: Header
    decode: Decoder = open_picture

    def as_stored(self) -> PictureFile:
        """The same picture file, read without EXIF's rotation."""
        return replace(self, header=self.header.as_stored())

    def image(self) -> Float32[Tensor, "h w c"]:
        """Decode the pixels ``[H, W, C]``, upright by EXIF; C = 4 with straight alpha where the file has it, else 3.

        In [0, 1], but for float TIFF and EXR, whose linear light may be more.
        """
        return unit(self.pixels())

    def pixels(self) -> Pixels:
        """Decode the pixels as :meth:`image` does, but leave 8 bits, a quarter of the memory, as they are."""
        with self.decode(self.path) as (_, pixels):
            return upright(pixels(), self.header)


def read_picture(path: Path, decode: Decoder = open_picture) -> PictureFile:
    """Read a picture's header, without decoding it; cached until the file changes."""
    return _read(path, decode, state_of(path))


@lru_cache(maxsize=4096)
def _read(path: Path, decode: Decoder, _state: tuple[int, int] | None) -> PictureFile:
    with decode(path) as (header, _):
        return PictureFile(path, header, decode)


def read_image(path: Path, decode: Decoder = open_picture) -> Float32[Tensor, "h w c"]:
    """Read a picture's pixels, see :meth:`PictureFile.image`."""
    with decode(path) as (header, pixels):
        return unit(upright(pixels(), header))


def upright(pixels: Pixels, header: Header) -> Tensor:
    """Turn stored pixels ``[H, W, C]`` as their header says: ``[H, W, C]``, or ``[W, H, C]``."""
    return torch.from_numpy(np.ascontiguousarray(turn(pixels.numpy(), header.orientation)))


def read_depth(path: Path, scale: float) -> Float32[Tensor, "h w"]:
    """Read depth ``[H, W]``, times ``scale``, NaN where nothing was hit: 16-bit grey, 0 for nothing, or a ``.npy``.

    Raises a DataError for other kinds and shapes, and for distances <= 0 or infinite."""
    if path.suffix != ".npy":
        with opened(path) as image:
            if not image.mode.startswith("I"):
                raise DataError(path, f"a picture of kind {image.mode}", "depth as 16-bit grey")
            code = torch.from_numpy(np.asarray(image).astype(np.float32))
        return torch.where(code == 0, torch.nan, code * scale)
    expected = "an array [H, W] of floats > 0, NaN for nothing"
    array = map_numbers(path, expected)
    if array.ndim != 2:
        raise DataError(path, f"an array {list(array.shape)}", expected)
    array = np.array(array, dtype=np.float32)
    if np.isinf(array).any() or (array <= 0).any():
        raise DataError(path, "a distance that is not > 0 or is infinite", expected)
    return torch.from_numpy(array * np.float32(scale))


def map_numbers(path: Path, expected: str) -> np.ndarray:
    """Memory-map an array ``[...]`` of floats in a ``.npy``, else raise a DataError.

    The file's length bounds what its header may claim.
    """
    require_file(path, expected)
    with as_data_error(path, "no array that can be read", expected):
        array = np.lib.format.open_memmap(path, mode="r")
    if array.dtype.kind != "f":
        raise DataError(path, f"an array of {array.dtype}, {list(array.shape)}", expected)
    return array


def to_8_bits(image: Float32[Tensor, "*shape c"]) -> UInt8[Tensor, "*shape c"]:
    """Round a picture to 8 bits, ``round(255 c)``; colour is 0 where the rounded alpha is 0."""
    levels = (image * 255.0).round().clamp(0, 255).to(torch.uint8)
    if levels.shape[-1] == 4:
        levels[levels[..., 3] == 0] = 0
    return levels
