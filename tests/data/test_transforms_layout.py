"""One transforms.json, as instant-ngp and nerfstudio write it."""

import json
import math
import re
import shutil
import warnings
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from ctm_scenes.trajectory import hemisphere
from layouts import HOUSE, INTRINSICS, LENS, transforms_layout

from ctm_plugin.data.transforms import TransformsConfig
from ctm_plugin.errors import DataError

COUNT, WIDTH, HEIGHT = 10, 16, 12


@pytest.fixture
def house(tmp_path) -> Path:
    return transforms_layout(tmp_path / "house", hemisphere(COUNT, 4.0, seed=3), **HOUSE)


def change(root: Path, **values: Any) -> None:
    """Set the file's values; those that are None go."""
    content = json.loads((root / "transforms.json").read_text()) | values
    content = {key: value for key, value in content.items() if value is not None}
    (root / "transforms.json").write_text(json.dumps(content))


def frame(root: Path, name: str, **values: Any) -> None:
    content = json.loads((root / "transforms.json").read_text())
    (one,) = (frame for frame in content["frames"] if name in frame["file_path"])
    one.update(values)
    (root / "transforms.json").write_text(json.dumps(content))


def load(root: Path, **settings: Any):
    return TransformsConfig(**{"root": root, "geometry": "bounded"} | settings).load()


def test_what_is_read(house):
    scene = load(house)
    assert (scene.name, scene.geometry, scene.near, scene.far, scene.exposure) == ("house", "bounded", 1.0, 7.0, 1.0)
    assert scene.test.names == ("f_00", "f_08")
    assert len(scene.train) == 8
    poses = torch.from_numpy(hemisphere(COUNT, 4.0, seed=3)).float()
    torch.testing.assert_close(scene.test.c2w, poses[[0, 8], :3])
    assert scene.train.intrinsics[3].tolist() == pytest.approx([20.0, 19.0, 8.5, 5.5])
    assert scene.train.distortion[0].tolist() == pytest.approx([-0.1, 0.02, 0.001, -0.002, 0.0])
    assert (scene.test.images[1].numpy() == iio.imread(house / "images/f_08.png")).all()


def test_numbers_of_a_frame_go_first(house):
    frame(house, "f_08", fl_x=25.0, k1=0.05, camera_model="PINHOLE")
    test = load(house).test
    assert test.intrinsics[:, 0].tolist() == [20.0, 25.0]
    assert test.distortion[:, 0].tolist() == pytest.approx([-0.1, 0.05])


def test_angle_instead_of_focal_lengths(house):
    change(house, **dict.fromkeys(INTRINSICS), camera_angle_x=0.8)
    focal = 0.5 * WIDTH / math.tan(0.4)
    assert load(house).test.intrinsics[0].tolist() == pytest.approx([focal, focal, WIDTH / 2, HEIGHT / 2])
    change(house, camera_angle_y=0.6)
    assert load(house).test.intrinsics[0, 1].item() == pytest.approx(0.5 * HEIGHT / math.tan(0.3))


def test_an_angle_of_the_sensor_is_left_aside(house):
    """BlenderNeRF's camera_angle_y is of the sensor's 24 mm beside 36, whatever the picture's shape."""
    of_sensor = {
        "camera_angle_x": 2 * math.atan(WIDTH / 2 / 20),
        "camera_angle_y": 2 * math.atan(2 / 3 * WIDTH / 2 / 20),
    }
    change(house, fl_y=20.0, **of_sensor)
    said = "transforms.json: camera_angle_y is ignored: fl_x, fl_y and camera_angle_x contradict it"
    assert [each.endswith(said) for each in told(house)] == [True]
    assert load(house).test.intrinsics[0, :2].tolist() == [20.0, 20.0]
    change(house, camera_angle_x=None)
    with pytest.raises(DataError, match=r"found camera_angle_y = .*, expected what belongs to fl_y = 20: it is"):
        load(house)
    upright = 24 / 36 * 20
    change(house, fl_x=upright, fl_y=upright, **of_sensor)
    with pytest.raises(DataError, match=r"found camera_angle_x = .*, expected what belongs to fl_x = 13\.33"):
        load(house)


