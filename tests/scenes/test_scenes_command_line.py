"""``ctm scenes``."""

import os
import subprocess
import sys
from importlib.metadata import EntryPoints
from pathlib import Path

import pytest
from pages import ROOT

from ctm_plugin.cli import main
from ctm_plugin.scenes.command import EXAMPLES, PRESETS
from ctm_plugin.scenes.layouts import write_transforms
from ctm_plugin.scenes.settings import RenderSettings
from ctm_plugin.scenes.trajectory import hemisphere
from ctm_plugin.settings import registry


@pytest.fixture
def rendered(monkeypatch) -> list[tuple]:
    """What would have been rendered."""
    seen = []
    monkeypatch.setattr("ctm_plugin.scenes.command.render", lambda *what: seen.append(what))
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


def test_what_is_given_goes_before_a_preset_s_own(sources, rendered):
    command = ["scenes", "synthetic_nerf_dark", f"source={sources}", "out=x"]
    assert main(command) == main([*command, "light=1"]) == 0  # a default as well
    assert [how.light for _, _, how in rendered] == [0.02] * 8 + [1.0] * 8


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("light=0", "light: found 0.0, expected a number > 0"),
        ("light=nan", "light: found nan"),
        ("light=inf", "light: found inf"),
        ("light=bright", "scenes.light: found 'bright', expected a number"),
        ("width=8", "width: found 8, expected pixels, an integer from 16 to 8192"),
        ("width=12.5", "scenes.width: found '12.5', expected an integer"),
        ("height=8", "height: found 8, expected pixels, from 16 to 8192, or 0"),
        ("samples=0", "samples: found 0, expected an integer >= 1"),
        ("denoise=perhaps", "scenes.denoise: found 'perhaps', expected true or false"),
        ("seed=-1", "seed: found -1"),
        ("views=-1", "views: found -1"),
        ("test_views=-1", "test_views: found -1"),
        ("extent=0", "extent: found 0.0, expected a number in (0, 2]"),
        ("background=sky", "background: found 'sky', expected one of own, transparent, opaque"),
        ("depth=exr", "depth: found 'exr', expected one of float, code"),
        ("device=tpu", "device: found 'tpu', expected one of auto, cpu, gpu"),
        ("out=y", "out: found 'out=y', expected a key given once"),
        ("fast", "found 'fast', expected key=value"),
        ("lite=1", "scenes.lite: found 'an unknown key', expected one of background, denoise, depth, device, extent"),
        ("out=", "found 'out=', expected key=value"),
    ],
)
def test_bad_values(argument, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["scenes", "table", "out=x", argument]) == 1
    assert capsys.readouterr().err.startswith(f"error: {message}")
    assert not (tmp_path / "x").exists()


def test_folders_are_needed(capsys):
    assert main(["scenes", "table", "light=1"]) == 1
    assert "scenes.out: found 'nothing', expected a value" in capsys.readouterr().err
    assert main(["scenes", "low_texture_blender", "out=x"]) == 1
    assert "source: found None, expected a folder, as source=DIR" in capsys.readouterr().err


def test_a_preset_needs_its_files(capsys, tmp_path):
    for name in ("bathroom", "staircase"):
        (tmp_path / f"{name}.blend").touch()
    assert main(["scenes", "low_texture_blender", f"source={tmp_path}", f"out={tmp_path / 'out'}"]) == 1
    assert "found no bathroom_2.blend, bathroom_3.blend, dark_kitchen.blend" in capsys.readouterr().err


@pytest.fixture
def sources(tmp_path):
    """A folder with all that the presets want: empty ``.blend`` files, and cameras beside those of Synthetic-NeRF."""
    for preset in PRESETS.values():
        for scene in preset.scenes:
            (tmp_path / f"{scene}.blend").touch()
    for scene in PRESETS["synthetic_nerf_dark"].scenes:
        (tmp_path / scene).mkdir()
        for split in ("train", "test"):
            write_transforms(tmp_path / scene, split, hemisphere(2, 4.0, seed=0), 0.7, 2.0, 6.0, ".png")
    return tmp_path


@pytest.mark.parametrize("spoil", [Path.unlink, lambda path: path.write_text("{}")])
def test_cameras_are_checked_before_anything_is_rendered(sources, painter, capsys, spoil):
    command = ["scenes", "synthetic_nerf_dark", f"source={sources}", f"out={sources / 'out'}", "width=16"]
    spoil(sources / "ship" / "transforms_train.json")  # of the last scene
    assert main(command) == 1
    assert str(Path("ship", "transforms_train.json")) in capsys.readouterr().err
    assert (painter.taken, (sources / "out").exists()) == (0, False)


def test_presets_are_the_paper_s(sources, tmp_path):
    dark = list(PRESETS["synthetic_nerf_dark"].renderings(tmp_path, tmp_path / "out", {"light": 0.05}))
    assert [out.name for _, out, _ in dark] == ["chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"]
    scene, _, settings = dark[4]
    assert scene == str(tmp_path / "lego.blend")
    assert (settings.light, settings.size, settings.trajectory) == (0.05, (800, 800), str(tmp_path / "lego"))
    rooms = list(PRESETS["low_texture_blender"].renderings(tmp_path, tmp_path / "out", {}))
    assert len(rooms) == 7
    assert {(settings.trajectory, settings.views, settings.light) for _, _, settings in rooms} == {("forward", 49, 1.0)}


def test_help_names_scenes_and_presets(capsys):
    assert main(["scenes", "--help"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in (*EXAMPLES, *PRESETS))


def test_ctrl_c(monkeypatch, capsys):
    def render(*what):
        raise KeyboardInterrupt

    monkeypatch.setattr("ctm_plugin.scenes.command.render", render)
    assert main(["scenes", "table", "out=x"]) == 130
    assert capsys.readouterr().err == "stopped; the same command goes on from here\n"


def test_scenes_that_are_not_there(monkeypatch, capsys):
    monkeypatch.setattr(registry, "entry_points", lambda group: EntryPoints())  # whatever is installed here
    assert main(["scenes", "tabel", "out=x"]) == 1
    known = ("a path to a .blend file", *PRESETS, *EXAMPLES, "table")
    assert capsys.readouterr().err == f"error: unknown scene 'tabel'; known: {', '.join(sorted(known))}\n"
    assert main(["scenes", "workshop", "out=x"]) == 1
    install = "pip install -e docs/examples/ctm_scenes"
    assert capsys.readouterr().err == f"error: scene 'workshop' is in a package of its own: {install}\n"


def test_without_blender_the_message_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "bpy", None)
    assert main(["scenes", "table", f"out={tmp_path / 'new'}"]) == 1
    assert "pip install -e '.[blender]'" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_importing_the_scenes_leaves_blender_alone():
    code = "import sys, ctm_scenes.workshop, ctm_plugin.scenes.command; sys.exit('bpy' in sys.modules)"
    path = ROOT / "docs" / "examples" / "ctm_scenes"
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, "PYTHONPATH": f"{path}:{ROOT}"})
