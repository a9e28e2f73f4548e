"""``transforms.json``, or one a split, with full intrinsics and lenses, as instant-ngp and nerfstudio write it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from ctm_plugin.data.capture import Capture, Photograph
from ctm_plugin.data.develop import DYNAMIC_PREFIX
from ctm_plugin.data.lit_references import as_captured, check_folder
from ctm_plugin.data.load import Layout
from ctm_plugin.data.photographs import every_nth, existing, find_listed, has_shrunk, masks_beside
from ctm_plugin.data.points import model_beside, ply_named
from ctm_plugin.data.readers.folders import inside, plain_name
from ctm_plugin.data.readers.frames import SIZE_KEYS, check_keys, frames_of, read_camera, read_pose
from ctm_plugin.data.readers.images import PictureFile, read_picture
from ctm_plugin.data.readers.layouts import TEST, TRAIN, TRANSFORMS, VAL, open_layout
from ctm_plugin.data.readers.lens import Intrinsics
from ctm_plugin.data.readers.records import Record, read_record
from ctm_plugin.data.settings import TransformsSettings
from ctm_plugin.errors import ConfigError, DataError
from ctm_plugin.scene.poses import MAX_COORDINATE


class TransformsConfig(Layout, TransformsSettings):
    layout = "transforms"

    def capture(self) -> Capture:
        """Read a data set with a ``transforms.json``, or with one for each split.

        The pair of files goes before the single one; ``transforms_val.json`` stands in for a missing test file. In one
        file, ``test_filenames`` are for testing, else ``val_filenames``, else what ``train_filenames`` leaves out, else
        every eighth.

        Cameras: ``fl_x fl_y cx cy w h k1 k2 k3 p1 p2 camera_angle_x camera_angle_y camera_model``, of the file or of a
        frame. ``mask_path`` is read, or instant-ngp's ``dynamic_mask_NAME.png``; ``near``, ``far`` and
        ``ply_file_path`` too. A key that would change rays in another way is refused. A warning names other keys that
        are not read.

        ``lit`` is a folder of test views in normal light. Each such view is then rendered, and scored against its lit
        picture; ``dark`` is the folder with the same views as captured, where files list the lit ones.

        Near and far come from the command line, the file, COLMAP's model or the points of ``ply_file_path``; else from
        where the cameras stand and look. A warning says which. A model whose cameras are not the file's is not used.

        Training views whose picture is missing are left out, test views are kept without it, each with one warning.
        Where a file is listed under ``images`` and there is a folder ``images_<downscale>``, its picture is taken.
        """
        root = open_layout(self.root, self.layout)
        check_folder(root, "dataset.dark", self.dark)
        check_folder(root, "dataset.lit", self.lit)
        return capture_of(root, read_files(root), self.dark, self.lit, self.test_every, self.whole_factor)


class Listed(NamedTuple):
    """A frame listed in a ``transforms.json``, with its picture files.

    Attributes:
        record, frame: the JSON file and the frame's entry in it.
        name: name of the picture as captured; ``None``: the files do not name it.
        path: path of the picture as captured; ``None``: it does not exist.
        lit: name of the view's lit reference, with ``dataset.lit``.
        testing: whether the frame is for testing; ``None``: no file says.
    """

    record: Record
    frame: Record
    name: str | None
    path: Path | None
    lit: str | None
    testing: bool | None


def read_files(root: Path) -> list[tuple[Record, bool | None]]:
    """Read a folder's JSON files, and whether their frames are for testing; ``None`` where the files leave that open.

    ``transforms_train.json`` with ``transforms_test.json``, else with ``transforms_val.json``; without such a pair
    ``transforms.json``, else the one that is there.
    """
    there = [name for name in (TRANSFORMS, TRAIN, TEST, VAL) if (root / name).exists()]
    test = next((name for name in (TEST, VAL) if name in there), None)
    if TRAIN in there and test:
        if TRANSFORMS in there:
            warnings.warn(f"{root}: {TRAIN} and {test} are used, {TRANSFORMS} is not", stacklevel=3)
        return [(read_record(inside(root, TRAIN)), False), (read_record(inside(root, test)), True)]
    return [(read_record(inside(root, there[0] if there else TRANSFORMS)), None)]


def capture_of(
    root: Path,
    files: Sequence[tuple[Record, bool | None]],
    dark: str | None = None,
    lit: str | None = None,
    test_every: int = 8,
    whole_factor: int = 1,
    synthetic: bool = False,
) -> Capture:
    """Make the capture of these JSON files, each given with whether its frames are for testing.

    ``synthetic``: files of Synthetic-NeRF's kind, whose views stay in the files' order, with depth. For the other
    arguments see :class:`TransformsConfig`. DataError: sizes or depth are not given.
    """
    records = [record for record, _ in files]
    source, frames = records[0].source, [frame for record in records for frame in frames_of(record)]
    check_keys(owner for record in records for owner in (record, *frames_of(record)))
    whole = all(frame_name(frame).startswith("images/") for frame in frames)
    factor = whole_factor if whole and has_shrunk(root, whole_factor) else 1
    order = None if synthetic else frame_name
    train, test = split(list_frames(root, files, dark, lit, factor, order), source, test_every)
    scale = 1.0
    if depths := synthetic and "depth_scale" in records[-1]:
        expected = "scene units a step, a number > 0"
        scale = records[-1].number("depth_scale", lambda value: 0 < value <= MAX_COORDINATE, expected)
    pictures = {each.path: read_picture(each.path) for each in (*train, *test) if each.path}
    first = next(iter(pictures.values()))
    several = len({picture.header[:2] for picture in pictures.values()}) > 1
    photographs: list[Photograph] = []
    remarks: dict[str, str] = {}
    for each in (*train, *test):
        if several and not synthetic and not all(key in each.frame or key in each.record for key in SIZE_KEYS):
            raise each.frame.fault("w", "w and h of each frame's picture: there are several sizes")
        size = pictures.get(each.path, first).header
        camera = read_camera(each.record, each.frame, factor * size.width, factor * size.height, remarks)
        taken = photograph(root, each, camera, pictures.get(each.path), factor)
        if depths and each.testing:
            name = each.frame.text("depth_file_path", "the depth picture's path")
            depth = find_listed(root, name, each.record.source)
            if depth is None:
                raise each.frame.fault("depth_file_path", "the path of a picture that is there")
            taken = replace(taken, depth=depth)
        photographs.append(replace(taken, shown=synthetic))
    for remark in remarks.values():
        warnings.warn(f"{source}: {remark}", stacklevel=2)
    if not (synthetic or any(each.mask for each in photographs)):
        there = [number for number, each in enumerate(photographs) if each.picture]
        names = [inner(photographs[number].path.relative_to(root)) for number in there]
        for number, mask in zip(there, masks_beside(root, names), strict=True):
            photographs[number] = replace(photographs[number], mask=mask)
    poses = [(each.name, each.c2w) for each in photographs]
    clouds = (cache(lambda: model_beside(root, poses)), cache(lambda: ply_named(root, records[0])))
    return Capture(
        root,
        source,
        photographs,
        testing=np.arange(len(photographs)) >= len(train),
        shrunk=factor > 1,
        depth_scale=scale,
        records=records,
        clouds=() if synthetic else clouds,
        synthetic=synthetic,
    )


def list_frames(
    root: Path,
    files: Sequence[tuple[Record, bool | None]],
    dark: str | None,
    lit: str | None,
    factor: int,
    order: Callable[[Record], str] | None,
) -> list[Listed]:
    """List all frames, file after file in this order, without those that a file's lists leave out.

    ``test_filenames``, else ``val_filenames`` are for testing, and ``train_filenames``, else all others for training;
    with only ``train_filenames``, all others are for testing. Raises a ConfigError for training pictures in ``lit``.
    """
    dark, lit = (None if name is None else plain_name(name) for name in (dark, lit))
    listed = []
    for record, testing in files:
        train, test = name_list(record, "train_filenames"), name_list(record, "test_filenames", "val_filenames")
        for frame in sorted(frames_of(record), key=order) if order else frames_of(record):
            name, use = frame_name(frame), testing
            if testing is None and (train or test):
                use = name in test if test else name not in train
                if train and test and name not in train | test:
                    continue
            captured, reference = as_captured(name, dark, lit)
            if captured is None and not use:
                expected = f"a folder without training pictures, such as {name} of {record.source}, or dataset.dark too"
                raise ConfigError("dataset.lit", lit, expected)
            path = captured and find_listed(root, resized(root, captured, factor), record.source)
            listed.append(Listed(record, frame, captured, path, reference, use))
    return listed


def name_list(record: Record, *keys: str) -> set[str]:
    """Read the set of names under the first of these keys that has any."""
    key = next((key for key in keys if record.values.get(key)), None)
    names = record.texts(key, "a list of the frames' file_path") if key else ()
    return {plain_name(name, record.source.parent) for name in names}


def frame_name(frame: Record) -> str:
    """Read the picture's path as the file gives it, see :func:`ctm_plugin.data.readers.folders.plain_name`."""
    return plain_name(frame.text("file_path", "the picture's path"), frame.source.parent)