FULL = {"fl_x": 80.0, "fl_y": 76.0, "cx": 34.0, "cy": 22.0}
"""Of pictures four times as large."""


def test_intrinsics_of_larger_pictures_with_their_size(house):
    change(house, **dict.fromkeys(LENS), **FULL, w=64, h=48)
    assert load(house).test.intrinsics[0].tolist() == pytest.approx([20.0, 19.0, 8.5, 5.5])


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"cx": 16.0, "cy": 12.0}, "the principal point is far from the picture's middle: .*cx 16, cy 12 for 16x12"),
        ({"cx": 0, "cy": 0, "w": None, "h": None}, "the principal point is far from the picture's middle"),
        ({"fl_x": 400.0, "fl_y": 400.0}, "a field of view of 2.3 degrees: .* with fl_x 400"),
    ],
)
def test_intrinsics_that_few_lenses_have(house, values, said):
    change(house, **dict.fromkeys(LENS), **values)
    assert [bool(re.search(said, each)) for each in told(house)] == [True]


def test_downscaled(house):
    views = load(house, downscale=2).test
    assert views.images.shape == (2, 6, 8, 3)
    assert views.intrinsics[0].tolist() == pytest.approx([10.0, 9.5, 4.25, 2.75])
    (house / "images_2").mkdir()
    for index in range(COUNT):
        iio.imwrite(house / f"images_2/f_{index:02d}.jpg", np.full((6, 8, 3), 77, dtype=np.uint8))
    ready = load(house, downscale=2).test
    assert (ready.images.float() - 77).abs().max() <= 2
    torch.testing.assert_close(ready.intrinsics, views.intrinsics)
    change(house, w=None, h=None)
    torch.testing.assert_close(load(house, downscale=2).test.intrinsics, views.intrinsics)


def test_lists_of_files(house):
    names = [f"images/f_{index:02d}.png" for index in range(COUNT)]
    change(house, train_filenames=names[:5], val_filenames=names[5:7], test_filenames=names[7:9])
    scene = load(house)
    assert scene.train.names == ("f_00", "f_01", "f_02", "f_03", "f_04")
    assert scene.test.names == ("f_07", "f_08")
    change(house, train_filenames=None, test_filenames=None)
    scene = load(house)
    assert scene.test.names == ("f_05", "f_06")
    assert len(scene.train) == 8


