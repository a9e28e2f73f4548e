"""Reading pictures against numpy and PIL."""

import struct

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import ExifTags, Image, ImageOps
from PIL.TiffImagePlugin import IFDRational
from png import chunk, png, png_16

from ctm_plugin.data.readers.images import read_depth, read_image, read_picture, to_8_bits
from ctm_plugin.data.readers.picture import MAX_PIXELS, Header, exposure_of
from ctm_plugin.errors import DataError


@pytest.mark.parametrize("mode", ["RGBA", "RGB", "L", "LA", "P", "1"])
def test_reads_every_kind_of_8_bit_picture(tmp_path, mode):
    rng = np.random.default_rng(0)
    alpha = mode in ("RGBA", "LA")
    image = Image.fromarray(rng.integers(0, 256, (6, 5, 4 if alpha else 3), dtype=np.uint8)).convert(mode)
    image.save(tmp_path / "a.png")
    assert read_picture(tmp_path / "a.png").header == Header(6, 5, alpha, deep=False, orientation=1)
    expected = np.asarray(image.convert("RGBA" if alpha else "RGB")) / 255.0
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), expected, atol=1e-7)


def test_reads_a_palette_with_transparency(tmp_path):
    image = Image.fromarray(np.array([[0, 1]], dtype=np.uint8), mode="P")
    image.putpalette([10, 20, 30, 40, 50, 60])
    image.save(tmp_path / "a.png", transparency=0)
    levels = to_8_bits(read_image(tmp_path / "a.png"))
    assert levels.tolist() == [[[0, 0, 0, 0], [40, 50, 60, 255]]]


def test_reads_16_bit_grey_at_full_depth(tmp_path):
    code = np.array([[0, 1, 300], [30_000, 65_534, 65_535]], dtype=np.uint16)
    Image.fromarray(code).save(tmp_path / "a.png")
    expected = np.repeat(code[..., None] / 65535.0, 3, axis=2)
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), expected, atol=1e-7)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_16_bits_stay_16_bits(tmp_path, channels):
    code = np.random.default_rng(0).integers(0, 2**16, (11, 7, channels), dtype=np.uint16)
    (tmp_path / "a.png").write_bytes(png_16(code))
    assert read_picture(tmp_path / "a.png").header == Header(11, 7, channels in (2, 4), deep=True)
    expected = code if channels > 2 else code[..., [0, 0, 0, *range(1, channels)]]
    np.testing.assert_array_equal(read_image(tmp_path / "a.png") * 65535, expected)


@pytest.mark.parametrize("channels", [1, 3])
def test_a_transparent_colour_of_16_bits(tmp_path, channels):
    code = np.random.default_rng(0).integers(0, 2**16, (3, 4, channels), dtype=np.uint16)
    code[2, 1] = code[0, 0] ^ 1  # differs in the lower byte alone
    extra = chunk(b"tRNS", code[0, 0].astype(">u2").tobytes())
    (tmp_path / "a.png").write_bytes(png_16(code, extra))
    image = read_image(tmp_path / "a.png")
    assert read_picture(tmp_path / "a.png").header.alpha
    assert image.shape == (3, 4, 4)
    assert (image[..., 3] == 0).nonzero().tolist() == [[0, 0]]


def test_interlaced_16_bits(tmp_path):
    """One pixel is Adam7's first pass alone."""
    header = struct.pack(">IIBBBBB", 1, 1, 16, 2, 0, 0, 1)
    plain = png(1, 1, 16, 2, bytes([0, 1, 2, 3, 4, 5, 6]))
    (tmp_path / "a.png").write_bytes(plain[:8] + chunk(b"IHDR", header) + plain[33:])
    assert (read_image(tmp_path / "a.png") * 65535).round().tolist() == [[[0x0102, 0x0304, 0x0506]]]


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
@pytest.mark.parametrize("orientation", [*range(10)])
def test_exif_orientation_is_applied(tmp_path, suffix, orientation):
    path, exif = tmp_path / f"a.{suffix}", Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    levels = np.zeros((8, 24, 3), np.uint8)
    levels[:, :8], levels[:4, 8:] = 200, 90
    Image.fromarray(levels).save(path, exif=exif)
    with Image.open(path) as image:
        expected = np.asarray(ImageOps.exif_transpose(image))
    np.testing.assert_array_equal(to_8_bits(read_image(path)), expected)
    found = read_picture(path).header
    assert (found.height, found.width) == expected.shape[:2]
    assert found.orientation == (orientation if 1 <= orientation <= 8 else 1)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
