"""Photographs that are cut, scaled, turned, masked, or lie there in part."""

import math
import struct
import warnings
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from ctm_scenes.trajectory import hemisphere
from layouts import COUNT, NAMES, POINTS, YARD_SIZE, colmap_layout, write_camera, write_images
from PIL import ExifTags, Image, ImageOps
from scipy.optimize import brentq

from ctm_plugin.data.colmap import ColmapConfig
from ctm_plugin.data.readers.colmap_model import mark_as_shown, searched_in
from ctm_plugin.data.readers.lens import Intrinsics
from ctm_plugin.errors import DataError

WIDTH, HEIGHT = YARD_SIZE
PINHOLE = (1, (20.0, 20.0, 6.0, 8.0))


def load(root: Path, **settings):
    return ColmapConfig(root=root, **settings).load()


def fill(folder: Path, size: tuple[int, int], count: int = COUNT) -> None:
    folder.mkdir(exist_ok=True)
    for name in NAMES[:count]:
        iio.imwrite(folder / name, np.full((size[1], size[0], 3), 99, dtype=np.uint8))


CAMERA = Intrinsics(500, 375, 735.4, 735.0, 251.0, 186.0, where="camera 1")
PATH, SOURCE = Path("a.png"), Path("cameras.bin")


@pytest.mark.parametrize("size", [(500, 375), (250, 188), (250, 187), (125, 93), (125, 94), (1000, 750), (333, 250)])
def test_the_same_picture_at_another_scale(size):
    found = CAMERA.of_picture(*size, PATH, SOURCE)
    across, down = size[0] / 500, size[1] / 375
    assert found[:2] == size
    assert found.pinhole == pytest.approx((735.4 * across, 735.0 * down, 251 * across, 186 * down), rel=1e-12)


@pytest.mark.parametrize("size", [(496, 372), (450, 375), (400, 375), (499, 375), (250, 180), (375, 500), (501, 375)])
def test_pictures_of_another_size_are_refused(size):
    """496x372 has the ratio of 500x375, but may as well be cut."""
    found = f"a.png: found a picture of {size[0]}x{size[1]}, expected 500x375 as camera 1 of cameras.bin: "
    with pytest.raises(DataError, match="the picture that it is of") as caught:
        CAMERA.of_picture(*size, PATH, SOURCE)
    assert str(caught.value).startswith(found)


def test_a_folder_with_some_of_the_pictures_is_not_preferred(yard):
    fill(yard / "images_2", (12, 8), COUNT - 1)
    with pytest.warns(UserWarning, match=r"images_2 holds 8 of 9 pictures: .*images is taken and shrunk") as seen:
        views = load(yard, downscale=2).test
    assert len(seen) == 1
    assert not (views.images == 99).any()
    fill(yard / "images_2", (12, 8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (load(yard, downscale=2).test.images == 99).all()
        assert not (load(yard, width=12).test.images == 99).any()  # a width says nothing of a folder
        assert not (load(yard, downscale=2.5).test.images == 99).any()


def turned(path: Path, orientation: int, size: tuple[int, int] = YARD_SIZE) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8)).save(path, exif=exif)


@pytest.mark.parametrize("orientation", [2, 3, 4])
def test_turns_that_the_size_does_not_tell(yard, orientation):
    turned(yard / "images/f_03.png", orientation)
    found = f"f_03.png: found a picture that EXIF's orientation {orientation} turns to 24x16, expected 24x16, as camera"
    with pytest.raises(DataError, match="take the tag off") as caught:
        load(yard)
    assert found in str(caught.value)


@pytest.mark.parametrize("orientation", [2, 3, 4, 6, 8])
def test_cameras_known_to_be_of_turned_pictures(yard, orientation):
    """As ctm cameras marks its models; another model in the same place is not meant."""
    size = (24, 24) if orientation > 4 else YARD_SIZE
    write_camera(yard / "sparse/0/cameras.bin", *PINHOLE, size)
    levels = np.random.default_rng(0).integers(0, 256, (*size[::-1], 3), dtype=np.uint8)
    for name in NAMES:
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        Image.fromarray(levels).save(yard / "images" / name, exif=exif)
    mark_as_shown(yard / "sparse/0", ["a b.png", "c.png"])
    assert searched_in(yard / "sparse/0") == {"a b.png", "c.png"}
    with Image.open(yard / "images" / NAMES[0]) as image:
        shown = np.asarray(ImageOps.exif_transpose(image))
    images = load(yard).train.images
    np.testing.assert_array_equal(images, np.broadcast_to(shown, images.shape))
    write_images(yard / "sparse/0/images.bin", hemisphere(COUNT, 4.0, seed=4), [[10]] * COUNT, NAMES)
    with pytest.raises(DataError, match="take the tag off, or find the cameras anew by ctm cameras"):
        load(yard)


