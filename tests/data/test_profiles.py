"""Colours that a file says are not sRGB's: profiles written here by the ICC's format, beside matrices and curves."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import ExifTags, Image, ImageCms
from PIL.PngImagePlugin import PngInfo
from png import chunk, png_16

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.develop import develop
from ctm_plugin.data.readers.images import read_image, read_picture
from ctm_plugin.data.settings import PhotoConfig

SRGB = np.array([[0.4361, 0.3851, 0.1431], [0.2225, 0.7169, 0.0606], [0.0139, 0.0971, 0.7141]])
P3 = np.array([[0.5151, 0.2919, 0.1572], [0.2412, 0.6922, 0.0666], [-0.0011, 0.0419, 0.7841]])
"""XYZ of the primaries under D50, one a column."""
LEVELS = np.random.default_rng(0).integers(0, 256, (9, 7, 4), dtype=np.uint8)


def profile(primaries: np.ndarray | None, gamma: float) -> bytes:
    """An ICC profile, version 2, of light to this power; ``None``: of grey."""
    xyz = [(0.9642, 1.0, 0.8249), *(() if primaries is None else primaries.T)]
    names = [b"wtpt", b"rXYZ", b"gXYZ", b"bXYZ"][: len(xyz)]
    curve = b"curv" + bytes(4) + struct.pack(">IHxx", 1, round(gamma * 256))
    parts = [
        (n, b"XYZ " + bytes(4) + struct.pack(">3i", *(round(65536 * v) for v in each)))
        for n, each in zip(names, xyz, strict=True)
    ]
    parts += [(name, curve) for name in ((b"kTRC",) if primaries is None else (b"rTRC", b"gTRC", b"bTRC"))]
    table, body, at = struct.pack(">I", len(parts)), b"", 128 + 4 + 12 * len(parts)
    for name, part in parts:
        table += name + struct.pack(">II", at + len(body), len(part))
        body += part
    space = b"GRAY" if primaries is None else b"RGB "
    head = struct.pack(">I4xI", at + len(body), 0x02400000) + b"mntr" + space + b"XYZ " + bytes(12) + b"acsp"
    head += bytes(28) + struct.pack(">3i", *(round(65536 * v) for v in xyz[0]))
    return head.ljust(128, b"\0") + table + body


def expected(levels: np.ndarray, primaries: np.ndarray, gamma: float) -> np.ndarray:
    light = (levels / 255) ** gamma @ (np.linalg.inv(SRGB) @ primaries).T
    return linear_to_srgb(torch.from_numpy(light.clip(0, 1))).numpy()


LINEAR, WIDE = (SRGB, 1.0), (P3, 2.2)


@pytest.mark.parametrize("suffix", ["png", "webp", "tif"])
@pytest.mark.parametrize("colours", [LINEAR, WIDE], ids=["linear", "P3"])
@pytest.mark.parametrize("channels", [3, 4])
def test_profiles_become_srgb(tmp_path, suffix, colours, channels):
    path, levels = tmp_path / f"a.{suffix}", LEVELS[..., :channels]
    if suffix == "tif":
        extra = {"extrasamples": ["unassalpha"]} if channels == 4 else {}
        tifffile.imwrite(path, levels, photometric="rgb", iccprofile=profile(*colours), **extra)
    else:
        kind = {"lossless": True, "exact": True} if suffix == "webp" else {}
        Image.fromarray(levels).save(path, icc_profile=profile(*colours), **kind)
    found = read_image(path).numpy()
    assert np.abs(found[..., :3] - expected(levels[..., :3], *colours)).max() < 1.6 / 255
    np.testing.assert_array_equal(found[..., 3:] * np.float32(255), levels[..., 3:])
    assert read_picture(path).header.colours is None


def test_colours_of_a_heic_go_before_its_bits(tmp_path):
    pillow_heif = pytest.importorskip("pillow_heif")
    for name, colours, deep in (("wide", WIDE, False), ("usual", None, True)):
        picture = pillow_heif.from_bytes("RGB;16", LEVELS.shape[1::-1], (LEVELS.astype(np.uint16) << 8).tobytes())
        picture.save(tmp_path / f"{name}.heic", **({"icc_profile": profile(*colours)} if colours else {}))
        header = read_picture(tmp_path / f"{name}.heic").header
        assert (header.deep, header.colours) == (deep, None)


def test_grey_profiles(tmp_path):
    levels = LEVELS[..., 0]
    Image.fromarray(levels).save(tmp_path / "a.png", icc_profile=profile(None, 1.0))
    light = linear_to_srgb(torch.from_numpy(levels / 255))[..., None]
    assert (read_image(tmp_path / "a.png") - light).abs().max() < 4 / 255  # LittleCMS goes through a table


def test_srgb_by_name_or_by_its_curve_stays_to_the_bit(tmp_path):
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(LEVELS).save(tmp_path / "a.png", icc_profile=srgb)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png") * 255, LEVELS)


@pytest.mark.parametrize("gamma", [1.0, 0.55])
@pytest.mark.parametrize("bits", [8, 16])
def test_a_gamma_of_pngs(tmp_path, gamma, bits):
    content = struct.pack(">I", round(gamma * 1e5))
    if bits == 8:
        info = PngInfo()
        info.add(b"gAMA", content)
        Image.fromarray(LEVELS).save(tmp_path / "a.png", pnginfo=info)
    else:
        (tmp_path / "a.png").write_bytes(png_16(LEVELS.astype(np.uint16) * 257, chunk(b"gAMA", content)))
    found = read_image(tmp_path / "a.png")
    light = torch.from_numpy(LEVELS[..., :3] / 255) ** (1 / gamma)
    torch.testing.assert_close(found[..., :3], linear_to_srgb(light).float(), atol=1e-5, rtol=0)
    np.testing.assert_array_equal((found[..., 3] * 255).round(), LEVELS[..., 3])


@pytest.mark.parametrize("chunks", [{b"gAMA": struct.pack(">I", 45455)}, {b"cICP": bytes([1, 13, 0, 1])}])
def test_srgb_in_pngs_own_words(tmp_path, chunks):
    info = PngInfo()
    for name, content in chunks.items():
        info.add(name, content)
    Image.fromarray(LEVELS).save(tmp_path / "a.png", pnginfo=info)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png") * 255, LEVELS)
    assert read_picture(tmp_path / "a.png").header.colours is None


def deep(path: Path) -> None:
    (path).write_bytes(png_16(LEVELS.astype(np.uint16), chunk(b"iCCP", b"a\0\0" + zlib.compress(profile(*WIDE)))))


def hdr(path: Path) -> None:
    info = PngInfo()
    info.add(b"cICP", bytes([9, 16, 0, 1]))
    Image.fromarray(LEVELS).save(path, pnginfo=info)


def adobe(path: Path) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 1  # Pillow writes none into a PNG that has but the other tags
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.IFD.Interop] = {ExifTags.Interop.InteropIndex: "R03"}
    Image.fromarray(LEVELS).save(path, exif=exif)


def damaged(path: Path) -> None:
    Image.fromarray(LEVELS).save(path, icc_profile=profile(*WIDE)[:150])


@pytest.mark.parametrize(
    ("write", "found"),
    [
        (deep, "an ICC profile other than sRGB's, at more than 8 bits"),
        (hdr, "cICP's primaries 9 and transfer 16"),
        (damaged, "an ICC profile that cannot be used"),
        (adobe, "Adobe RGB by its EXIF"),
    ],
)
def test_what_is_not_converted_is_told_once(tmp_path, write, found):
    paths = [tmp_path / f"{name}.png" for name in "abc"]
    for path in paths:
        write(path)
    with pytest.warns(UserWarning, match=rf"pictures have {found}, which is not applied: turn them into sRGB") as seen:
        develop([read_picture(path) for path in paths], ["a", "b", "c"], PhotoConfig(), noisy=False, canvas=(9, 7))
    assert len(seen) == 1


def test_floats_of_srgb_s_primaries_are_light(tmp_path):
    light = LEVELS[..., :3].astype(np.float32) / 255
    for name, colours in (("a", LINEAR), ("b", (P3, 1.0))):
        tifffile.imwrite(tmp_path / f"{name}.tif", light, photometric="rgb", iccprofile=profile(*colours))
    first, second = (read_picture(tmp_path / name).header for name in ("a.tif", "b.tif"))
    assert first.colours is None
    assert second.colours == "an ICC profile other than sRGB's, at more than 8 bits"


def test_pillow_before_13_raises_where_exif_lacks_a_part(tmp_path, monkeypatch):
    whole = Image.Exif.get_ifd

    def get_ifd(exif, tag):
        if tag == ExifTags.IFD.Interop:
            raise KeyError(tag)
        return whole(exif, tag)

    monkeypatch.setattr(Image.Exif, "get_ifd", get_ifd)
    Image.fromarray(LEVELS).save(tmp_path / "a.png")
    torch.testing.assert_close(read_image(tmp_path / "a.png"), torch.from_numpy(LEVELS / np.float32(255)))
