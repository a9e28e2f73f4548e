"""What no reader takes: one line names the file, what was found there and what was expected."""

import json
import math
import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from ctm_scenes.trajectory import hemisphere
from dng import write_dng
from layouts import MAKE, OPENCV, as_text, write_camera, write_images
from PIL import Image

from ctm_plugin.errors import DataError
from ctm_plugin.settings.registry import DATASETS

Spoil = Callable[[Path], object]
GONE = object()
JSON = {"blender": "transforms_train.json", "transforms": "transforms.json"}
TEST = "transforms_test.json"
NO_NUMBERS = ["x", None, True, math.nan, math.inf, [1.0], 10**400]


def put(value: Any, *path: str | int, file: str | None = None) -> Spoil:
    """Set what stands at this place of a JSON file, or take it away."""

    def spoil(root: Path) -> None:
        name = root / (file or JSON[root.name])
        owner = content = json.loads(name.read_text())
        for key in path[:-1]:
            owner = owner[key]
        if value is GONE:
            del owner[path[-1]]
        else:
            owner[path[-1]] = value
        name.write_text(json.dumps(content))

    return spoil


def matrix(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    def spoil(root: Path) -> None:
        pose = json.loads((root / JSON[root.name]).read_text())["frames"][1]["transform_matrix"]
        put(change(np.array(pose)).tolist(), "frames", 1, "transform_matrix")(root)

    return spoil


def both(*spoils: Spoil) -> Spoil:
    return lambda root: [spoil(root) for spoil in spoils]


def holds(file: str, content: str | bytes) -> Spoil:
    return lambda root: (root / file).write_bytes(content if isinstance(content, bytes) else content.encode())


def gone(*files: str) -> Spoil:
    return lambda root: [(root / file).unlink() for file in files]


def moved(file: str, to: str) -> Spoil:
    return lambda root: (root / file).rename(root / to)


def picture(file: str, height: int, width: int) -> Spoil:
    return lambda root: iio.imwrite(root / file, np.zeros((height, width, 3), np.uint8))


def packed(file: str, at: int, form: str, *values: Any) -> Spoil:
    """Overwrite a few bytes of COLMAP's binary model."""

    def spoil(root: Path) -> None:
        data = bytearray((root / "sparse/0" / file).read_bytes())
        struct.pack_into(f"<{form}", data, at, *values)
        (root / "sparse/0" / file).write_bytes(data)

    return spoil


def lens(model: int, *values: float) -> Spoil:
    return lambda root: write_camera(root / "sparse/0/cameras.bin", model, values)


def line(file: str, text: str) -> Spoil:
    """Add a line to COLMAP's text model."""

    def spoil(root: Path) -> None:
        as_text(root)
        with (root / "sparse/0" / file).open("a") as opened:
            opened.write(text)

    return spoil


def rows(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    return lambda root: np.save(root / "poses_bounds.npy", change(np.load(root / "poses_bounds.npy")))


def row(column: int, value: float) -> Spoil:
    def change(array: np.ndarray) -> np.ndarray:
        array[3, column] = value
        return array

    return rows(change)


def exif(**values: Any) -> Spoil:
    return holds("raw/IMG_000.json", json.dumps([values]))


def folder(file: str) -> Spoil:
    return both(gone(file), lambda root: (root / file).mkdir())


SIZED = {"fl_x": 1.25, "fl_y": 1.6, "cx": 0.5, "cy": 0.5}
LARGE = {"fl_x": 80.0, "fl_y": 76.0, "cx": 34.0, "cy": 22.0}
TURN = r"expected a rotation: orthonormal to 0\.001, determinant \+1"


def values(**given: Any) -> Spoil:
    """Set numbers of a lens without distortion."""
    lens = dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    return both(*(put(value, key) for key, value in {**lens, **given}.items()))


def unsized(**given: Any) -> Spoil:
    return both(values(**given), put(GONE, "w"), put(GONE, "h"))


TABLE: dict[str, list[tuple[Spoil, str]]] = {
    "blender": [
        (folder(JSON["blender"]), "transforms_train.json: found something that is not a file"),
        (gone(TEST), "expected a folder with transforms_train.json and transforms_test.json; dataset=transforms reads"),
        *(
            (holds(name, text), f"{name}: found something that is not JSON")
            for name in (JSON["blender"], TEST)
            for text in ("{", "[" * 100_000, '{"a": 1' + "0" * 5000, "\x00", b"\xff\xfe\xfa\x80{")
        ),
        (holds(TEST, ""), f"{TEST}: found an empty file"),
        (holds(TEST, "version https://git-lfs.github.com/spec/v1\noid"), f"{TEST}: found a Git LFS pointer"),
        *((holds(TEST, text), "found a JSON .*, expected a JSON object") for text in ("[]", "3", "null", '"text"')),
        (put(GONE, "camera_angle_x"), "found no 'fl_x', expected the focal length in pixels, or camera_angle_x"),
        *(
            (put(value, "camera_angle_x"), r"expected the field of view in radians, in \(0, pi\)")
            for value in (0, -1, 5e-324, math.pi, 4, *NO_NUMBERS)
        ),
        (gone("train/r_1.png"), r"train\.json: found 2 pictures; 1 that it lists are missing, such as 'train/r_1'"),
        (folder("train/r_1.png"), r"train\.json: found 2 pictures; 1 that it lists"),
        (both(gone("train/r_1.png"), lambda root: (root / "train/r_1.png").symlink_to("r_1.png")), "r_1"),
        (holds("train/r_1.png", "hello"), "r_1.png: found something that is not an image, expected a whole image"),
        *((put(value, "depth_scale", file=TEST), "depth_scale = ") for value in (0, -1, "x", None, math.nan, math.inf)),
        (put(GONE, "frames", 1, "depth_file_path", file=TEST), r"found no 'frames\[1\]\.depth_file_path'"),
        (put("test/no.png", "frames", 1, "depth_file_path", file=TEST), "expected the path of a picture that is"),
        (
            lambda root: Image.new("I;16", (4, 4)).save(root / "test/r_1_depth.png"),
            "r_1_depth.png: found depth of 4x4 pixels, expected 8x8 as the images",
        ),
        *((holds("settings.json", text), "settings.json: found ") for text in ("[]", "{", '{"light": 0}')),
    ],
    "transforms": [
        (gone("transforms.json"), "found no cameras, .*; ctm cameras"),
        (put(GONE, "frames"), "found no 'frames', expected a list of frames"),
        *((put(value, "frames"), "found frames") for value in ([], {}, None, "x", 3, [3], [[]], [None])),
        *((put(GONE, "frames", 1, key), rf"'frames\[1\]\.{key}'") for key in ("file_path", "transform_matrix")),
        *(
            (put(value, "frames", 1, "transform_matrix"), r"found frames\[1\]\.transform_matrix = ")
            for value in (None, [], 3, [[1, 0, 0, 0]] * 2, [[1, 0, 0]] * 4, [[1, 0, 0, 0]] * 3 + [[]], ["abcd"] * 4)
        ),
        *(
            (put(value, "frames", 1, "transform_matrix", *at), r"in frames\[1\]\.transform_matrix, expected 4 rows")
            for at in ((0, 0), (3, 3))
            for value in NO_NUMBERS
        ),
        *(
            (matrix(lambda pose, f=f: np.diag([*f, 1]) @ pose), TURN)
            for f in ((1.01,) * 3, (0.5,) * 3, (1, 1, 2), (0, 0, 0), (-1, 1, 1), (-1, -1, -1))
        ),
        (matrix(lambda pose: np.diag([1, 1, 1, 2]) @ pose), "expected 0 0 0 1 in the last row"),
        *((put(value, "frames", 1, "file_path"), r"frames\[1\]\.file_path = ") for value in ("", 3, None, [], True)),
        *(
            (put(value, "frames", 1, "file_path"), "expected")
            for value in ("..", "/etc/hosts", "a/../../b.png", "../other.png", "a\0b", "x" * 5000)
        ),
        (gone(*(f"images/f_0{i}.png" for i in (2, 3, 4))), "found 2 pictures; 3 .* missing, such as 'images/f_02.png'"),
        (put(0.5, "far"), "found near 1, far 0.5, expected near < far"),
        (put(GONE, "fl_x"), "found no 'fl_x', expected the focal length in pixels, or camera_angle_x"),
        *((put(value, "fl_x"), "found fl_x = ") for value in (0, "x")),
        *((put(value, "cx"), "found cx = ") for value in (math.nan, "x", 1e7)),
        (put("wide", "w"), "found w = 'wide'"),
        (put("x", "k1"), "found k1 = 'x'"),
        (put(math.nan, "frames", 1, "k1"), r"found frames\[1\]\.k1 = nan"),
        (put(0.1, "k4"), "found k4 = 0.1, expected no fisheye lens"),
        (put(True, "is_fisheye"), "found is_fisheye = True"),
        (put([0.1], "distortion_params"), "found distortion_params = .*, expected fl_x, fl_y, cx"),
        (put([0, 0, 0.1, 0], "rolling_shutter"), "found rolling_shutter = .*, expected one pose"),
        (put(50, "frames", 1, "x_fov"), r"found frames\[1\].x_fov = 50, expected camera_angle_x"),
        (put(0.5, "camera_angle_x"), r"camera_angle_x = 0\.5, expected what belongs to fl_x = 20: it is 31\.33"),
        (put(3.5, "camera_angle_y"), "found camera_angle_y = 3.5, expected the field of view"),
        *(
            (put(value, "camera_model"), "found camera_model = .*, expected one of OPENCV, PINHOLE, SIM")
            for value in ("OPENCV_FISHEYE", "EQUIRECTANGULAR", 3, [], {})
        ),
        (put("masks/no.png", "frames", 1, "mask_path"), r"mask_path = 'masks/no\.png', expected the path"),
        (put("../f_00.png", "frames", 1, "mask_path"), "which leads outside"),
        (put(3, "frames", 1, "mask_path"), "mask_path = 3, expected the path of a picture"),
        (put("m.png", "frames", 1, "dynamic_mask_path"), "dynamic_mask_path = 'm.png', expected masks under mask_path"),
        (put(True, "has_mask"), "found has_mask = True, expected masks under mask_path"),
        (put(-3.0, "k1"), r"frames\[\d\] with distortion .*-3, .*expected a lens that maps one to one"),
        (put(32, "w"), r"a picture of 16x12, expected 32x12 as frames\[\d\] of transforms\.json: the picture"),
        (put(["images/no.png"], "test_filenames"), "found 5 frames for training and 0 for testing"),
        (put("all", "test_filenames"), "found test_filenames = 'all', expected a list"),
        (picture("images/f_03.png", 8, 16), "of 16x8"),
        (values(**SIZED), r"fl_x 1\.25, .*, expected pixels .* parts of the sides are"),
        (values(cx=0.53, cy=0.46), "cx 0.53, cy 0.46 for 16x12, expected pixels of a picture of this size"),
        (unsized(cx=0.53, cy=0.46), "cx 0.53, cy 0.46 for 16x12, expected pixels"),
        (values(fl_x=0.5), "fl_x 0.5, .* expected pixels"),
        (values(cx=160.0), "cx 160, .* expected pixels"),
        (unsized(**LARGE), "for 16x12, expected w and h of the pictures that .* are of, about 68x44"),
        (unsized(cx=4.2, cy=2.8), "expected w and h of the pictures .*, about 8.4x5.6"),
    ],
    "colmap": [
        (moved("sparse", "dense"), "found no cameras, expected a folder with sparse/0 and images; ctm cameras"),
        (gone("sparse/0/images.bin"), r"images\.bin: found no such file"),
        (holds("sparse/0/images.bin", b""), r"images\.bin: found an empty file"),
        (packed("cameras.bin", 0, "Q", 2**60), r"cameras\.bin: found 1152921504606846976 cameras at byte 8, exp"),
        (packed("images.bin", 0, "Q", 2**63), r"images\.bin: found \d+ pictures at byte 8"),
        (packed("points3D.bin", 0, "Q", 1000), r"points3D\.bin: found 1000 points at byte 8"),
        (packed("points3D.bin", 51, "Q", 2**61), r"points3D\.bin: found \d+ pictures of point 10 at byte 59"),
        (packed("images.bin", 68, "i", 7), "found picture 9 of camera 7 at byte 72, expected one of the 1 in cameras"),
        (packed("images.bin", 72, "8s", b"\xff" * 8), "found no name of picture 9 at byte 72"),
        (packed("images.bin", 72, "B", 0), "found no name of picture 9"),
        (packed("cameras.bin", 16, "Q", 0), "found camera 1 of 0x16 pixels"),
        (packed("cameras.bin", 16, "Q", 48), r"of 24x16, expected 48x16 as camera 1 of cameras\.bin: the picture"),
        (lens(5, *[1.0] * 8), "camera 1 of model OPENCV_FISHEYE at byte 32, expected one of SIMPLE_PINHOLE, "),
        (lens(99, *[1.0] * 12), "model number 99"),
        (lens(12, *[1.0] * 4), "model SIMPLE_DIVISION .*: colmap image_undistorter makes pinholes of others"),
        (lens(17, 1.0, 1.0), "model EQUIRECTANGULAR .*: pictures cut out of the panorama"),
        (lens(6, *OPENCV[1], 0.0, 0.1, 0.0, 0.0), r"FULL_OPENCV with k4, k5, k6 = \(0\.1, 0\.0, 0\.0\) .*: colmap ima"),
        (lens(0, 0.0, 12.0, 8.0), "focal lengths"),
        (lens(0, math.nan, 12.0, 8.0), "camera parameters"),
        (lens(2, 12.0, 12.0, 8.0, -3.0), "camera 1 with distortion .*, expected a lens that maps one to one"),
        (line("cameras.txt", "1 OPENCV 24 16 1 2 3"), r"line 4, .* \(3 parameters, OPENCV has 8\), expected ID MODEL"),
        (line("cameras.txt", "1 BOX 24 16 1 2 3"), r"cameras\.txt: found line 4, .*'BOX'"),
        (line("cameras.txt", "2 FISHEYE 24 16 1 2 3 4"), "camera 2 of model FISHEYE on line 4, .* image_undistorter"),
        (line("images.txt", "9 1 0 0 0 0 0 0 1 f.png\n1 2"), "line 12, .*2 numbers on the line after it"),
        (line("images.txt", "9 1 0 0 0 0 0 0 7 f.png\n\n"), "picture 9 of camera 7 on line 12"),
        (line("points3D.txt", "12 1 2"), "line 5, "),
        (gone(*(f"images/f_0{i}.png" for i in (2, 3, 4))), r"images\.bin: found 2 pictures; 3 that it lists are miss"),
        (
            both(moved("images", "images_4"), lambda root: shutil.copytree(root / "images_4", root / "images_2")),
            "found only images_2, images_4, expected images, or dataset.downscale=N",
        ),
        (
            lambda root: write_images(
                root / "sparse/0/images.bin", hemisphere(3, 4.0), [[10]] * 3, ["f_00.png", "../../x.png", "f_02.png"]
            ),
            r"images\.bin: found path 'images/\.\./\.\./x\.png', which leads outside",
        ),
    ],
    "llff": [
        (gone("poses_bounds.npy"), "found no cameras, .* ctm cameras"),
        (holds("poses_bounds.npy", b"x"), "poses_bounds.npy: found no array"),
        (rows(lambda array: array[:, :14]), r"found an array \[5, 14\]"),
        (rows(lambda array: array[:4]), "found 4 poses, expected 5"),
        (row(0, math.nan), "found NaN or infinity"),
        (
            both(holds("view_imgs.txt", ""), rows(lambda array: array[:4])),
            "found 4 poses, expected 5, one for each picture in .*images: leave only those .* view_imgs.txt names",
        ),
        (row(0, 3.0), "found row 3 whose 3x3 part is off orthonormal"),
        *((row(14, value), "row 3 with height, width, focal length") for value in (0.0, 1e300)),
        (row(15, -1.0), "row 3 with bounds -1"),
        (row(16, 0.1), "row 3 with bounds"),
        (row(9, 48.0), r"view_003\.png: found a picture of 24x16, expected 48x16 as row 3 of poses_bounds\.npy"),
        (holds("images/view_003.png", b"x"), r"view_003\.png"),
        (moved("images", "pictures"), "found no folder of pictures, expected images, or"),
        (gone("depth/view_000.npy"), "view_000: found no depth"),
    ],
    "rawnerf": [
        (lambda root: os.truncate(root / "raw/IMG_003.dng", 3000), "3.dng: found a file that cannot be developed"),
        (holds("raw/IMG_003.dng", b"hello"), r"IMG_003\.dng: found a file that cannot be"),
        (gone("raw/IMG_003.dng"), "found 5 poses, expected 4"),
        (gone("raw/IMG_003.json"), r"IMG_003\.json: found no such file, expected EXIF"),
        (holds("raw/IMG_003.json", "["), r"IMG_003\.json: found something that is not JSON"),
        (holds("raw/IMG_003.json", "[]"), r"IMG_003\.json: found a JSON list, expected a JSON object"),
        (exif(ShutterSpeed="1/0"), r"IMG_000\.json: found ShutterSpeed = '1/0', expected the shutter time"),
        *((exif(ShutterSpeed=value), "found ShutterSpeed = ") for value in ("long", None, "1e999999999")),
        (exif(ShutterSpeed="1/30", ISO="x"), "found ISO = 'x'"),
        (lambda root: write_dng(root / "raw/IMG_003.dng", np.full((32, 24, 3), 0.1)), "found a picture of 24x32"),
        (lambda root: [path.rename(root / path.name) for path in (root / "raw").iterdir()], "found no raw pictures"),
        (moved("raw", "raws"), "found no folder of pictures, expected images, or"),
    ],
}
CASES = [(layout, *case) for layout, cases in TABLE.items() for case in cases]


@pytest.mark.parametrize(("layout", "spoil", "found"), CASES)
def test_refused(tmp_path, layout, spoil, found):
    spoil(MAKE[layout](tmp_path / layout))
    with pytest.raises(DataError, match=found) as caught:
        DATASETS.get(layout)(root=tmp_path / layout).load()
    message = str(caught.value)
    assert message.startswith(str(tmp_path))
    assert "found " in message
    assert ", expected " in message
    assert "\n" not in message


@pytest.mark.parametrize("root", ["none", "", "file", "a\0b", "~no_such_user/x", "x" * 300])
def test_roots(tmp_path, root):
    (tmp_path / "file").write_text("x")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"found .*, expected a folder with transforms_train\.json and"):
        DATASETS.get("blender")(root=tmp_path / (root or "empty") if root[:1] != "~" else root).load()