def test_a_lens_that_folds_beside_its_pictures(yard):
    """Upright ones beside lying ones, of a lens that reaches neither's corner of the size that holds both."""
    lens, focal, sides = (0.088, -0.181), 83.8, {1: (96, 54), 2: (54, 96)}
    both = struct.pack("<Q", 2)
    for number, (width, height) in sides.items():
        both += struct.pack("<iiQQ5d", number, 3, width, height, focal, width / 2, height / 2, *lens)
    (yard / "sparse/0/cameras.bin").write_bytes(both)
    data = bytearray((yard / "sparse/0/images.bin").read_bytes())
    for index, name in enumerate(NAMES):
        width, height = sides[1 + index % 2]
        iio.imwrite(yard / "images" / name, np.full((height, width, 3), 99, dtype=np.uint8))
        at = data.index(name.encode())
        data[at - 4 : at] = struct.pack("<i", 1 + index % 2)
    (yard / "sparse/0/images.bin").write_bytes(data)
    with pytest.warns(UserWarning, match="pictures of 2 sizes"):
        scene = load(yard)
    assert scene.train.extents.tolist() == [list(sides[1 + int(name[2:]) % 2]) for name in scene.train.names]
    corner = math.hypot(48, 27) / focal
    off = brentq(lambda r: r * (1 + lens[0] * r**2 + lens[1] * r**4) - corner, 0, 1)
    depths = [
        -(np.linalg.inv(pose) @ np.append(POINTS, np.ones((4, 1)), 1).T)[2] for pose in hemisphere(COUNT, 4.0, seed=3)
    ]
    assert scene.far == pytest.approx(np.percentile(depths, 99.5) * math.hypot(1, off), rel=1e-4)


def test_cameras_of_turned_pictures(yard):
    """Stored upright and shown lying, as the cameras have it; then the other way round, for which stored ones go."""
    for name in NAMES:
        turned(yard / "images" / name, 6, (HEIGHT, WIDTH))
    assert load(yard).train.images.shape[1:3] == (HEIGHT, WIDTH)
    stored = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    for index, name in enumerate(NAMES):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = 5 + index % 4
        Image.fromarray(stored).save(yard / "images" / name, exif=exif)
    with pytest.warns(UserWarning, match=r"f_00\.png: 9 pictures are read as they are stored, without EXIF's rotation"):
        scene = load(yard)
    for images in (scene.train.images, scene.test.images):
        np.testing.assert_array_equal(images, np.broadcast_to(stored, images.shape))


def test_pictures_of_two_sizes(yard, tmp_path):
    """Of two cameras, one upright: each picture and its rays are what they are without the others."""
    rng = np.random.default_rng(1)
    alone = colmap_layout(tmp_path / "alone", hemisphere(COUNT, 4.0, seed=3), PINHOLE)
    both = struct.pack("<Q", 2)
    for number, (width, height) in enumerate(((WIDTH, HEIGHT), (12, 20)), 1):
        both += struct.pack("<iiQQ4d", number, 1, width, height, *PINHOLE[1])
    (yard / "sparse/0/cameras.bin").write_bytes(both)
    write_images(yard / "sparse/0/images.bin", hemisphere(COUNT, 4.0, seed=3), [[10, 11, 12, 13]] * COUNT, NAMES)
    data = bytearray((yard / "sparse/0/images.bin").read_bytes())
    upright = {1, 8}
    for index in upright:
        iio.imwrite(yard / "images" / NAMES[index], rng.integers(1, 256, (20, 12, 3), dtype=np.uint8))
        at = data.index(NAMES[index].encode())
        data[at - 4 : at] = struct.pack("<i", 2)
    (yard / "sparse/0/images.bin").write_bytes(data)
    with pytest.warns(UserWarning, match=r"pictures of 2 sizes \(12x20, 24x16\): they are put on one canvas"):
        found, expected = load(yard), load(alone)
    for views, single in ((found.train, expected.train), (found.test, expected.test)):
        assert views.images.shape[1:] == (20, 24, 3)
        torch.testing.assert_close(views.intrinsics, single.intrinsics)  # of equal numbers from the corner
        for index, name in enumerate(views.names):
            number = NAMES.index(f"{name}.png")
            height, width = (20, 12) if number in upright else (HEIGHT, WIDTH)
            stored = iio.imread(yard / "images" / NAMES[number])
            np.testing.assert_array_equal(views.images[index, :height, :width], stored)
            assert views.own(index, views.images[index]).shape[:2] == views.size(index) == (height, width)
            assert views.mask[index, :height, :width].all()
            assert views.mask[index].sum() == height * width
            assert not views.images[index][~views.mask[index]].any()
    with pytest.warns(UserWarning, match="sizes"):
        half = load(yard, width=12)  # the widest one's
    index = half.train.names.index("f_01")
    assert half.train.size(index) == (10, 6)
    assert half.train.mask[index].nonzero().amax(0).tolist() == [9, 5]
    torch.testing.assert_close(half.train.intrinsics, found.train.intrinsics / 2)


