"""Pictures of every suffix, depth and alpha: what is written is read, turned as EXIF says; the rest is refused."""

import itertools
import struct
import sys

import numpy as np
import pytest
import tifffile
import torch
from PIL import ExifTags, Image, ImageOps
from PIL.TiffImagePlugin import IFDRational
from png import chunk, png, png_16

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.readers.deep import write_tiff
from ctm_plugin.data.readers.images import heif_formats, opened, read_depth, read_image, read_picture, to_8_bits
from ctm_plugin.data.readers.picture import MAX_PIXELS, Header, Lens, exposure_of
from ctm_plugin.errors import CTMError, DataError

OpenEXR, pillow_heif = pytest.importorskip("OpenEXR"), pytest.importorskip("pillow_heif")
heif_formats()
RNG = np.random.default_rng(0)
ORIENTATION = ExifTags.Base.Orientation


def exr(path, channels, **header):
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File({**kind, **header}, channels).write(str(path))


def tiff(path, array, **more):
    tifffile.imwrite(path, array, **{"photometric": "rgb", "metadata": None, **more})


def write(path, code, alpha="unassalpha"):
    """``[H, W, C]`` of any type that files of this suffix hold; EXR's alpha is multiplied in."""
    channels = code.shape[-1]
    if path.suffix == ".exr":
        exr(path, {"RGBA"[:channels]: code})
    elif path.suffix == ".tif":
        extra = {"extrasamples": [alpha]} if channels in (2, 4) else {}
        tiff(path, code.squeeze(), photometric="rgb" if channels > 2 else "minisblack", **extra)
    elif code.dtype == np.uint16:
        path.write_bytes(png_16(code))
    else:
        Image.fromarray(code.squeeze(), mode={1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}[channels]).save(
            path, **({"lossless": True, "exact": True} if path.suffix == ".webp" else {})
        )


@pytest.mark.parametrize(
    ("suffix", "dtype", "channels"),
    [
        *itertools.product(("png", "tif"), ("u1", "u2"), (1, 2, 3, 4)),
        *itertools.product(["webp"], ["u1"], (3, 4)),
        *itertools.product(["tif"], ("f2", "f4", "f8"), (3, 4)),
        *itertools.product(["exr"], ("f2", "f4"), [3]),
    ],
)
def test_what_is_written_is_read(tmp_path, suffix, dtype, channels):
    """Whole numbers as sRGB, all of their bits; floats as linear light, which may be more than 1."""
    path, kind = tmp_path / f"a.{suffix}", np.dtype(dtype).kind
    code = RNG.random((11, 7, channels)) * [*[3] * 3, 1][-channels:]
    top = 1 if kind == "f" else np.iinfo(dtype).max
    code = (code if kind == "f" else code / 3 * top).astype(dtype)
    write(path, code)
    assert read_picture(path).header == Header(11, 7, channels in (2, 4), deep=dtype != "u1")
    expected = code if channels > 2 else code[..., [0, 0, 0, *range(1, channels)]]
    expected = torch.from_numpy(expected.astype(np.float32) / top)
    if kind == "f":
        expected = torch.cat([linear_to_srgb(expected[..., :3]), expected[..., 3:]], -1)
    torch.testing.assert_close(read_image(path), expected, atol=1e-7, rtol=1e-6)
    if suffix in ("png", "webp"):
        assert read_picture(path).pixels().dtype == (torch.uint8 if dtype == "u1" else torch.float32)


@pytest.mark.parametrize("suffix", ["tif", "exr"])
def test_multiplied_alpha_becomes_straight(tmp_path, suffix):
    path, light = tmp_path / f"a.{suffix}", np.array([[[0.1, 0.2, 0.4, 0.5], [0.3, 0, 0, 0]]], np.float32)
    write(path, light, "assocalpha")
    expected = torch.cat([linear_to_srgb(torch.tensor([[0.2, 0.4, 0.8]])), torch.tensor([[0.5]])], 1)
    torch.testing.assert_close(read_image(path)[0], torch.cat([expected, torch.zeros(1, 4)]))


@pytest.mark.parametrize("mode", ["P", "1"])
def test_looked_up_colours(tmp_path, mode):
    image = Image.fromarray(RNG.integers(0, 256, (6, 5, 3), dtype=np.uint8)).convert(mode)
    image.save(tmp_path / "a.png")
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), np.asarray(image.convert("RGB")) / 255, atol=1e-7)