def inner(path: Path) -> Path:
    """Drop a path's first folder, that of the pictures, if it has one."""
    return Path(*path.parts[1:]) if len(path.parts) > 1 else path


def resized(root: Path, name: str, factor: int) -> str:
    """Rename ``images/a.png`` to ``images_4/a.png`` for factor 4 if that folder exists, masks alike; else unchanged."""
    first, *rest = PurePosixPath(name).parts or (name,)
    folder = f"{first}_{factor}"
    there = first in ("images", "masks") and rest and factor > 1 and (root / folder).is_dir()
    return str(PurePosixPath(folder, *rest)) if there else name


def split(listed: list[Listed], source: Path, test_every: int) -> tuple[list[Listed], list[Listed]]:
    """Choose the frames to train on and those for testing; at least one for each, else a DataError.

    Where no file tells them apart, every ``test_every``-th of those whose pictures are there is for testing.
    """
    testing = [each for each in listed if each.testing]
    training = [each for each in listed if not each.testing]
    if training:
        there = existing(source.parent, [each.path for each in training], [str(each.name) for each in training], source)
        training = [training[i] for i in there]
    if all(each.testing is None for each in listed):
        chosen = every_nth(test_every, len(training)).tolist()
        listed = [each._replace(testing=tested) for each, tested in zip(training, chosen, strict=True)]
        testing = [each for each in listed if each.testing]
        training = [each for each in listed if not each.testing]
    if not (training and testing):
        found = f"{len(training)} frames for training and {len(testing)} for testing whose pictures are there"
        raise DataError(source, found, "at least one for each: see train_filenames and test_filenames")
    missing = [each.name or each.lit for each in testing if each.path is None]
    if missing:
        text = f"{len(missing)} of {len(testing)} test views have no picture to score against, such as {missing[0]!r}"
        warnings.warn(f"{testing[0].record.source}: {text}: they are only rendered", stacklevel=3)
    trained = {each.name for each in training}
    both = [each.name for each in testing if each.name in trained]
    if both:
        text = f"{len(both)} of {len(testing)} test views are also trained on, such as {both[0]!r}"
        warnings.warn(f"{testing[0].record.source}: {text}: their scores say little", stacklevel=3)
    return training, testing


