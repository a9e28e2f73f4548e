"""COLMAP's binary model, written here by its documented format, read, damaged and mutated."""

import re
import shutil
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from ctm_scenes.trajectory import hemisphere
from layouts import COUNT, NAMES, OPENCV, POINTS, as_text, colmap_layout, world_to_camera, write_images, write_points
from scipy.spatial.transform import Rotation

from ctm_plugin.data.colmap import ColmapConfig
from ctm_plugin.data.readers.colmap_model import mark_as_shown, read_cameras, read_images, read_points
from ctm_plugin.errors import DataError
from ctm_plugin.rays.cameras import camera_rays, distort

FILES = ("cameras.bin", "images.bin", "points3D.bin")


def load(root: Path, **settings):
    return ColmapConfig(**{"root": root, "geometry": "bounded"} | settings).load()


def test_what_is_read(yard):
    scene = load(yard)
    assert (scene.name, scene.geometry, scene.exposure) == ("yard", "bounded", 1.0)
    assert scene.test.names == ("f_00", "f_08")
    assert (scene.test.images[1] == 85).all()
    poses = torch.from_numpy(hemisphere(COUNT, 4.0, seed=3)).float()
    torch.testing.assert_close(scene.test.c2w, poses[[0, 8], :3], atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(scene.train.c2w, poses[1:8, :3], atol=1e-6, rtol=1e-6)
    assert scene.train.intrinsics[0].tolist() == [30.0, 29.0, 12.5, 7.5]
    assert scene.train.distortion[0].tolist() == pytest.approx([-0.08, 0.01, 0.001, -0.002, 0.0])


def test_bounds_hold_the_points(yard):
    """Percentiles of all depths, worked out by projecting the points."""
    scene = load(yard)
    homogeneous = np.append(POINTS, np.ones((4, 1)), axis=1).T
    depths = [-(np.linalg.inv(pose) @ homogeneous)[2] for pose in hemisphere(COUNT, 4.0, seed=3)]
    low, high = np.percentile(depths, (0.5, 99.5))
    assert scene.near == pytest.approx(0.9 * low, rel=1e-6)
    assert high < scene.far < 1.3 * high
    given = load(yard, near=1, far=20)
    assert (given.near, given.far) == (1.0, 20.0)
    (yard / "sparse/0/points3D.bin").unlink()
    assert load(yard, near=1, far=20).far == 20.0


@pytest.mark.parametrize(
    ("camera", "intrinsics", "distortion"),
    [
        ((0, (30.0, 12.0, 8.0)), (30, 30, 12, 8), None),
        ((1, (30.0, 29.0, 12.0, 8.0)), (30, 29, 12, 8), None),
        ((2, (30.0, 12.0, 8.0, 0.1)), (30, 30, 12, 8), (0.1, 0, 0, 0, 0)),
        ((3, (30.0, 12.0, 8.0, 0.1, -0.02)), (30, 30, 12, 8), (0.1, -0.02, 0, 0, 0)),
        (OPENCV, OPENCV[1][:4], (*OPENCV[1][4:], 0)),
        ((6, (*OPENCV[1], 0.03, 0.0, 0.0, 0.0)), OPENCV[1][:4], (*OPENCV[1][4:], 0.03)),
        ((4, (*OPENCV[1][:4], 0.0, 0.0, 0.0, 0.0)), OPENCV[1][:4], None),
    ],
    ids=["simple_pinhole", "pinhole", "simple_radial", "radial", "opencv", "full_opencv", "opencv_without"],
)
def test_models(tmp_path, camera, intrinsics, distortion):
    views = load(colmap_layout(tmp_path / "yard", hemisphere(COUNT, 4.0), camera)).train
    assert views.intrinsics[0].tolist() == pytest.approx(intrinsics)
    if distortion is None:
        assert views.distortion is None
    else:
        assert views.distortion[0].tolist() == pytest.approx(distortion)


def test_a_point_is_seen_where_colmap_projects_it(yard):
    """COLMAP's own chain, in float64: world to camera, pinhole, OpenCV's distortion, pixels; then back by the ray."""
    scene = load(yard)
    quaternion, translation = world_to_camera(hemisphere(COUNT, 4.0, seed=3)[8])
    turn = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    for position in POINTS:
        x, y, z = turn @ position + translation
        u, v = distort(*torch.tensor([x / z, y / z]), torch.tensor([*OPENCV[1][4:], 0.0], dtype=torch.float64))
        column, row = torch.stack([30 * u + 12.5]).float(), torch.stack([29 * v + 7.5]).float()
        views = scene.test
        rays = camera_rays(views.c2w[1:], views.intrinsics[1:], column, row, views.distortion[1:])
        away = torch.from_numpy(position).float() - rays.origins[0]
        torch.testing.assert_close(away / away.norm(), rays.directions[0], atol=1e-5, rtol=0)


@pytest.mark.parametrize("place", ["sparse", "colmap/sparse/0", "colmap_sparse/0", "colmap_text", "colmap_sparse/1"])
def test_places_of_a_model(yard, place):
    (yard / "sparse").rename(yard / "before")
    (yard / place).parent.mkdir(exist_ok=True, parents=True)
    (yard / "before/0").rename(yard / place)
    assert load(yard).test.names == ("f_00", "f_08")


def test_a_model_as_text(yard):
    binary = load(yard)
    as_text(yard)
    text = load(yard)
    assert (text.near, text.far) == pytest.approx((binary.near, binary.far), rel=1e-9)
    assert text.train.names == binary.train.names
    for name in ("c2w", "intrinsics", "distortion"):
        torch.testing.assert_close(getattr(text.train, name), getattr(binary.train, name), atol=1e-6, rtol=1e-6)


def test_where_else_the_model_lies(yard):
    """COLMAP's other models, names with the pictures' folder, folders above and below."""
    (yard / "sparse/0").rename(yard / "sparse/1")
    assert len(load(yard).train) == 7
    shutil.copytree(yard / "sparse/1", yard / "sparse/2")
    with pytest.warns(UserWarning, match="the model in 1 is used, 2 not"):
        load(yard)
    shutil.rmtree(yard / "sparse/2")
    for root in (yard.parent, yard / "images", yard / "sparse/1"):
        with pytest.raises(DataError, match=f"no cameras, .*; {yard} has them: dataset=colmap dataset.root={yard}"):
            load(root)
    names = [f"images/f_{index:02d}.png" for index in range(COUNT)]
    write_images(yard / "sparse/1/images.bin", hemisphere(COUNT, 4.0), [[10]] * COUNT, names)
    assert len(load(yard).train) == 7


def test_no_points(yard):
    write_points(yard / "sparse/0/points3D.bin", POINTS[:0])
    with pytest.warns(UserWarning, match=r"no points that the pictures see; 2 and 8 are taken from where the cameras"):
        scene = load(yard)
    assert (scene.near, scene.far) == pytest.approx((2.0, 8.0), rel=1e-6)


def test_a_model_in_a_folder_without_pictures(yard):
    """As 3DGS' convert.py may leave it."""
    (yard / "dense").mkdir()
    (yard / "sparse").rename(yard / "dense/sparse")
    with pytest.raises(DataError, match=f"{yard}/dense has them without pictures: move its folder sparse to {yard}"):
        load(yard)
    shutil.copytree(yard / "images", yard / "dense/images")
    with pytest.raises(DataError, match=f"{yard}/dense has them: dataset=colmap dataset.root={yard}/dense"):
        load(yard)


def test_photographs_alone(yard):
    shutil.rmtree(yard / "sparse")
    with pytest.raises(DataError, match=f"found no cameras, .*; ctm cameras {yard} finds those of the photographs in"):
        load(yard)
    (yard / "images").rename(yard / "low")
    with pytest.raises(DataError, match=f"ctm cameras {yard} pictures=low finds"):
        load(yard)
    with pytest.raises(DataError, match=f"ctm cameras {yard}/low finds those of the photographs, for dataset=colmap"):
        load(yard / "low")


def test_pictures_elsewhere(yard):
    """The only folder that holds them is taken; of two, one has to be chosen."""
    whole = load(yard)
    (yard / "other").mkdir()
    (yard / "images").rename(yard / "low")
    assert torch.equal(load(yard).test.images, whole.test.images)
    shutil.copytree(yard / "low", yard / "high")
    with pytest.raises(DataError, match=r"found pictures in high, low, expected dataset\.images=high or dataset\."):
        load(yard)
    assert torch.equal(load(yard, images="low").test.images, whole.test.images)
    with pytest.raises(DataError, match=r"mid: found no such folder, expected the folder of the pictures"):
        load(yard, images="mid")
    with pytest.raises(DataError, match="which leads outside"):
        load(yard, images="../yard2")


def test_dng_points_to_the_layout_that_reads_it(yard):
    (yard / "images/f_03.png").rename(yard / "images/f_03.dng")
    names = [f"f_{index:02d}.png" for index in range(COUNT)]
    names[3] = "f_03.dng"
    write_images(yard / "sparse/0/images.bin", hemisphere(COUNT, 4.0, seed=3), [[10, 11]] * COUNT, names)
    with pytest.raises(DataError, match=r"f_03\.dng: found a raw picture, expected .* dataset=rawnerf"):
        load(yard)


@pytest.mark.parametrize("values", [(5.0, 0, 0, 0, 0), (0, 0, 0, 0, 0), (1, 0, 0, 0, np.nan)])
def test_one_picture_that_cannot_be_is_left_out(yard, values):
    expected = load(yard, test_every=4)
    path = yard / "sparse/0/images.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<5d", data, 8 + 4, *values)
    path.write_bytes(data)
    said = r"images\.bin: found picture 13 with the pose .* at byte 72, expected a qua.*; 1 of 9 pictures are left out"
    with pytest.warns(UserWarning, match=said) as seen:
        scene = load(yard, test_every=4)
    assert len(seen) == 1
    assert expected.test.names == ("f_00", "f_04", "f_08")
    assert scene.test.names == ("f_00", "f_04")
    torch.testing.assert_close(scene.train.c2w, expected.train.c2w)