def told(root: Path, **settings: Any) -> list[str]:
    """What loading warns of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load(root, **settings)
    return [str(each.message) for each in caught]


def split_up(root: Path, test: int, **more: Any) -> None:
    """A file a split in place of the one; the last ``test`` frames by name are for testing."""
    content = json.loads((root / "transforms.json").read_text())
    frames = sorted(content["frames"], key=lambda frame: frame["file_path"])
    for split, part in (("train", frames[:-test]), ("test", frames[-test:])):
        (root / f"transforms_{split}.json").write_text(json.dumps({**content, "frames": part, **more}))
    (root / "transforms.json").unlink()


def test_a_file_a_split(house):
    whole = load(house)
    split_up(house, 3)
    content = json.loads((house / "transforms_test.json").read_text())
    (house / "transforms_test.json").write_text(json.dumps({**content, "fl_x": 22.0}))
    scene = load(house)
    assert scene.test.names == ("f_07", "f_08", "f_09")
    assert scene.train.names == tuple(f"f_{index:02d}" for index in range(7))
    assert torch.equal(scene.test.images[1], whole.test.images[1])
    assert scene.train.intrinsics[0].tolist() == pytest.approx([20.0, 19.0, 8.5, 5.5])
    assert scene.test.intrinsics[0].tolist() == pytest.approx([22.0, 19.0, 8.5, 5.5])
    assert scene.test.distortion[0].tolist() == pytest.approx([-0.1, 0.02, 0.001, -0.002, 0.0])
    (house / "transforms_test.json").rename(house / "transforms_val.json")
    assert load(house).test.names == scene.test.names


@pytest.mark.parametrize("split", ["train", "test", "val"])
def test_a_file_of_one_split_alone_is_like_one_file(house, split):
    (house / "transforms.json").rename(house / f"transforms_{split}.json")
    assert load(house).test.names == ("f_00", "f_08")


def test_both_kinds_of_files(house):
    one = (house / "transforms.json").read_text()
    split_up(house, 3)
    (house / "transforms.json").write_text(one)
    said = r"house: transforms_train\.json and transforms_test\.json are used, transforms\.json is not"
    with pytest.warns(UserWarning, match=said):
        assert len(load(house).test) == 3
    (house / "transforms_test.json").unlink()  # a training file without tests is half of a pair
    assert told(house) == []
    assert load(house).test.names == ("f_00", "f_08")


def test_a_picture_of_both_splits(house):
    split_up(house, 3)
    content = json.loads((house / "transforms_train.json").read_text())
    more = json.loads((house / "transforms_test.json").read_text())["frames"][1:2]
    (house / "transforms_train.json").write_text(json.dumps({**content, "frames": content["frames"] + more}))
    assert [r"1 of 3 test views are also trained on, such as 'images/f_08.png'" in each for each in told(house)] == [
        True
    ]


def test_pictures_of_two_sizes_say_each_their_own(house):
    """Without a size of its own nobody knows what a camera's pixels are."""
    content = json.loads((house / "transforms.json").read_text())
    size = {key: content.pop(key) for key in ("w", "h")}
    iio.imwrite(house / "images/f_03.png", np.zeros((6, 8, 3), np.uint8))
    (house / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"found no 'frames\[\d\]\.w', expected w and h of each frame's picture"):
        load(house)
    for each in content["frames"]:
        each |= {"w": 8, "h": 6, "fl_x": 10} if "f_03" in each["file_path"] else size
    (house / "transforms.json").write_text(json.dumps(content))
    with pytest.warns(UserWarning, match="of 2 sizes"):
        views = load(house).train
    index = views.names.index("f_03")
    assert views.mask[index].nonzero().amax(0).tolist() == [5, 7]
    assert views.intrinsics[index, 0] == 10


def test_instant_ngp_s_masks_beside(house):
    """What is not black in ``dynamic_mask_NAME.png`` is not looked at; pictures without one count whole."""
    level = np.zeros((12, 16), np.uint8)
    level[:, 3:5] = 1
    iio.imwrite(house / "images/dynamic_mask_f_03.png", level)
    views = load(house).train
    index = views.names.index("f_03")
    np.testing.assert_array_equal(views.mask[index], level == 0)
    assert views.mask.sum() == views.mask.numel() - 24


def test_tests_of_a_list_that_are_not_there_are_kept(house):
    change(house, test_filenames=["images/f_02.png", "./images/f_03.png"])
    (house / "images/f_02.png").unlink()
    with pytest.warns(UserWarning, match="of 2 test views have no picture to score against, such as 'images/f_02.png'"):
        scene = load(house)
    assert scene.test.pictured.tolist() == [False, True]
    assert len(scene.train) == 8
    torch.testing.assert_close(scene.test.c2w[0], torch.from_numpy(hemisphere(COUNT, 4.0, seed=3)).float()[2, :3])


def test_masks_of_frames(house):
    (house / "masks").mkdir()
    mask = np.zeros((12, 16), dtype=np.uint8)
    mask[:, :5] = 255
    iio.imwrite(house / "masks/m_02.png", mask)
    frame(house, "f_02", mask_path="masks\\m_02")
    change(house, has_mask=True)  # ScanNet++'s
    assert told(house) == []
    masks = load(house).train.mask
    assert masks.shape == (8, 12, 16)
    assert (masks[1].numpy() == (mask > 0)).all()  # f_01 is the first
    assert masks[[0, 2, 3]].all()


