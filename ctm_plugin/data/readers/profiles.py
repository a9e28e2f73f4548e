"""Colour spaces of picture files other than sRGB: by ICC profile, by PNG's gAMA and cICP, or by HEIC's NCLX."""

from __future__ import annotations

from functools import lru_cache
from io import BytesIO
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image, ImageCms

from ctm_plugin.color.srgb import linear_to_srgb

PROFILE_TOLERANCE = 2
"""Largest difference from sRGB, in levels of 255, of a profile that counts as sRGB."""
SRGB_CICP = (1, 13)
"""cICP's numbers of sRGB's primaries and transfer."""
SRGB_NCLX = ((1, 2, 5, 6), (1, 2, 6, 13))
"""Numbers of primaries and of transfers in NCLX that pass for sRGB's."""


class Profile(NamedTuple):
    """An ICC profile.

    Attributes:
        mode: Pillow's mode of the pictures that it describes, RGB or L.
        to_srgb: LittleCMS's transform of such pictures.
        off, off_as_light: largest difference in levels of 255 from sRGB, and from linear light turned into sRGB.
    """

    mode: str
    to_srgb: ImageCms.ImageCmsTransform
    off: int
    off_as_light: int


@lru_cache(maxsize=16)
def read_profile(content: bytes) -> Profile | None:
    """Read an ICC profile; ``None``: the profile is damaged, or of neither RGB nor grey."""
    try:
        given = ImageCms.ImageCmsProfile(BytesIO(content))
        mode = {"RGB": "RGB", "GRAY": "L"}[given.profile.xcolor_space.strip()]
        to_srgb = ImageCms.buildTransform(given, ImageCms.createProfile("sRGB"), mode, "RGB")
    except (ImageCms.PyCMSError, OSError, KeyError, ImportError):
        return None
    codes = np.arange(0, 256, 15 if mode == "RGB" else 1, dtype=np.uint8)
    codes = np.stack(np.meshgrid(codes, codes, codes), -1).reshape(len(codes), -1, 3) if mode == "RGB" else codes[None]
    converted = np.asarray(ImageCms.applyTransform(Image.fromarray(codes), to_srgb)).astype(int)
    codes = codes if mode == "RGB" else codes[..., None]
    light = linear_to_srgb(torch.from_numpy(codes / 255)).numpy() * 255
    return Profile(mode, to_srgb, *(int(np.abs(converted - each).max().round()) for each in (codes, light)))


def as_srgb(pixels: UInt8[np.ndarray, "h w c"], content: bytes | None, grey: bool) -> UInt8[np.ndarray, "h w d"]:
    """Convert pixels of 8 bits out of a profile's colours; alpha, the last of two or four channels, stays.

    Pixels stay unchanged without a profile, with sRGB's, or with one that :func:`foreign` names.
    """
    profile = read_profile(content) if content else None
    if profile is None or profile.off <= PROFILE_TOLERANCE or (profile.mode == "L" and not grey):
        return pixels
    colour = Image.fromarray(np.ascontiguousarray(pixels[..., 0] if profile.mode == "L" else pixels[..., :3]))
    alpha = pixels[..., pixels.shape[-1] - 1 + pixels.shape[-1] % 2 :]
    return np.concatenate([np.asarray(ImageCms.applyTransform(colour, profile.to_srgb)), alpha], axis=-1)


def foreign(content: bytes | None, grey: bool, deep: bool, light: bool = False) -> str | None:
    """Name a profile whose colours are not converted; ``None``: there is none, or :func:`as_srgb` does.

    Pictures of more than 8 bits a channel, ``deep``, are not converted; ``light``: the picture is linear light.
    """
    if not content:
        return None
    profile = read_profile(content)
    if profile is None or (profile.mode == "L" and not grey):
        return "an ICC profile that cannot be used"
    off = profile.off_as_light if light else profile.off
    return "an ICC profile other than sRGB's, at more than 8 bits" if deep and off > PROFILE_TOLERANCE else None


def png_gamma(image: Image.Image) -> float | None:
    """Read a PNG's gamma, the power of light that it stores, from gAMA; ``None``: sRGB's, or gAMA does not count."""
    gamma = image.info.get("gamma")
    other = image.format != "PNG" or "icc_profile" in image.info or "srgb" in image.info
    return None if other or not gamma or abs(2.2 * gamma - 1) < 0.05 else gamma


def png_colours(image: Image.Image) -> str | None:
    """Name the colours by a PNG's cICP, which Pillow ignores; ``None``: sRGB, or no cICP."""
    if image.format != "PNG" or "icc_profile" in image.info:
        return None
    at = image.fp.tell()
    image.fp.seek(0)
    head = image.fp.read(image.tile[0][2])
    image.fp.seek(at)
    at = head.find(b"\0\0\0\4cICP") + 8
    cicp = tuple(head[at : at + 2])
    return None if at < 8 or cicp == SRGB_CICP else f"cICP's primaries {cicp[0]} and transfer {cicp[1]}"


def heif_colours(image: Image.Image) -> str | None:
    """Name the colours by a HEIC's NCLX; ``None``: sRGB or nearly, or there is a profile, which goes before it."""
    nclx = image.info.get("nclx_profile")
    if not nclx or image.info.get("icc_profile"):
        return None
    numbers = nclx["color_primaries"], nclx["transfer_characteristics"]
    usual = all(number in known for number, known in zip(numbers, SRGB_NCLX, strict=True))
    return None if usual else f"NCLX's primaries {numbers[0]:d} and transfer {numbers[1]:d}"