def test_a_palette_with_transparency(tmp_path):
    image = Image.fromarray(np.array([[0, 1]], dtype=np.uint8), mode="P")
    image.putpalette([10, 20, 30, 40, 50, 60])
    image.save(tmp_path / "a.png", transparency=0)
    assert to_8_bits(read_image(tmp_path / "a.png")).tolist() == [[[0, 0, 0, 0], [40, 50, 60, 255]]]


@pytest.mark.parametrize("channels", [1, 3])
def test_a_transparent_colour_of_16_bits(tmp_path, channels):
    code = RNG.integers(0, 2**16, (3, 4, channels), dtype=np.uint16)
    code[2, 1] = code[0, 0] ^ 1  # differs in the lower byte alone
    (tmp_path / "a.png").write_bytes(png_16(code, chunk(b"tRNS", code[0, 0].astype(">u2").tobytes())))
    image = read_image(tmp_path / "a.png")
    assert image.shape == (3, 4, 4)
    assert (image[..., 3] == 0).nonzero().tolist() == [[0, 0]]


def test_interlaced_16_bits(tmp_path):
    """One pixel is Adam7's first pass alone."""
    header = struct.pack(">IIBBBBB", 1, 1, 16, 2, 0, 0, 1)
    plain = png(1, 1, 16, 2, bytes([0, 1, 2, 3, 4, 5, 6]))
    (tmp_path / "a.png").write_bytes(plain[:8] + chunk(b"IHDR", header) + plain[33:])
    assert (read_image(tmp_path / "a.png") * 65535).round().tolist() == [[[0x0102, 0x0304, 0x0506]]]


def test_planes_apart(tmp_path):
    code = RNG.integers(0, 2**16, (3, 5, 7), dtype=np.uint16)
    tiff(tmp_path / "a.tiff", code, planarconfig="separate", compression="zlib")
    np.testing.assert_allclose(read_image(tmp_path / "a.tiff"), np.moveaxis(code, 0, -1) / 65535, atol=1e-7)


@pytest.mark.parametrize("compression", ["tiff_lzw", "tiff_adobe_deflate", "packbits"])
def test_compressed(tmp_path, compression):
    code = RNG.integers(0, 256, (9, 9, 3), dtype=np.uint8)
    Image.fromarray(code).save(tmp_path / "a.tif", compression=compression)
    assert np.array_equal(to_8_bits(read_image(tmp_path / "a.tif")), code)


def test_white_is_0(tmp_path):
    """As scanners write bilevel and grey pictures."""
    tiff(tmp_path / "a.tif", np.array([[0, 255]], np.uint8), photometric="miniswhite")
    assert to_8_bits(read_image(tmp_path / "a.tif")).tolist() == [[[255] * 3, [0] * 3]]


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
@pytest.mark.parametrize("orientation", [*range(10)])
def test_orientation_is_applied_unless_asked(tmp_path, suffix, orientation):
    path, exif = tmp_path / f"a.{suffix}", Image.Exif()
    exif[ORIENTATION] = orientation
    levels = np.zeros((8, 24, 3), np.uint8)
    levels[:, :8], levels[:4, 8:] = 200, 90
    Image.fromarray(levels).save(tmp_path / "b.png", exif=exif)
    if suffix == "tif":
        tiff(path, levels, extratags=[(int(ORIENTATION), 3, 1, orientation, True)])
    else:
        Image.fromarray(levels).save(path, exif=exif)
    with Image.open(tmp_path / "b.png") as image:
        expected = np.asarray(ImageOps.exif_transpose(image))
    near = 3 if suffix == "jpg" else 0
    picture = read_picture(path)
    for each, shown, turn in ((picture, expected, orientation), (picture.as_stored(), levels, 1)):
        assert np.abs(to_8_bits(each.image()).numpy().astype(int) - shown).max() <= near
        assert each.header[:2] == shown.shape[:2]
        assert each.header.orientation == (turn if 1 <= turn <= 8 else 1)


