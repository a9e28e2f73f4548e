"""One transforms.json, as instant-ngp and nerfstudio write it."""

import json
import math
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from layouts import HOUSE, INTRINSICS, LENS, transforms_layout

from ctm_plugin.data.transforms import TransformsConfig
from ctm_plugin.errors import ConfigError, CTMError, DataError
from ctm_plugin.scenes.trajectory import forward_facing, hemisphere

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
    return TransformsConfig(root=root, **settings).load()


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


def test_bounds_of_the_configuration_go_first(house):
    scene = load(house, near=0.5, far=9)
    assert (scene.near, scene.far) == (0.5, 9.0)


def test_pinholes_have_no_distortion(house):
    change(house, **dict.fromkeys(LENS), camera_model="PINHOLE")
    assert load(house).train.distortion is None


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


def test_missing_pictures_are_left_out_with_one_warning(house):
    for index in (1, 3, 4):
        (house / f"images/f_{index:02d}.png").unlink()
    with pytest.warns(UserWarning, match=r"3 of 10 pictures are not there and left out, as 'images/f_01\.png'") as seen:
        scene = load(house)
    assert len(seen) == 1
    assert scene.test.names == ("f_00",)
    assert len(scene.train) == 6


def test_alpha_is_kept(tmp_path):
    root = transforms_layout(tmp_path / "cut", hemisphere(4, 4.0), channels=4, camera_angle_x=0.8)
    scene = load(root, near=1, far=7, background="random_matched")
    assert scene.train.has_alpha
    white = load(root, near=1, far=7, downscale=4)
    assert white.train.images.shape == (3, 3, 4, 4)


def test_forward(tmp_path):
    poses = forward_facing(9, (0.0, -4.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.4), seed=1)
    root = transforms_layout(tmp_path / "wall", poses, near=3.0, far=8.0, **INTRINSICS)
    scene = load(root, geometry="forward")
    scale = 1 / (0.75 * 3.0)
    assert (scene.near, scene.far) == (1.0, pytest.approx(8 * scale))
    centre = torch.cat([scene.train.c2w, scene.test.c2w])[:, :, 3].mean(0)
    torch.testing.assert_close(centre, torch.zeros(3), atol=1e-5, rtol=0)


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "EQUIRECTANGULAR", "ORTHOPHOTO", 3, [], {}])
def test_other_cameras(house, model):
    change(house, camera_model=model)
    with pytest.raises(
        DataError, match=r"transforms\.json: found camera_model = .*, expected one of OPENCV, PINHOLE, SIM"
    ):
        load(house)


