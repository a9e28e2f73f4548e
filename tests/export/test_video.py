"""Videos of runs."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from ctm_plugin.cli import main
from ctm_plugin.export import video as module
from ctm_plugin.export.video import film_cameras, rendered, write_video
from ctm_plugin.runs.load import load_posed
from ctm_plugin.scene.camera_paths import KeyFrames

SIZES = ("trainer=smoke", "backbone.steps_alone=60", "backbone.coarse=false", "backbone.grow=[]", "ctm=off")


@pytest.fixture(scope="module")
def run(ball, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("videos") / "run"
    data = ("dataset=blender", f"dataset.root={ball}", "dataset.exposure=0.05")
    assert main([*data, *SIZES, f"hydra.run.dir={folder}"]) == 0
    return folder


def frames(path: Path) -> np.ndarray:
    return iio.imread(path)[..., :3]


@pytest.mark.parametrize(("path", "count"), [("capture", 4), ("orbit", 4), ("spiral", 4), ("test", 2)])
def test_frames_hold_the_lit_picture_or_all(run, tmp_path, path, count):
    out = tmp_path / "video.gif"
    assert main(["render", str(run), f"path={path}", "frames=4", f"out={out}"]) == 0
    assert frames(out).shape == (count, 12, 12, 3)
    assert main(["render", str(run), f"path={path}", "frames=4", f"out={out}", "what=all", "overwrite=true"]) == 0
    assert frames(out).shape == (count, 12, 54, 3)  # lit, dark, depth, latent, and three gaps of 2


def test_key_frames_are_filmed(run, tmp_path, monkeypatch):
    """A key at a test view, with its field of view, is that test view."""
    test = load_posed(run).module.scene.test
    fov = 2 * np.arctan(test.height / (2 * test.intrinsics[0, 1].item()))
    keys = KeyFrames(test.c2w.double().numpy(), np.array([fov, fov / 2]))
    path = tmp_path / "round.json"
    path.write_text(json.dumps(keys.content()))
    first, *_, last = film_cameras(load_posed(run).module.scene, keys, 5)
    np.testing.assert_allclose(first.c2w[0], test.c2w[0], atol=1e-6)
    np.testing.assert_allclose(first.intrinsics[0], test.intrinsics[0], rtol=1e-5)
    assert last.intrinsics[0, 1] > 2 * first.intrinsics[0, 1]
    monkeypatch.setattr(module, "can_mp4", lambda: False)
    assert main(["render", str(run), f"path={path}", "frames=5"]) == 0
    assert len(frames(run / "video" / "round.gif")) == 5


def test_a_saved_path_is_lit_as_it_was_seen(run, tmp_path, capsys):
    path, films = tmp_path / "round.json", []
    keys = KeyFrames(load_posed(run).module.scene.test.c2w.double().numpy(), np.array([0.6, 0.6]), lit=(2.0, 1.5, 0.0))
    path.write_text(json.dumps(keys.content()))
    told = f"lit as {path} was saved: light=2 contrast=1.5 saturation="
    by = (("light=null",), ("light=2", "contrast=1.5", "saturation=0"), ("saturation=1",), ("light=auto",))
    for number, settings in enumerate(by):
        out = tmp_path / f"{number}.gif"
        assert main(["render", str(run), f"path={path}", "frames=2", f"out={out}", *settings]) == 0
        said = capsys.readouterr().out.splitlines()[0]
        assert said.startswith(told) == (number in (0, 2)), said
        films.append(frames(out).astype(int))
    np.testing.assert_array_equal(films[0], films[1])
    assert np.ptp(films[0], axis=-1).max() < np.ptp(films[2], axis=-1).max()
    assert films[3].mean() > films[0].mean() + 5


def test_a_film_has_lens_and_size_of_the_largest_picture(run):
    """Pictures of several sizes lie in the upper left corner of one canvas."""
    scene = load_posed(run).module.scene
    test = scene.test
    sizes = torch.tensor([[8, 8], *[[test.height, test.width // 2]] * (len(test) - 1)])
    lenses = test.intrinsics * torch.arange(1, len(test) + 1)[:, None]
    cameras = film_cameras(replace(scene, test=replace(test, sizes=sizes, intrinsics=lenses)), "test", 1)
    assert (cameras[0].width, cameras[0].height) == (test.width // 2, test.height)
    torch.testing.assert_close(cameras[0].intrinsics, lenses[1:2])
    assert (film_cameras(scene, "test", 1)[0].width) == scene.test.width
    (wider, *_) = film_cameras(scene, "test", 1, 1.5)
    assert (wider.width, wider.height) == (round(1.5 * scene.test.width), round(1.5 * scene.test.height))
    assert torch.equal(wider.intrinsics, 1.5 * scene.test.intrinsics[:1])


def test_one_ray_a_pixel(run):
    """Whatever pictures of the run have."""
    posed = load_posed(run)
    cameras = film_cameras(posed.module.scene, "test", 1)
    (one,) = rendered(posed.module, cameras[:1])
    posed.module.rays_per_pixel = 4
    (again,) = rendered(posed.module, cameras[:1])
    torch.testing.assert_close(again["rgb"], one["rgb"])
    assert (posed.module.render_view(cameras[0], 0)["rgb"] - one["rgb"]).abs().max() > 1e-4


def test_dark_scenes_are_lit(run, tmp_path, capsys):
    out = tmp_path / "video.gif"
    assert main(["render", str(run), "frames=2", f"out={out}"]) == 0
    assert capsys.readouterr().out == f"written to {out}\nnext: ctm view {run}\n"
    means = [frames(out).mean()]
    for light in ("off", 1, 3):
        assert main(["render", str(run), "frames=2", f"out={out}", f"light={light}", "overwrite=true"]) == 0
        means.append(frames(out).mean())
    assert means[0] > means[1] + 5
    assert means[1] < means[2] < means[3]
    assert main(["render", str(run), f"out={out}"]) == 1
    assert f"error: out: found '{out}', expected a file that is not there yet, or" in capsys.readouterr().err


def test_mp4_where_the_extra_is_installed(run, monkeypatch, refused):
    assert main(["render", str(run), "frames=2", "overwrite=true"]) == 0
    assert (run / "video/orbit.mp4").read_bytes()[4:8] == b"ftyp"
    monkeypatch.setattr(module, "can_mp4", lambda: False)
    assert main(["render", str(run), "frames=2", "overwrite=true"]) == 0
    assert len(frames(run / "video/orbit.gif")) == 2
    monkeypatch.setattr("ctm_plugin.export.settings.can_mp4", lambda: False)
    assert "pip install -e '.[video]'" in refused("render", run, "out=x.mp4")


def test_what_a_video_shows_is_what_was_written(tmp_path):
    given = np.random.default_rng(0).integers(0, 255, (3, 8, 8, 3), dtype=np.uint8) // 64 * 64
    write_video(tmp_path / "x.gif", list(given), fps=10)
    assert np.abs(frames(tmp_path / "x.gif").astype(int) - given).mean() < 10
    plain = given[:, :1, :1].repeat(8, 1).repeat(8, 2)  # WebP is lossy
    write_video(tmp_path / "x.webp", list(plain), fps=10)
    assert np.abs(iio.imread(tmp_path / "x.webp", index=...)[..., :3].astype(int) - plain).mean() < 10


def about(film: Path) -> str:
    """What ffmpeg says of a film."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    return subprocess.run([ffmpeg, "-i", str(film)], capture_output=True, text=True, check=False).stderr


