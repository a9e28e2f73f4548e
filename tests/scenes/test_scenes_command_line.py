"""``python -m ctm_plugin.scenes``."""

import subprocess
import sys
from pathlib import Path

import pytest
from stand_in import Painter

from ctm_plugin.errors import ConfigError, CTMError, UnknownNameError
from ctm_plugin.scenes import SCENES, plan, render
from ctm_plugin.scenes.__main__ import main, parse
from ctm_plugin.scenes.blender import require_bpy
from ctm_plugin.scenes.layouts import write_transforms
from ctm_plugin.scenes.presets import PRESETS, SYNTHETIC_NERF
from ctm_plugin.scenes.trajectory import hemisphere


def test_defaults_and_overrides():
    assert parse(["out=a/b"]) == ([Path("a/b")], {})
    given = ["out=x=y", "light=0.02", "width=64", "samples=8", "denoise=false", "trajectory=a/b", "test_views=2"]
    expected = {"light": 0.02, "width": 64, "samples": 8, "denoise": False, "trajectory": "a/b", "test_views": 2}
    assert parse(given) == ([Path("x=y")], expected)
    assert parse(["source=a", "out=b"], ("source", "out")) == ([Path("a"), Path("b")], {})


def test_unknown_key_lists_the_known_ones():
    with pytest.raises(UnknownNameError, match="unknown key 'lite'; known: background, denoise, depth, device, extent"):
        parse(["out=x", "lite=1"])


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("light=0", "light: found 0.0, expected a number > 0"),
        ("light=nan", "light: found nan"),
        ("light=inf", "light: found inf"),
        ("light=bright", "light: found 'bright', expected a number"),
        ("width=8", "width: found 8, expected pixels, an integer from 16 to 8192"),
        ("width=12.5", "width: found '12.5', expected an integer"),
        ("height=8", "height: found 8, expected pixels, from 16 to 8192, or 0"),
        ("samples=0", "samples: found 0, expected an integer >= 1"),
        ("denoise=yes", "denoise: found 'yes', expected true or false"),
        ("seed=-1", "seed: found -1"),
        ("views=-1", "views: found -1"),
        ("test_views=-1", "test_views: found -1"),
        ("noise_read=2", "noise_read: found 2.0, expected a number from 0 to 1"),
        ("extent=0", "extent: found 0.0, expected a number in (0, 2]"),
        ("background=sky", "background: found 'sky', expected one of own, transparent, opaque"),
        ("depth=exr", "depth: found 'exr', expected one of float, code"),
        ("device=tpu", "device: found 'tpu', expected one of auto, cpu, gpu"),
        ("out=y", "out: found 'out=y', expected a key given once"),
        ("fast", "argument: found 'fast', expected key=value"),
    ],
)
def test_bad_values(argument, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["render", "still_life", "out=x", argument]) == 2
    assert capsys.readouterr().err.startswith(message)
    assert not (tmp_path / "x").exists()


def test_the_folder_is_needed():
    with pytest.raises(ConfigError, match="out: found '', expected a folder, as out=DIR"):
        parse(["light=1"])


def test_a_preset_needs_its_files(capsys, tmp_path):
    for name in ("bathroom", "staircase"):
        (tmp_path / f"{name}.blend").touch()
    assert main(["preset", "low_texture_blender", f"source={tmp_path}", f"out={tmp_path / 'out'}"]) == 2
    assert "found no bathroom_2.blend, bathroom_3.blend, dark_kitchen.blend" in capsys.readouterr().err
    assert main(["preset", "llff", f"source={tmp_path}", "out=x"]) == 2
    expected = "unknown preset 'llff'; known: low_texture_blender, synthetic_nerf_dark\n"
    assert capsys.readouterr().err == expected


@pytest.fixture
def sources(tmp_path):
    """A folder with all that the presets want: empty ``.blend`` files, and cameras beside those of Synthetic-NeRF."""
    for preset in PRESETS.values():
        for scene in preset.scenes:
            (tmp_path / f"{scene}.blend").touch()
    for scene in SYNTHETIC_NERF:
        (tmp_path / scene).mkdir()
        for split in ("train", "test"):
            write_transforms(tmp_path / scene, split, hemisphere(2, 4.0, seed=0), 0.7, 2.0, 6.0, ".png")
    return tmp_path


@pytest.mark.parametrize("spoil", [Path.unlink, lambda path: path.write_text("{}")])
def test_cameras_are_checked_before_anything_is_rendered(sources, monkeypatch, capsys, spoil):
    painter = Painter()
    monkeypatch.setattr(render, "cycles", painter)
    monkeypatch.setattr(plan, "cycles", painter)
    command = ["preset", "synthetic_nerf_dark", f"source={sources}", f"out={sources / 'out'}", "width=16"]
    spoil(sources / "ship" / "transforms_train.json")  # of the last scene
    assert main(command) == 2
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


@pytest.mark.parametrize("arguments", [[], ["render"], ["list", "still_life"]])
def test_usage(arguments, capsys):
    assert main(arguments) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("usage: python -m ctm_plugin.scenes render SCENE out=DIR [light=1.0] [width=128]")
    assert all(name in printed for name in SCENES)


def test_unknown_scene(capsys):
    assert main(["render", "still_live", "out=x"]) == 2
    assert (
        capsys.readouterr().err
        == "unknown scene 'still_live'; known: a path to a .blend file, stairwell, still_life, white_room, workshop\n"
    )


def test_without_blender_the_message_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "bpy", None)
    with pytest.raises(CTMError, match=r"pip install -e '\.\[blender\]'"):
        require_bpy()
    assert main(["render", "still_life", f"out={tmp_path / 'new'}"]) == 2
    assert "pip install -e '.[blender]'" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_importing_the_scenes_leaves_blender_alone():
    code = "import sys, ctm_plugin.scenes, ctm_plugin.scenes.__main__; sys.exit('bpy' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