def drop_pictures(house):
    for index in range(2, COUNT):
        (house / f"images/f_{index:02d}.png").unlink()


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (
            drop_pictures,
            r"transforms\.json: found 2 pictures; 8 that it lists are not there, as 'images/f_02\.png', ex",
        ),
        (lambda house: (house / "transforms.json").unlink(), r"transforms\.json: found no such file"),
        (lambda house: change(house, far=0.5), "found near 1, far 0.5, expected near < far"),
        (
            lambda house: change(house, fl_x=None),
            "found no 'fl_x', expected the focal length in pixels, or camera_angle_x",
        ),
        (lambda house: change(house, fl_x=0), "found fl_x = 0"),
        (lambda house: change(house, w="wide"), "found w = 'wide'"),
        (lambda house: change(house, k1="x"), "found k1 = 'x'"),
        (lambda house: change(house, k4=0.1), "found k4 = 0.1, expected no fisheye lens"),
        (lambda house: change(house, is_fisheye=True), "found is_fisheye = True"),
        (lambda house: change(house, distortion_params=[0.1]), "found distortion_params = .*, expected fl_x, fl_y, cx"),
        (lambda house: change(house, rolling_shutter=[0, 0, 0.1, 0]), "found rolling_shutter = .*, expected one pose"),
        (lambda house: frame(house, "f_03", x_fov=50), r"found frames\[\d\].x_fov = 50, expected camera_angle_x"),
        (
            lambda house: change(house, camera_angle_x=0.5),
            r"found camera_angle_x = 0\.5, expected what belongs to fl_x = 20: it is 31\.33.* pixels of 16",
        ),
        (lambda house: change(house, camera_angle_y=3.5), "found camera_angle_y = 3.5, expected the field of view"),
        (lambda house: change(house, cx=float("nan")), "found cx = nan"),
        (
            lambda house: frame(house, "f_03", mask_path="masks/no.png"),
            r"mask_path = 'masks/no\.png', expected the path",
        ),
        (lambda house: frame(house, "f_03", mask_path="../f_00.png"), "which leads outside"),
        (lambda house: frame(house, "f_03", mask_path=3), "mask_path = 3, expected the path of a picture"),
        (
            lambda house: change(house, k1=-3.0),
            r"frames\[\d\] with distortion .*-3, .*expected a lens that maps one to one",
        ),
        (lambda house: change(house, w=32), r"frames\[\d\] with pictures of 32x12, expected the ratio .* 16x12"),
        (
            lambda house: change(house, test_filenames=["images/no.png"]),
            "found 10 frames for training and 0 for testing",
        ),
        (lambda house: change(house, test_filenames="all"), "found test_filenames = 'all', expected a list"),
        (lambda house: frame(house, "f_03", file_path="../other.png"), "which leads outside"),
        (lambda house: frame(house, "f_03", transform_matrix=[[1]]), r"found frames\[\d\]\.transform_matrix = "),
        (lambda house: iio.imwrite(house / "images/f_03.png", np.zeros((6, 8, 3), np.uint8)), "found an image of 8x6"),
        (
            lambda house: (house / "images/f_03.png").write_bytes(b"x"),
            r"f_03\.png: found something that is not an image",
        ),
    ],
)
def test_spoilt(house, spoil, found):
    spoil(house)
    with pytest.raises(DataError, match=found):
        load(house)


def test_settings_out_of_range(house):
    with pytest.raises(ConfigError, match=r"dataset\.test_every"):
        load(house, test_every=1)
    with pytest.raises(ConfigError, match=r"dataset\.far"):
        load(house, near=3, far=2)
    with pytest.raises(ConfigError, match=r"dataset\.downscale: found 5"):
        load(house, downscale=5)
    with pytest.raises(ConfigError, match=r"the images of .*house have no alpha"):
        load(house, background="random_matched")


ANY_JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.sampled_from([10**400, -(10**400), 0, 1, "..", ".", "/", "\0", "\ud800", "images/f_00.png", "x" * 5000])
    | st.floats()
    | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


@pytest.fixture(scope="module")
def mutated(tmp_path_factory) -> Path:
    content = {**HOUSE, "train_filenames": []}
    return transforms_layout(tmp_path_factory.mktemp("mutated") / "house", hemisphere(4, 4.0), **content)


@pytest.fixture(scope="module")
def original(mutated) -> str:
    return (mutated / "transforms.json").read_text()


@settings(max_examples=120)
@given(data=st.data())
def test_mutated_json_loads_or_is_refused(mutated, original, data):
    content = json.loads(original)
    extra = ["k3", "k4", "test_filenames", "camera_angle_x", "is_fisheye"]
    for _ in range(data.draw(st.integers(1, 3))):
        owner = content
        if content.get("frames") and isinstance(content["frames"], list) and data.draw(st.booleans()):
            owner = data.draw(st.sampled_from(content["frames"]))
        if not isinstance(owner, dict):
            continue
        key = data.draw(st.sampled_from([*owner, *extra]))
        if data.draw(st.booleans()):
            owner.pop(key, None)
        else:
            owner[key] = data.draw(ANY_JSON)
    (mutated / "transforms.json").write_text(json.dumps(content))
    with warnings.catch_warnings(), suppress(CTMError):
        warnings.simplefilter("ignore")
        scene = load(mutated)
        for views in (scene.train, scene.test):
            assert views.c2w.isfinite().all()
            assert views.intrinsics.isfinite().all()