@pytest.mark.parametrize("name", FILES)
def test_whatever_is_cut_is_refused(yard, name):
    """No length that a file claims is believed."""
    path = yard / "sparse/0" / name
    cameras, content = read_cameras(yard / "sparse/0/cameras.bin"), path.read_bytes()
    read = dict(zip(FILES, (read_cameras, lambda path: read_images(path, cameras), read_points), strict=True))[name]
    for length in range(1, len(content), 1 + len(content) // 300):
        path.write_bytes(content[:length])
        with pytest.raises(DataError, match=rf"{name}: found .* at byte \d+, expected"):
            read(path)


@pytest.mark.parametrize("number", ["-nan(ind)", "nan", "inf", "-1.#IND", "1.#QNAN", "0"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_one_camera_that_cannot_be_is_left_out(yard, number, encoding):
    """As RealityScan writes it on Windows, whose editors put a byte order mark before a text."""
    as_text(yard)
    model = yard / "sparse/0"
    cameras = "".join(f"{index} PINHOLE 24 16 30 29 12.5 7.5\n" for index in range(COUNT))
    cameras = cameras.replace("3 PINHOLE 24 16 30 29", f"3 PINHOLE 24 16 {number} {number}")
    (model / "cameras.txt").write_text(cameras, encoding=encoding)
    lines = (model / "images.txt").read_text().splitlines()
    own = [re.sub(r" 1 (f_\d\d)", rf" {line.split()[0]} \1", line) if "f_" in line else line for line in lines]
    (model / "images.txt").write_text("\n".join(own) + "\n", encoding=encoding)
    with pytest.warns(UserWarning, match=r"cameras\.txt: found .* on line 4, .*; 1 of 9 pictures are left out") as seen:
        scene = load(yard)
    assert len(seen) == 1
    assert scene.train.names == tuple(f"f_{index:02d}" for index in (1, 2, 3, 4, 6, 7, 8))
    assert scene.train.intrinsics[0].tolist() == [30.0, 29.0, 12.5, 7.5]


def test_a_model_of_few_of_the_pictures(yard):
    """The others may lie in 3DGS' own folder ``input``."""
    names = [f"f_{index:02d}.png" for index in range(3)]
    write_images(yard / "sparse/0/images.bin", hemisphere(3, 4.0), [[10]] * 3, names)
    with pytest.warns(UserWarning, match=r"images: the model has the cameras of 3 of 9 pictures; the others are not"):
        load(yard)
    (yard / "images").rename(yard / "input")
    with pytest.warns(UserWarning, match="input: the model has the cameras of 3 of 9 pictures"):
        load(yard)
    (yard / "images").mkdir()
    for name in names:
        (yard / "input" / name).replace(yard / "images" / name)
    with pytest.warns(UserWarning, match="input: the model has the cameras of 3 of 6 pictures") as seen:
        load(yard)
    assert len(seen) == 1
    mark_as_shown(yard / "sparse/0", names)  # of the pictures that it leaves out, ctm cameras speaks itself
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load(yard)


def test_points_without_tracks(yard):
    """As of programs that know the poses already: those count that project into the views."""
    write_images(yard / "sparse/0/images.bin", hemisphere(COUNT, 4.0, seed=3), [[]] * COUNT, NAMES)
    far = np.concatenate([POINTS, [[0, 0, -500.0]]])  # seen by no camera
    write_points(yard / "sparse/0/points3D.bin", far)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load(yard)
    depths = []
    for pose in hemisphere(COUNT, 4.0, seed=3):
        x, y, z, _ = np.linalg.inv(pose) @ np.append(far, np.ones((5, 1)), axis=1).T
        column, row = 12.5 - 30 * x / z, 7.5 + 29 * y / z
        depths.append(-z[(z < 0) & (column >= 0) & (column <= 24) & (row >= 0) & (row <= 16)])
    assert scene.near == pytest.approx(0.9 * np.percentile(np.concatenate(depths), 0.5), rel=1e-6)
    assert scene.far < 10
    assert len(scene.points.positions) == 5