def test_what_tools_write_beside_cameras(house):
    """What says nothing about the cameras is let be, what nobody knows here is told once."""
    known = {"aabb_scale": 16, "scale": 0.5, "offset": [0.5, 0.5, 0.5], "applied_transform": [[1, 0, 0, 0]] * 3}
    change(
        house, **known, has_mask=False, rolling_shutter=[0, 0, 0, 0], k4=0, is_fisheye=False, distortion_params=None,
        fov=0,
    )  # fmt: skip
    frame(house, "f_03", sharpness=20.0, colmap_im_id=3, depth_file_path="depths/f_03.png")
    assert told(house) == []
    change(house, zoom=3)
    frame(house, "f_03", shutter=0.5)
    frame(house, "f_04", shutter=0.5)
    assert [each.split("transforms.json: ")[1] for each in told(house)] == [
        "what 'zoom', 'shutter' say is not known here and not used"
    ]


def rename(house: Path, names) -> None:
    """Frames call their pictures otherwise than the folder does."""
    content = json.loads((house / "transforms.json").read_text())
    for each in content["frames"]:
        each["file_path"] = names(each["file_path"].removeprefix("./images/"))
    (house / "transforms.json").write_text(json.dumps(content))


@pytest.mark.parametrize(
    "names",
    [
        lambda name: f"images/{name.upper()}",
        lambda name: f"Images/{name.removesuffix('.png')}",
        lambda name: f"images/{name.replace('.png', '.JPG')}",
        lambda name: f".\\images\\{name}",
        lambda name: "ROOT/images/" + name,
    ],
)
def test_names_that_other_systems_take_for_the_same(house, names):
    rename(house, lambda name: names(name).replace("ROOT", str(house)))
    assert load(house).test.names == ("f_00", "f_08")


def test_umlauts_of_two_kinds(house):
    (house / "images/f_03.png").rename(house / "images/fu\u0308r 3.png")
    frame(house, "f_03", file_path="images/f\u00fcr 3.png")
    assert told(house) == []


def test_where_pictures_lie_is_said(house):
    rename(house, lambda name: name)
    with pytest.raises(DataError, match=r"as 'f_00\.png', expected at least 3 .*: f_00\.png lies in images"):
        load(house)
    rename(house, lambda name: f"images/{name}")
    for path in list((house / "images").iterdir()):
        path.rename(house / path.name)
    with pytest.raises(DataError, match=r"f_00\.png lies next to transforms\.json, not in images"):
        load(house)
    for path in list(house.glob("*.png")):
        path.rename(house / "images" / path.name)
    (house / "images").rename(house / "images_2")
    with pytest.raises(DataError, match=r"f_00\.png lies in images_2, which is dataset\.downscale=2"):
        load(house)


def test_pictures_of_another_kind(house):
    """BMP is refused with the way out, and a picture that was made out of it is taken."""
    frame(house, "f_03", file_path="images/f_03.BMP")
    (house / "images/f_03.BMP").write_bytes(b"BM" + bytes(60))
    assert told(house) == []
    (house / "images/f_03.png").unlink()
    with pytest.raises(DataError, match=r"f_03\.BMP: found a picture of BMP's kind, .*mogrify -format png"):
        load(house)


def test_a_frames_focal_length_goes_before_the_files_angle(house):
    change(house, fl_x=None, fl_y=None, camera_angle_x=0.8)
    frame(house, "f_08", fl_x=30.0)
    assert load(house).test.intrinsics[:, 0].tolist() == pytest.approx([0.5 * WIDTH / math.tan(0.4), 30.0])


def test_a_pose_without_its_last_row(house):
    whole = load(house)
    frame(house, "f_08", transform_matrix=hemisphere(COUNT, 4.0, seed=3)[8, :3].tolist())
    assert torch.equal(load(house).test.c2w, whole.test.c2w)


def test_pictures_of_a_file_that_lists_shrunk_ones(house):
    """``images_4`` lies there too, but the file lists others: these are shrunk."""
    shutil.copytree(house / "images", house / "images_4")
    (house / "images").rename(house / "low")
    rename(house, lambda name: f"low/{name}")
    assert load(house, downscale=4).test.images.shape == (2, 3, 4, 3)


def test_the_file_as_the_folder(house):
    with pytest.raises(DataError, match=f"found a file, expected its folder, dataset.root={house}"):
        load(house / "transforms.json")
