"""``ctm scenes``."""

import sys
import tomllib
from importlib.metadata import EntryPoints
from pathlib import Path

import pytest
from ctm_scenes.command import PRESETS
from ctm_scenes.layouts import write_transforms
from ctm_scenes.settings import RenderSettings
from ctm_scenes.trajectory import hemisphere

from ctm_plugin.cli import main
from ctm_plugin.settings import registry

PAPER = ["chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"]


@pytest.fixture
def rendered(monkeypatch) -> list[tuple]:
    """What would have been rendered."""
    seen = []
    monkeypatch.setattr("ctm_scenes.command.render", lambda *what: seen.append(what))
    return seen


def test_settings(rendered):
    assert main(["scenes", "table", "out=a/b"]) == 0
    given = ["light=0.02", "width=64", "samples=8", "denoise=false", "trajectory=a/b", "test_views=2"]
    assert main(["scenes", "a.blend", "out=x=y", *given]) == 0
    expected = {"light": 0.02, "width": 64, "samples": 8, "denoise": False, "trajectory": "a/b", "test_views": 2}
    assert rendered == [
        ("table", Path("a/b"), RenderSettings()),
        ("a.blend", Path("x=y"), RenderSettings(**expected)),
    ]


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("light=0", "light: found 0.0, expected a number > 0"),
        ("light=bright", "scenes.light: found 'bright', expected a number"),
        ("width=8", "width: found 8, expected an integer, 16 to 8192"),
        ("height=8", "height: found 8, expected pixels, from 16 to 8192, or 0"),
        ("samples=0", "samples: found 0, expected an integer >= 1"),
        ("seed=-1", "seed: found -1"),
        ("extent=0", "extent: found 0.0, expected a number in (0, 2]"),
        ("background=sky", "background: found 'sky', expected one of own, transparent, opaque"),
        ("depth=exr", "depth: found 'exr', expected one of float, code"),
        ("device=tpu", "device: found 'tpu', expected one of auto, cpu, gpu"),
        ("out=y", "out: found 'out=y', expected a key given once"),
        ("lite=1", "scenes.lite: found an unknown key, expected one of background, denoise, depth, device, extent"),
        ("out=", "found 'out=', expected key=value"),
    ],
)
def test_bad_values(argument, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["scenes", "table", "out=x", argument]) == 1
    assert capsys.readouterr().err.startswith(f"error: {message}")
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["table", "light=1"], "out: found nothing, expected a value"),
        (["low_texture_blender", "out=x"], "source: found None, expected a folder, as source=DIR"),
        (["low_texture_blender", "source=.", "out=x"], "found no bathroom.blend, bathroom_2.blend, bathroom_3.blend"),
    ],
)
def test_what_is_missing(capsys, monkeypatch, tmp_path, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert main(["scenes", *arguments]) == 1
    assert message in capsys.readouterr().err


@pytest.fixture
def sources(tmp_path):
    """A folder with all that the presets want: empty ``.blend`` files, and cameras beside those of Synthetic-NeRF."""
    for preset in PRESETS.values():
        for scene in preset.scenes:
            (tmp_path / f"{scene}.blend").touch()
    for scene in PAPER:
        (tmp_path / scene).mkdir()
        for split in ("train", "test"):
            write_transforms(tmp_path / scene, split, hemisphere(2, 4.0, seed=0), 0.7, 2.0, 6.0, "code")
    return tmp_path


@pytest.mark.parametrize("spoil", [Path.unlink, lambda path: path.write_text("{}")])
def test_cameras_are_checked_before_anything_is_rendered(sources, painter, capsys, spoil):
    command = ["scenes", "synthetic_nerf_dark", f"source={sources}", f"out={sources / 'out'}", "width=16"]
    spoil(sources / "ship" / "transforms_train.json")  # of the last scene
    assert main(command) == 1
    assert str(Path("ship", "transforms_train.json")) in capsys.readouterr().err
    assert (painter.taken, (sources / "out").exists()) == (0, False)


def test_presets_are_the_paper_s_and_what_is_given_goes_before(sources, rendered):
    assert main(["scenes", "synthetic_nerf_dark", f"source={sources}", "out=x"]) == 0
    assert [out.name for _, out, _ in rendered] == PAPER
    scene, _, settings = rendered[4]
    assert scene == str(sources / "lego.blend")
    assert (settings.light, settings.size, settings.trajectory) == (0.02, (800, 800), str(sources / "lego"))
    rendered.clear()
    assert main(["scenes", "low_texture_blender", f"source={sources}", "out=x", "light=1"]) == 0  # a default as well
    assert len(rendered) == 7
    assert {(how.trajectory, how.views, how.light) for *_, how in rendered} == {("forward", 49, 1.0)}


def test_help_names_scenes_and_presets(capsys):
    assert main(["scenes", "--help"]) == 0
    printed = capsys.readouterr().out
    own = tomllib.loads(Path(__file__).with_name("pyproject.toml").read_text())["project"]["entry-points"]
    assert all(name in printed for name in (*own["ctm_plugin.scenes"], *PRESETS))


def test_ctrl_c(painter, capsys, tmp_path):
    painter.stop_after = 1
    assert main(["scenes", "table", f"out={tmp_path / 'x'}", "width=16"]) == 130
    assert capsys.readouterr().err.endswith("stopped; the same command goes on from here\n")


def test_a_scene_that_nobody_knows(monkeypatch, capsys):
    monkeypatch.setattr(registry, "entry_points", lambda group: EntryPoints())  # whatever is installed here
    assert main(["scenes", "tabel", "out=x"]) == 1
    known = ("a path to a .blend file", *PRESETS, "table")
    assert capsys.readouterr().err == f"error: unknown scene 'tabel'; known: {', '.join(sorted(known))}\n"


def test_without_blender_the_message_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "bpy", None)
    assert main(["scenes", "table", f"out={tmp_path / 'new'}"]) == 1
    assert "pip install -e docs/examples/ctm_scenes" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