@pytest.mark.parametrize("suffix", ["heic", "avif", "jpg"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_phones_picture(tmp_path, suffix, orientation):
    """Turned as it is to be shown, whichever way its format says so, under any name; EXIF's focal length is there."""
    levels, exif = np.zeros((24, 64, 3), np.uint8), Image.Exif()
    levels[:, :16], levels[:8, 16:] = (200, 100, 50), (30, 160, 90)
    with Image.open(png_of(tmp_path, levels, orientation)) as image:
        expected = np.asarray(ImageOps.exif_transpose(image)).astype(int)
    exif[ORIENTATION], exif[ExifTags.Base.Make] = orientation, "maker"
    exif.get_ifd(ExifTags.IFD.Exif).update({ExifTags.Base.FocalLengthIn35mmFilm: 26, ExifTags.Base.ExposureTime: 0.25})
    Image.fromarray(levels).save(tmp_path / f"a.{suffix}", exif=exif.tobytes(), quality=95)
    (tmp_path / "b.jpg").write_bytes((tmp_path / f"a.{suffix}").read_bytes())
    for name in (f"a.{suffix}", "b.jpg"):
        picture = read_picture(tmp_path / name)
        assert picture.header[:2] == expected.shape[:2]
        assert picture.header.exposure == pytest.approx(0.25)
        assert np.abs(to_8_bits(picture.image()).numpy() - expected).mean() < 3
        with opened(tmp_path / name) as image:
            assert image.getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] == 26


def png_of(folder, levels, orientation):
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    Image.fromarray(levels).save(folder / "a.png", exif=exif)
    return folder / "a.png"


def test_a_tiff_tells_its_lens(tmp_path):
    """As another program writes it, and as developed raw pictures have it."""
    black = np.zeros((4, 6, 3), np.uint8)
    Image.fromarray(black).save(tmp_path / "a.tif", tiffinfo={271: "Maker", 272: "Model"})
    assert read_picture(tmp_path / "a.tif").header.lens == Lens("Maker", "Model")
    expected = Lens("Maker", "Model", 6.5, 26.0)
    write_tiff(tmp_path / "b.tif", black.astype(np.uint16), 6, expected)
    header = read_picture(tmp_path / "b.tif").header
    assert (header.lens, header.height, header.orientation, header.deep) == (expected, 6, 6, True)
    assert tifffile.TiffFile(tmp_path / "b.tif").pages[0].tags["ExifTag"].value["FocalLengthIn35mmFilm"] == 26
    Image.fromarray(black).save(tmp_path / "c.tif")
    assert read_picture(tmp_path / "c.tif").header.lens == Lens()


@pytest.mark.parametrize(("mode", "alpha"), [("RGB;16", False), ("RGBA;16", True)])
def test_a_heic_of_10_bits_keeps_them(tmp_path, mode, alpha):
    levels = np.arange(8 * 8 * (3 + alpha), dtype=np.uint16).reshape(8, 8, -1) % 1024
    lossless = {"quality": -1, "chroma": 444, "matrix_coefficients": 0}
    pillow_heif.from_bytes(mode, (8, 8), (levels << 6).tobytes()).save(tmp_path / "a.heic", **lossless)
    found = read_picture(tmp_path / "a.heic")
    assert (found.header.deep, found.header.alpha) == (True, alpha)
    np.testing.assert_allclose(found.image(), levels.astype(float) * 64 / 65535, atol=1e-6)


def test_a_heic_of_other_colours_says_so(tmp_path):
    """PQ's curve is none of sRGB's; Display P3 by a profile is converted, as in a JPEG."""
    levels = np.full((16, 16, 3), (200, 60, 60), np.uint8)
    pillow_heif.from_pillow(Image.fromarray(levels)).save(
        tmp_path / "pq.heic", color_primaries=9, transfer_characteristics=16, matrix_coefficients=9
    )
    assert read_picture(tmp_path / "pq.heic").header.colours == "NCLX's primaries 9 and transfer 16"
    Image.fromarray(levels).save(tmp_path / "usual.heic")
    assert read_picture(tmp_path / "usual.heic").header.colours is None


def test_a_jpeg_with_a_gain_map_stays_as_it_is(tmp_path):
    """Its own picture, of normal range, comes first; the map is a second one behind it."""
    base, gains = (Image.fromarray(np.full((16, 24, 3), level, np.uint8)) for level in (80, 255))
    base.save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=[gains], quality=95)
    assert read_picture(tmp_path / "a.jpg").header == Header(16, 24, False)
    assert np.abs(to_8_bits(read_image(tmp_path / "a.jpg")).numpy().astype(int) - 80).max() <= 1


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "heic", "avif"])
def test_the_light_that_exif_tells(tmp_path, suffix):
    path, exif = tmp_path / f"a.{suffix}", Image.Exif()
    exif[ExifTags.Base.Make] = "maker"  # Pillow writes none into a PNG that has but the other tags
    exif.get_ifd(ExifTags.IFD.Exif).update(
        {ExifTags.Base.ExposureTime: IFDRational(1, 50), ExifTags.Base.ISOSpeedRatings: 400, ExifTags.Base.FNumber: 2.0}
    )
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(path, exif=exif)
    assert read_picture(path).header.exposure == pytest.approx(4 / 50 / 4)


