"""PLY's points, as text and binary, and damaged ones."""

import numpy as np
import pytest
from layouts import write_ply

from ctm_plugin.data.readers.ply import read_ply
from ctm_plugin.errors import DataError

POINTS = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("kind", ["float", "double"])
def test_what_is_written_is_read(tmp_path, encoding, kind):
    write_ply(tmp_path / "a.ply", POINTS, encoding, kind)
    np.testing.assert_allclose(read_ply(tmp_path / "a.ply"), POINTS, rtol=1e-6)
    write_ply(tmp_path / "a.ply", POINTS[:0], encoding, kind)
    assert read_ply(tmp_path / "a.ply").shape == (0, 3)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_points_at_infinity_are_left_out(tmp_path, encoding):
    points = POINTS.copy()
    points[[1, 3, 5], [0, 1, 2]] = [np.nan, np.inf, 1e9]
    write_ply(tmp_path / "a.ply", points, encoding)
    np.testing.assert_allclose(read_ply(tmp_path / "a.ply"), POINTS[[0, 2, 4, 6]], rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda text: b"", "an empty file"),
        (lambda text: text.replace(b"ply\n", b"plx\n"), "another header, of format ascii"),
        (lambda text: text.replace(b"ascii", b"binary_big_endian"), "another header, of format binary_big_endian"),
        (lambda text: text.replace(b"format ascii 1.0\n", b""), "another header, of format None"),
        (lambda text: text.replace(b"end_header", b"end"), "vertices"),
        (lambda text: text.replace(b"vertex 7", b"vertex 8"), "vertices"),
        (lambda text: text.replace(b"vertex 7", b"vertex -1"), "vertices .*-1 of vertex"),
        (lambda text: text.replace(b"vertex 7", b"vertex x"), "vertices"),
        (lambda text: text.replace(b"element vertex 7", b"element face 7"), "vertices .*7 of face"),
        (lambda text: text.replace(b"float z", b"float w"), "vertices"),
        (lambda text: text.replace(b"float z", b"list uchar int z"), "vertices"),
        (lambda text: text.replace(b"float z", b"float x"), "vertices"),
        (lambda text: text.replace(b"float z", b"half z"), "vertices"),
        (lambda text: text[:-30], "vertices"),
        (lambda text: text[:-4] + b"abc\n", "vertices"),
    ],
)  # fmt: skip
def test_damaged(tmp_path, change, found):
    write_ply(tmp_path / "a.ply", POINTS, "ascii")
    (tmp_path / "a.ply").write_bytes(change((tmp_path / "a.ply").read_bytes()))
    with pytest.raises(
        DataError,
        match=rf"a\.ply: found {found}.*, expected a PLY file, ascii or binary_little_endian"
        if found[0] != "a"
        else found,
    ):
        read_ply(tmp_path / "a.ply")