def test_exposures_of_training_pictures(yard):
    """As EXIF has them, times what mixes them; NaN where one does not tell, nothing where none does."""
    assert load(yard).train.exposures is None
    for index, name in enumerate(NAMES[:-1]):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = 1
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.ExposureTime] = (index + 1) / 8
        Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(yard / "images" / name, exif=exif)
    scene = load(yard)
    kept = [int(name[2:4]) for name in scene.train.names]
    expected = torch.tensor([(index + 1) / 8 if index < len(NAMES) - 1 else torch.nan for index in kept])
    torch.testing.assert_close(scene.train.exposures, expected, equal_nan=True)
    assert scene.test.exposures is None


def test_exposures_of_two_cameras_are_compared_with_their_own(yard):
    for index, name in enumerate(NAMES):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = 1
        exif[ExifTags.Base.Model] = ("one", "other")[index % 2]
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.ExposureTime] = (0.5, 2.0)[index % 2] * (1 + (index == 3))
        Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(yard / "images" / name, exif=exif)
    scene = load(yard)
    expected = torch.tensor([2.0 if name == "f_03" else 1.0 for name in scene.train.names])
    torch.testing.assert_close(scene.train.exposures, expected)


def masks(root: Path, names: list[str], size: tuple[int, int] = YARD_SIZE) -> np.ndarray:
    """Masks that take the left half out."""
    levels = np.zeros((size[1], size[0]), np.uint8)
    levels[:, size[0] // 2 :] = 255
    (root / "masks").mkdir()
    for name in names:
        iio.imwrite(root / "masks" / name, levels)
    return levels > 127


@pytest.mark.parametrize("ending", [".png.png", ".png", ".PNG", ".PNG.png", ".jpg", "_mask.png", ".tiff"])
def test_masks_beside(yard, ending):
    expected = masks(yard, [name.replace(".png", ending) for name in NAMES])
    scene = load(yard)
    for views in (scene.train, scene.test):
        assert views.mask.shape == (len(views), HEIGHT, WIDTH)
        assert (views.mask.numpy() == expected).all()
    assert load(yard, downscale=2.4).test.mask[0, 0].tolist() == [False] * 5 + [True] * 5
    odd = load(yard, width=9).test.mask[0, 0]  # the middle one of nine lies half in what counts
    assert odd.tolist() == [False] * 5 + [True] * 4


def test_pictures_without_a_mask_count_whole(yard):
    masks(yard, NAMES[8:])
    with pytest.warns(UserWarning, match=r"masks: all pixels count of 8 of 9 pictures, which have no mask, such as f_"):
        scene = load(yard)
    assert scene.train.mask is None
    assert scene.test.mask.float().mean((1, 2)).tolist() == [1.0, 0.5]


@pytest.mark.parametrize("folder", ["images_mask", "mask"])
def test_masks_elsewhere_are_told_of(yard, folder):
    masks(yard, NAMES)
    (yard / "masks").rename(yard / folder)
    with pytest.warns(UserWarning, match=rf"{folder}: not looked at; masks are to lie in .*masks") as seen:
        assert load(yard).train.mask is None
    assert len(seen) == 1
    (yard / folder).rename(yard / "Masks")
    assert load(yard).train.mask.float().mean() == 0.5


@pytest.mark.parametrize(
    ("names", "size", "found"),
    [
        ([], YARD_SIZE, r"masks: found no mask of any picture, expected f_00\.png\.png and so on, or no folder masks"),
        (["other.png"], YARD_SIZE, r"masks: found no mask of any picture; other\.png lie there"),
        (NAMES, (12, 8), r"f_01\.png: found a mask of 12x8 pixels"),
    ],
)
def test_masks_that_do_not_fit(yard, names, size, found):
    masks(yard, names, size)
    with pytest.raises(DataError, match=found):
        load(yard)
