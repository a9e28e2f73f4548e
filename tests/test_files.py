"""Folders are there whole, or as they were; one process writes them."""

import errno
import os
from pathlib import Path

import pytest

from ctm_plugin.files import is_main_process, replacing_folder, write_text


def test_a_new_folder(tmp_path):
    with pytest.raises(OSError, match="full"), replacing_folder(tmp_path / "above" / "new"):
        raise OSError("full")
    assert list(tmp_path.iterdir()) == []
    with replacing_folder(tmp_path / "above" / "new") as beside:
        (beside / "file").write_text("new")
        assert not (tmp_path / "above" / "new").exists()
    assert [path.name for path in tmp_path.rglob("*")] == ["above", "new", "file"]


def test_of_a_link_the_link_is_replaced(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "it").symlink_to(tmp_path / "far")
    with replacing_folder(tmp_path / "it") as beside:
        (beside / "new").write_text("new")
    assert not (tmp_path / "it").is_symlink()
    assert [path.name for path in (tmp_path / "it").iterdir()] == ["new"]
    assert list((tmp_path / "far").iterdir()) == []


@pytest.mark.parametrize("error", [None, KeyboardInterrupt, OSError])
def test_another_is_replaced_at_the_end_alone(tmp_path, error):
    old = tmp_path / "it"
    old.mkdir()
    (old / "old").write_text("old")
    try:
        with replacing_folder(old) as beside:
            (beside / "new").write_text("new")
            assert [path.name for path in old.iterdir()] == ["old"]
            if error:
                raise error
    except (KeyboardInterrupt, OSError):
        pass
    assert [path.name for path in tmp_path.rglob("*")] == ["it", "old" if error else "new"]


def test_stopped_between_two_moves(tmp_path, monkeypatch):
    """The new folder cannot take the place that the old one has left: the old one comes back."""
    (tmp_path / "it").mkdir()
    (tmp_path / "it" / "old").write_text("old")
    move, calls = os.replace, []

    def second_fails(*paths: object) -> None:
        calls.append(paths)
        if len(calls) == 2:
            raise KeyboardInterrupt
        move(*paths)

    monkeypatch.setattr(os, "replace", second_fails)
    with pytest.raises(KeyboardInterrupt), replacing_folder(tmp_path / "it") as beside:
        (beside / "new").write_text("new")
    assert [path.name for path in tmp_path.rglob("*")] == ["it", "old"]


def test_a_disk_that_may_only_be_read_is_told_by_the_file(tmp_path, monkeypatch):
    """There what was not written cannot be removed either, which is no news."""

    def refused(self, *_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))

    monkeypatch.setattr(Path, "write_text", refused)
    monkeypatch.setattr(Path, "unlink", refused)
    with pytest.raises(OSError, match="Read-only") as told:
        write_text(tmp_path / "a.txt", "text")
    assert told.value.filename == str(tmp_path / "a.txt")


def test_the_environment_says_which_process_writes(monkeypatch):
    assert is_main_process()
    for name, number, main in (("LOCAL_RANK", "0", True), ("RANK", "1", False)):
        monkeypatch.setenv(name, number)
        assert is_main_process() == main