def photograph(root: Path, each: Listed, camera: Intrinsics, picture: PictureFile | None, factor: int) -> Photograph:
    """Make the photograph of a frame, with its mask and, for testing, its lit reference.

    The mask is the frame's ``mask_path``, shrunk by ``factor`` where ``masks_<factor>`` is there, else instant-ngp's
    next to the picture. Raises a DataError where a mask or reference that the file names is not there.
    """
    source, mask, lit = each.record.source, None, None
    if each.frame.values.get("mask_path"):
        name = plain_name(each.frame.text("mask_path", "the path of a picture"), root)
        mask = find_listed(root, resized(root, name, factor), source)
        if mask is None:
            raise each.frame.fault("mask_path", "the path of a picture that is there")
    elif each.path and (beside := each.path.with_name(f"{DYNAMIC_PREFIX}{each.path.stem}.png")).is_file():
        mask = beside
    if each.testing and each.lit is not None:
        lit = find_listed(root, each.lit, source)
        if lit is None:
            raise DataError(root / each.lit, "no such picture", "one for each test view, or dataset.lit=null")
    path = each.path or root / str(each.name or each.lit)
    lit = lit and read_picture(lit)
    return Photograph(path, str(path.relative_to(root)), read_pose(each.frame), camera, picture, mask, lit=lit)