def test_h264_is_bt709_and_starts_at_once(tmp_path):
    """In pixels and in tags: read as tagged, the colours are those that were written."""
    green = np.zeros((64, 64, 3), np.uint8)
    green[..., 1] = 255
    write_video(tmp_path / "x.mp4", [green] * 3, fps=10)
    content = (tmp_path / "x.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")
    assert "yuv420p(tv, bt709, progressive)" in about(tmp_path / "x.mp4")  # matrix, primaries and transfer
    np.testing.assert_allclose(frames(tmp_path / "x.mp4")[0].mean((0, 1)), [0, 255, 0], atol=6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere: found no such directory"),
        (["RUN", "path=circle"], "path: found 'circle', expected one of capture, orbit, spiral, test, FILE.json"),
        (["RUN", "path=nowhere.json"], "nowhere.json: found no such file, expected a file of key frames"),
        (["RUN", "light=dark"], "light: found 'dark', expected auto, off, or a number of stops"),
        (["RUN", "frames=many"], "frames: found 'many'"),
        (["RUN", "speed=2"], "error: speed: found an unknown key, expected one of contrast, dataset.root, fps"),
        (["RUN", "out=a.avi"], "out: found '.avi', expected one of .gif, .mp4, .webp"),
    ],
)
def test_mistakes(run, refused, arguments, message):
    assert message in refused("render", *(run if argument == "RUN" else argument for argument in arguments))


def test_planar_runs_have_no_cameras(tmp_path, refused):
    folder = tmp_path / "planar"
    small = ("dataset.height=24", "dataset.width=32", "dataset.patch=12", "backbone.steps=2")
    assert main(["backbone=barf2d", "trainer=smoke", "ctm=off", *small, f"hydra.run.dir={folder}"]) == 0
    for verb in ("render", "view", "export"):
        assert f"{folder}: found a run of another kind" in refused(verb, folder)
