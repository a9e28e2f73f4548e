"""Clips: every frame turned as the clip asks, colours as the standards say them, and what is wrong with a file."""

import sys

import numpy as np
import pytest
import torch
from clips import LOSSLESS, ffmpeg, pan, write_clip

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.readers.clip import read_clip, watched, write_frames
from ctm_plugin.data.readers.images import read_image, read_picture
from ctm_plugin.errors import CTMError, DataError

TO_SRGB = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
"""Light of BT.2020's primaries to sRGB's, ITU-R BT.2087."""


def patches(most: float = 1.0, size: tuple[int, int] = (48, 64)) -> np.ndarray:
    """``[H, W, 3]`` in [0, most], a flat colour for each 16x16 pixels."""
    colours = np.random.default_rng(0).uniform(0.1 * most, most, size=(size[0] // 16, size[1] // 16, 3))
    colours[0] = colours[0, :, :1]
    return colours.repeat(16, 0).repeat(16, 1)


def first_frame(clip, folder) -> np.ndarray:
    folder.mkdir()
    write_frames(clip, [0], folder)
    (path,) = folder.iterdir()
    return read_image(path).numpy()


@pytest.mark.parametrize(("lines", "matrix"), [(48, "bt601"), (720, "bt709")])
def test_a_clip_without_a_tag_has_the_matrix_of_its_size(tmp_path, lines, matrix):
    codes = (patches(size=(lines, 64)) * 255).round().astype(np.uint8)
    stored = ("-vf", f"scale=out_color_matrix={matrix},format=yuv444p,setparams=colorspace=unknown", *LOSSLESS)
    clip = write_clip(tmp_path / "a.mp4", [codes], *stored)
    assert read_clip(clip).matrix == matrix
    np.testing.assert_allclose(first_frame(clip, tmp_path / "out"), codes / 255, atol=2.5 / 255)


def test_a_tag_goes_before_the_size(tmp_path):
    codes = (patches() * 255).round().astype(np.uint8)
    stored = ("-vf", "scale=out_color_matrix=bt709,format=yuv444p,setparams=colorspace=bt709", *LOSSLESS)
    clip = write_clip(tmp_path / "a.mp4", [codes], *stored)
    np.testing.assert_allclose(first_frame(clip, tmp_path / "out"), codes / 255, atol=2.5 / 255)


def hlg(codes: np.ndarray) -> np.ndarray:
    """Light in cd/m² on a display of 1000, ITU-R BT.2100: inverse OETF, then the OOTF's power of 1.2."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    light = np.where(codes <= 0.5, codes**2 / 3, (np.exp((codes - c) / a) + b) / 12)
    return 1000 * (light @ [0.2627, 0.6780, 0.0593])[..., None] ** 0.2 * light


def pq(codes: np.ndarray) -> np.ndarray:
    """Light in cd/m², SMPTE ST 2084."""
    power = codes ** (1 / 78.84375)
    return 10_000 * (np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power)) ** (1 / 0.1593017578125)


@pytest.mark.parametrize(("curve", "light", "most"), [("arib-std-b67", hlg, 0.9), ("smpte2084", pq, 0.65)])
def test_light_of_hlg_and_pq_becomes_srgb(tmp_path, curve, light, most):
    """White paper, 203 cd/m², is 1; brighter is clipped; 16 bits are kept."""
    codes = (patches(most) * 65535).round().astype(np.uint16)
    tags = f"setparams=range=tv:color_primaries=bt2020:color_trc={curve}:colorspace=bt2020nc"
    deep = "scale=out_color_matrix=bt2020nc:out_range=tv,format=yuv444p10le"
    clip = write_clip(tmp_path / "a.mov", [codes], "-vf", f"{deep},{tags}", *LOSSLESS)
    wanted = (light(codes / 65535) / 203 @ TO_SRGB.T).clip(0, 1)
    assert wanted.max() == 1
    assert wanted.min() < 0.02
    shown = first_frame(clip, tmp_path / "out")
    np.testing.assert_allclose(shown, linear_to_srgb(torch.from_numpy(wanted)).numpy(), atol=0.02)
    assert read_picture(tmp_path / "out" / "0001.png").header.deep


def test_a_clip_is_turned_as_its_tag_says_and_no_frame_is_counted_twice(tmp_path):
    """Times that differ from frame to frame, as a phone's in the dark, add none and drop none."""
    frames = pan(range(0, 24, 2))
    plain = write_clip(tmp_path / "plain.mp4", frames)
    uneven = "setpts='if(gt(N,5),N*4,N)/30/TB'"
    write_clip(tmp_path / "uneven.mp4", frames, "-vf", uneven, "-fps_mode", "vfr", "-enc_time_base", "1/90", *LOSSLESS)
    ffmpeg("-display_rotation", 90, "-i", tmp_path / "uneven.mp4", "-c", "copy", tmp_path / "turned.mp4")
    straight, turned = [*watched(plain)], [*watched(tmp_path / "turned.mp4")]
    assert len(straight) == len(turned) == len(frames)
    for one, other in zip(straight, turned, strict=True):
        np.testing.assert_allclose(np.rot90(one), other, atol=0.02)
    (tmp_path / "out").mkdir()
    write_frames(tmp_path / "turned.mp4", [2, 7], tmp_path / "out")
    for name, number in (("0001", 2), ("0002", 7)):
        found = read_image(tmp_path / "out" / f"{name}.png").numpy()
        assert np.abs(found.mean(-1) - np.rot90(frames[number]).mean(-1) / 255).mean() < 0.01


def test_large_frames_are_averaged(tmp_path):
    clip = write_clip(tmp_path / "a.mp4", pan([0], (160, 640)) * 1, "-vf", "scale=2560:640", *LOSSLESS)
    assert first_frame(clip, tmp_path / "out").shape == (480, 1920, 3)
    assert next(watched(clip)).shape == (240, 960)


EXPECTED = ", expected a whole clip that ffmpeg can read: copy it here again, or leave it out"


def test_clips_that_cannot_be_read(tmp_path):
    whole = write_clip(tmp_path / "whole.mp4", pan(range(40)), *LOSSLESS, "-g", 5).read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "other.mp4").write_bytes(b"no clip" * 99)
    ffmpeg("-f", "lavfi", "-i", "sine=duration=1", tmp_path / "sound.mp4")
    for name, found in (
        ("cut", "a clip that cannot be read (moov atom not found)"),
        ("empty", "an empty file"),
        ("other", "a clip that cannot be read (moov atom not found)"),
        ("sound", "no moving pictures"),
    ):
        with pytest.raises(DataError) as refused:
            read_clip(tmp_path / f"{name}.mp4")
        assert str(refused.value) == f"{tmp_path / name}.mp4: found {found}{EXPECTED}"


def test_a_clip_that_ends_too_early_gives_what_it_has(tmp_path):
    given = write_clip(tmp_path / "a.mp4", pan(range(40)), *LOSSLESS, "-g", 5, "-movflags", "+faststart").read_bytes()
    (tmp_path / "a.mp4").write_bytes(given[: len(given) // 2])
    with pytest.warns(UserWarning, match=r"a\.mp4: the clip ends too early; what there is of it is used"):
        count = len([*watched(tmp_path / "a.mp4")])
    assert 10 < count < 30


def test_without_the_extra_it_says_what_to_install(tmp_path, monkeypatch):
    clip = write_clip(tmp_path / "a.mp4", pan(range(3)))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(CTMError, match=r"reading clips needs ffmpeg: pip install -e '\.\[photos\]'"):
        read_clip(clip)