def test_the_light_that_exif_tells(tmp_path, suffix):
    path, exif = tmp_path / f"a.{suffix}", Image.Exif()
    exif[ExifTags.Base.Orientation] = 1  # Pillow writes none into a PNG that has but the other tags
    exif.get_ifd(ExifTags.IFD.Exif).update(
        {
            ExifTags.Base.ExposureTime: IFDRational(1, 50), ExifTags.Base.FNumber: IFDRational(2, 1),
            ExifTags.Base.ISOSpeedRatings: 400,
        }
    )  # fmt: skip
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(path, exif=exif)
    assert read_picture(path).header.exposure == pytest.approx(4 / 50 / 4)


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


def test_reads_jpeg(tmp_path):
    Image.fromarray(np.full((8, 8, 3), 77, dtype=np.uint8)).save(tmp_path / "a.jpg")
    assert (to_8_bits(read_image(tmp_path / "a.jpg")) == 77).all()


@pytest.mark.parametrize("side", [8_001, 100_000])
@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_refuses_absurd_sizes_without_decoding(tmp_path, side):
    (tmp_path / "a.png").write_bytes(png(side, side, 8, 6, b""))
    with pytest.raises(DataError, match=rf"a\.png: found .*expected .*at most {MAX_PIXELS} pixels"):
        read_picture(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"hello", "something that is not an image, expected a whole image"),
        (b"\x89PNG\r\n\x1a\n", "something that is not an image"),
        (b"%!PS-Adobe-3.0 EPSF", "something that is not an image"),
        (b"", "an empty file"),
        (b"version https://git-lfs.github.com/spec/v1\noid", "a Git LFS pointer .*: git lfs pull fetches it"),
        (b"GIF89a" + bytes(20), r"a picture of GIF's kind, .* \(mogrify -format png images/\*\.png\)"),
        (b"BM" + bytes(60), "a picture of BMP's kind"),
        (b"P6 2 2 255 " + bytes(12), "a picture of PPM's kind"),
        (b"\0\0\0\x18ftypheic" + bytes(12), "a picture of HEIC's kind"),
    ],
)
def test_refuses_what_is_not_an_image(tmp_path, content, found):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(DataError, match=rf"a\.png: found {found}"):
        read_image(tmp_path / "a.png")


@given(data=st.data())
def test_damaged_pictures_load_or_are_refused(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (6, 5, 4), dtype=np.uint8)).save(path)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        image = read_image(path)
    except DataError:
        return
    assert image.shape[2] in (3, 4)
    assert image.min() >= 0.0
    assert image.max() <= 1.0


def test_8_bits_come_back_bit_for_bit():
    levels = torch.arange(256, dtype=torch.uint8)[:, None, None].expand(-1, 1, 3)
    assert torch.equal(to_8_bits(levels.float() / 255.0), levels)


def test_depth(tmp_path):
    Image.fromarray(np.array([[0, 4], [65_535, 1]], dtype=np.uint16)).save(tmp_path / "d.png")
    expected = torch.tensor([[torch.nan, 1.0], [65_535 / 4, 0.25]])
    torch.testing.assert_close(read_depth(tmp_path / "d.png", 0.25), expected, equal_nan=True)


def test_depth_needs_16_bit_grey(tmp_path):
    Image.fromarray(np.zeros((2, 2, 3), dtype=np.uint8)).save(tmp_path / "d.png")
    with pytest.raises(DataError, match=r"d\.png: found a picture of kind RGB, expected depth as 16-bit grey"):
        read_depth(tmp_path / "d.png", 0.25)


def test_depth_as_an_array(tmp_path):
    depth = np.array([[1.5, np.nan], [2.0, 3.25]], dtype=np.float64)
    np.save(tmp_path / "d.npy", depth)
    np.testing.assert_array_equal(read_depth(tmp_path / "d.npy", 2.0).numpy(), 2 * depth.astype(np.float32))


def objects(path):
    np.save(path, np.array([[{}]], dtype=object), allow_pickle=True)


def claims_more_than_it_holds(path):
    np.save(path, np.zeros((2, 2), dtype=np.float32))
    path.write_bytes(path.read_bytes().replace(b"(2, 2), }", b"(99999999, 99999999), }"))


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (lambda path: path.write_bytes(b""), "an empty file"),
        (lambda path: path.write_bytes(b"PK\x03\x04"), "no array that can be read"),
        (objects, "no array that can be read"),
        (claims_more_than_it_holds, "no array that can be read"),
        (lambda path: np.save(path, np.zeros((2, 2), dtype=np.int32)), "an array of int32"),
        (lambda path: np.save(path, np.ones((2, 2, 1))), r"an array \[2, 2, 1\]"),
        (lambda path: np.save(path, np.zeros((2, 2))), "a distance that is not > 0"),
        (lambda path: np.save(path, np.full((2, 2), np.inf)), "a distance that is not > 0 or is infinite"),
    ],
)
def test_spoilt_depth_arrays(tmp_path, spoil, found):
    spoil(tmp_path / "d.npy")
    with pytest.raises(DataError, match=rf"d\.npy: found {found}"):
        read_depth(tmp_path / "d.npy", 1.0)