def test_the_lens_that_exif_tells(tmp_path):
    """What is no number > 0 is not told."""
    path, exif = tmp_path / "a.jpg", Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Lumen", "L 2"
    tags = {"FocalLength": IFDRational(21, 5), "FocalLengthIn35mmFilm": 26, "DigitalZoomRatio": IFDRational(0, 1)}
    exif.get_ifd(ExifTags.IFD.Exif).update({ExifTags.Base[name]: value for name, value in tags.items()})
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(path, exif=exif)
    assert read_picture(path).header.lens == Lens("Lumen", "L 2", 4.2, 26, None)


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        ({}, None), ({"FNumber": 2.0, "ISOSpeedRatings": 100}, None), ({"ExposureTime": 0.5}, 0.5),
        ({"ExposureTime": 0.5, "ISOSpeedRatings": (200, 0)}, 1.0), ({"ExposureTime": 0.5, "ISOSpeedRatings": 0}, 0.5),
        ({"ExposureTime": 0.0}, None), ({"ExposureTime": -1.0}, None), ({"ExposureTime": IFDRational(1, 0)}, None),
        ({"ExposureTime": float("inf")}, None), ({"ExposureTime": "fast"}, None), ({"ExposureTime": ()}, None),
        ({"ExposureTime": 0.5, "FNumber": float("nan")}, 0.5),
    ],
)  # fmt: skip
def test_exif_by_its_tags(told, expected):
    assert exposure_of({ExifTags.Base[name]: value for name, value in told.items()}) == expected


def truncated(path):
    path.write_bytes(path.read_bytes()[:-40])


def large_tiff(path):
    """Width and height, tags 256 and 257, of 9000 each."""
    content = path.read_bytes()
    for tag, kind, count in ((256, 3, 1), (256, 4, 1), (257, 3, 1), (257, 4, 1)):
        at = content.find(struct.pack("<HHI", tag, kind, count))
        if at >= 0:
            content = content[:at] + struct.pack("<HHII", tag, 4, 1, 9000) + content[at + 12 :]
    path.write_bytes(content)


def large_exr(path):
    old = np.array([0, 0, 11, 7], "<i4").tobytes()
    path.write_bytes(path.read_bytes().replace(old, np.array([0, 0, 8999, 8999], "<i4").tobytes()))


def window(path):
    low, high = np.array([0, 0], np.int32), np.array([19, 19], np.int32)
    exr(path, {"RGB": np.zeros((8, 12, 3), np.float32)}, displayWindow=(low, high))


def holds(content):
    return lambda path: path.write_bytes(content)


NAN = np.full((4, 4, 3), np.nan, np.float32)


@pytest.mark.parametrize(
    ("suffix", "spoil", "found"),
    [
        *((suffix, lambda path: path.unlink(), "no such file") for suffix in ("png", "tif", "exr")),
        *((suffix, holds(b""), "an empty file") for suffix in ("png", "tif", "exr")),
        ("png", holds(b"hello"), "something that is not an image, expected a whole image"),
        *((suffix, holds(b"hello"), "a picture that cannot be read") for suffix in ("tif", "exr")),
        ("png", truncated, "an image that cannot be read .*: copy it here again, or leave it out"),
        *((suffix, truncated, "a picture that cannot be read") for suffix in ("tif", "exr")),
        ("png", holds(b"\x89PNG\r\n\x1a\n"), "something that is not an image"),
        ("png", holds(b"%!PS-Adobe-3.0 EPSF"), "something that is not an image"),
        ("png", holds(b"version https://git-lfs.github.com/spec/v1\noid"), "a Git LFS pointer .*: git lfs pull"),
        ("png", holds(b"GIF89a" + bytes(20)), r"a picture of GIF's kind, .* \(mogrify -format png .*/\*\.png\)"),
        ("png", holds(b"BM" + bytes(60)), "a picture of BMP's kind"),
        ("png", holds(b"P6 2 2 255 " + bytes(12)), "a picture of PPM's kind"),
        ("heic", holds(b""), "an empty file"),
        ("heic", holds(b"\0\0\0\x18ftypheic" + bytes(12)), r"an image that cannot be read \(damaged"),
        ("heic", truncated, "an image that cannot be read .*: copy it here again, or leave it out"),
        ("avif", truncated, "an image that cannot be read .*: copy it here again, or leave it out"),
        ("png", holds(png(8_001, 8_001, 8, 6, b"")), f"an image of 8001x8001 pixels, .*at most {MAX_PIXELS} pixels"),
        ("png", holds(png(100_000, 100_000, 8, 6, b"")), f"an image .*expected .*at most {MAX_PIXELS} pixels"),
        ("tif", large_tiff, "an image of 9000x9000 pixels, expected a whole TIFF"),
        ("exr", large_exr, "an image of 9000x9000 pixels"),
        ("tif", lambda path: tiff(path, NAN), "NaN or infinity"),
        ("exr", lambda path: exr(path, {"RGB": NAN}), "NaN or infinity"),
        ("tif", lambda path: tiff(path, np.zeros((4, 4), np.int16), photometric="minisblack"), "channels Y of int16"),
        ("tif", lambda path: write(path, np.zeros((4, 4, 4), np.uint8), "unspecified"), "channels R, G, B, channel3"),
        ("exr", window, "a data window of 0 12 0 8.*, expected all of its display window, 0 20 0 20"),
        ("exr", lambda path: exr(path, {"Z": np.zeros((4, 6), np.float32)}), "channels Z of float, expected a whole"),
    ],
)
@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_refused(tmp_path, suffix, spoil, found):
    path = tmp_path / f"a.{suffix}"
    write(path, RNG.integers(0, 256, (8, 12, 3)).astype("f4" if suffix == "exr" else "u1"))
    spoil(path)
    with pytest.raises(DataError, match=rf"a\.{suffix}: found {found}"):
        read_image(path)


