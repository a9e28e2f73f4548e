"""What is no photograph of a capture is left out with a word; what may be one stays."""

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import Base

from ctm_plugin.cameras.left_out import left_out
from ctm_plugin.cameras.photographs import list_photographs
from ctm_plugin.data.readers.images import heif_formats

RNG = np.random.default_rng(0)
PHONE = (80, 60)


@pytest.fixture
def capture(tmp_path):
    """Eight photographs of a phone, upright and lying, one without EXIF."""
    for number in range(8):
        picture(tmp_path / f"IMG_{number}.jpg", PHONE[::-1] if number % 3 else PHONE, camera=number != 4)
    return tmp_path


def picture(path, size, camera=False, **more):
    exif = Image.Exif()
    if camera:
        exif[Base.Make] = "maker"
    path.parent.mkdir(exist_ok=True)
    codes = RNG.integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(codes).save(path, exif=exif.tobytes(), **more)
    return path


def test_photographs_stay(capture):
    assert left_out(sorted(capture.iterdir())) == {}
    assert len(list_photographs(capture, "images")) == 8


def test_what_is_none(capture):
    heif_formats()
    shots = [picture(capture / "IMG_90.PNG", (39, 84)), picture(capture / "Screenshot 1.png", PHONE)]
    wide = picture(capture / "IMG_91.jpg", (300, 60), camera=True)
    again = [capture / "IMG_1 (1).jpg", capture / "more" / "IMG_2.jpg", capture / "IMG_3.jpg"]
    again[1].parent.mkdir()
    again[0].write_bytes((capture / "IMG_1.jpg").read_bytes())
    again[1].write_bytes((capture / "IMG_2.jpg").read_bytes())
    picture(capture / "IMG_3.HEIC", PHONE[::-1], camera=True)
    (capture / "._IMG_1.jpg").write_bytes(b"of a Mac")
    (capture / "Thumbs.db").write_bytes(b"of Windows")
    with pytest.warns(UserWarning, match="left out") as caught:
        kept = list_photographs(capture, "images")
    assert {*capture.rglob("*.*")} - {*kept} == {
        *shots, wide, *again, capture / "._IMG_1.jpg", capture / "Thumbs.db",
    }  # fmt: skip
    assert [str(each.message).removeprefix(f"{capture}: ") for each in caught] == [
        "copies left out: 3, as 'IMG_1 (1).jpg'",
        "screenshots left out: 2, as 'IMG_90.PNG'",
        "panoramas left out: 1, as 'IMG_91.jpg'",
    ]


def test_pictures_that_could_be_photographs_stay(capture, tmp_path_factory):
    """Many without a camera are sent by a messenger; frames of a clip have none; some phones take 20:9 throughout."""
    for number in range(5):
        picture(capture / f"sent_{number}.jpg", (64, 48))
        picture(capture / "clip" / f"{number}.png", (96, 54))
    assert left_out(sorted(capture.rglob("*.*"))) == {}
    other = tmp_path_factory.mktemp("long")
    paths = [picture(other / f"{number}.jpg", (100, 45), camera=True) for number in range(3)]
    assert left_out(paths) == {}


def test_names_of_one_photograph_in_two_shapes_are_two(tmp_path):
    paths = [picture(tmp_path / "1.jpg", (80, 60)), picture(tmp_path / "1.png", (60, 60))]
    assert left_out(paths) == {}


def test_what_cannot_be_read_is_for_others_to_say(tmp_path):
    (tmp_path / "1.jpg").write_bytes(b"")
    assert left_out([tmp_path / "1.jpg"]) == {}
