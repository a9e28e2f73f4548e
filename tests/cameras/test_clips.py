"""Where the frames of clips go, what is said of them, and what is left out."""

import errno
import os

import pytest
from clips import LOSSLESS, pan, write_clip
from PIL import Image

from ctm_plugin.cameras import clips
from ctm_plugin.cameras.clips import root_of, take_frames
from ctm_plugin.cameras.photographs import list_photographs
from ctm_plugin.errors import DataError


@pytest.fixture
def walk(tmp_path):
    return write_clip(tmp_path / "my walk.MP4", pan(range(0, 100, 2)))


def photograph(path, value: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (80, 60), (value, 0, 0)).save(path)


def test_frames_of_a_clip_lie_next_to_it_and_are_used_again(walk, capsys):
    home = walk.parent / "my walk" / "images"
    root = take_frames(walk, "images")
    count = len(list_photographs(root, "images"))
    assert root == root_of(walk) == home.parent
    assert 38 <= count <= 40
    told = f"my walk.MP4: {count} of 50 frames, the sharpest on each stretch of the way: {home}\n"
    assert capsys.readouterr().out == told
    before = {path: path.stat().st_mtime_ns for path in home.iterdir()}
    take_frames(walk, "images")
    assert {path: path.stat().st_mtime_ns for path in home.iterdir()} == before
    assert capsys.readouterr().out == f"my walk.MP4: its {count} frames in {home} are used\n"
    later = home.stat().st_mtime + 9
    os.utime(walk, (later, later))
    take_frames(walk, "images")
    assert capsys.readouterr().out.endswith("are used; the clip is newer: remove them to take others\n")


@pytest.mark.parametrize("home", ["", pytest.param("low", marks=pytest.mark.slow)])
def test_clips_and_photographs_in_one_folder(walk, home):
    """Frames lie among the photographs, wherever those are, and are found there again."""
    root = walk.parent
    for number in range(3):
        photograph(root / home / f"{number}.png", number)
    write_clip(root / "back.mov", pan(range(500, 400, -2)))
    for _ in range(2):
        take_frames(root, "images")
        names = [path.relative_to(root / home).as_posix() for path in list_photographs(root, "images")]
        assert names[:3] == ["0.png", "1.png", "2.png"]
        assert {name.partition("/")[0] for name in names[3:]} == {"back", "my walk"}
        assert 3 + 36 <= len(names) <= 3 + 44


@pytest.mark.slow
def test_two_clips_without_photographs(walk):
    other = write_clip(walk.parent / "my walk.mov", pan(range(500, 600, 2)))
    take_frames(walk.parent, "images")
    folders = {path.parent.name for path in list_photographs(walk.parent, "images")}
    assert folders == {"my walk", other.name.replace(".", "_")}
    assert (walk.parent / "images").is_dir()


def test_what_came_with_a_still_is_left_out(walk):
    for name in ("IMG_0001.HEIC", "IMG_0002.JPG"):
        (walk.parent / name).write_bytes(b"still")
        walk.with_name(name).with_suffix(".MOV").write_bytes(walk.read_bytes())
    with pytest.warns(UserWarning, match="clips with a still of the same name left out: 2, as 'IMG_0001.MOV'"):
        found = clips.folders_of_clips(walk.parent, "images")
    assert [*found] == [walk]


def test_one_that_cannot_be_used_is_left_out_by_name(walk):
    write_clip(walk.parent / "tripod.mp4", pan([0] * 20))
    (walk.parent / "empty.mp4").write_bytes(b"")
    with pytest.warns(UserWarning, match="it is left out") as caught:
        take_frames(walk.parent, "images")
    said = sorted(str(each.message) for each in caught)
    assert [each.endswith("; it is left out") for each in said] == [True, True]
    assert "empty.mp4: found an empty file, expected a whole clip" in said[0]
    assert "tripod.mp4: found a clip in which next to nothing moves, expected one that goes around" in said[1]
    assert {path.parent.name for path in list_photographs(walk.parent, "images")} == {walk.stem}


def test_the_only_one_is_refused(tmp_path):
    clip = write_clip(tmp_path / "tripod.mp4", pan([0] * 20))
    with pytest.raises(DataError, match=r"tripod\.mp4: found a clip in which next to nothing moves"):
        take_frames(clip, "images")
    assert [*tmp_path.iterdir()] == [clip]


@pytest.mark.slow
def test_a_stop_and_a_folder_that_is_shut_leave_nothing(walk, monkeypatch):
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(clips, "write_frames", stopped)
        with pytest.raises(KeyboardInterrupt):
            take_frames(walk, "images")

    def shut(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(clips, "replacing_folder", shut)
    with pytest.raises(DataError, match=r"a folder that cannot be written to \(Permission denied\), expected a copy"):
        take_frames(walk, "images")
    assert [*walk.parent.iterdir()] == [walk]


def test_a_clip_that_ends_too_early_is_said_once(walk):
    write_clip(walk, pan(range(0, 100, 2)), *LOSSLESS, "-g", 5, "-movflags", "+faststart")
    walk.write_bytes(walk.read_bytes()[:-20_000])
    with pytest.warns(UserWarning, match="ends too early") as caught:
        take_frames(walk, "images")
    assert len(caught) == 1