def test_the_extra_is_named(tmp_path, monkeypatch):
    Image.fromarray(np.zeros((4, 6, 3), np.uint8)).save(tmp_path / "a.heic")
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "pillow_heif", None)
        with pytest.raises(CTMError, match=r"reading HEIC needs pillow-heif: pip install -e '\.\[photos\]'"):
            read_picture(tmp_path / "a.heic")


def test_depth(tmp_path):
    """As 16-bit grey, 0 for nothing, or as an array, NaN for nothing."""
    Image.fromarray(np.array([[0, 4], [65_535, 1]], dtype=np.uint16)).save(tmp_path / "d.png")
    expected = torch.tensor([[torch.nan, 1.0], [65_535 / 4, 0.25]])
    torch.testing.assert_close(read_depth(tmp_path / "d.png", 0.25), expected, equal_nan=True)
    depth = np.array([[1.5, np.nan], [2.0, 3.25]], dtype=np.float64)
    np.save(tmp_path / "d.npy", depth)
    np.testing.assert_array_equal(read_depth(tmp_path / "d.npy", 2.0).numpy(), 2 * depth.astype(np.float32))


def claims_more_than_it_holds(path):
    np.save(path, np.zeros((2, 2), dtype=np.float32))
    path.write_bytes(path.read_bytes().replace(b"(2, 2), }", b"(99999999, 99999999), }"))


@pytest.mark.parametrize(
    ("suffix", "spoil", "found"),
    [
        ("png", lambda path: write(path, np.zeros((2, 2, 3), np.uint8)), "a picture of kind RGB, .* as 16-bit grey"),
        ("npy", holds(b""), "an empty file"),
        ("npy", holds(b"PK\x03\x04"), "no array that can be read"),
        ("npy", lambda path: np.save(path, np.array([[{}]], object), allow_pickle=True), "no array that can be read"),
        ("npy", claims_more_than_it_holds, "no array that can be read"),
        ("npy", lambda path: np.save(path, np.zeros((2, 2), dtype=np.int32)), "an array of int32"),
        ("npy", lambda path: np.save(path, np.ones((2, 2, 1))), r"an array \[2, 2, 1\]"),
        ("npy", lambda path: np.save(path, np.zeros((2, 2))), "a distance that is not > 0"),
        ("npy", lambda path: np.save(path, np.full((2, 2), np.inf)), "a distance that is not > 0 or is infinite"),
    ],
)
def test_refused_depth(tmp_path, suffix, spoil, found):
    spoil(tmp_path / f"d.{suffix}")
    with pytest.raises(DataError, match=rf"d\.{suffix}: found {found}"):
        read_depth(tmp_path / f"d.{suffix}", 1.0)


def test_8_bits_come_back_bit_for_bit():
    levels = torch.arange(256, dtype=torch.uint8)[:, None, None].expand(-1, 1, 3)
    assert torch.equal(to_8_bits(levels.float() / 255.0), levels)
