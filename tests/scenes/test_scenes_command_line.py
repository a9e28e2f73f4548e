"""``python -m ctm_plugin.scenes``."""

import subprocess
import sys
from pathlib import Path

import pytest

from ctm_plugin.errors import ConfigError, CTMError, UnknownNameError
from ctm_plugin.scenes import SCENES
from ctm_plugin.scenes.__main__ import main, parse
from ctm_plugin.scenes.blender import require_bpy
from ctm_plugin.scenes.render import RenderSettings


def test_defaults_and_overrides():
    assert parse(["out=a/b"]) == (Path("a/b"), RenderSettings())
    given = ["out=x=y", "light=0.02", "size=64", "samples=8", "seed=3", "views=10", "test_views=2"]
    expected = RenderSettings(light=0.02, size=64, samples=8, seed=3, views=10, test_views=2)
    assert parse(given) == (Path("x=y"), expected)


def test_unknown_key_lists_the_known_ones():
    with pytest.raises(UnknownNameError, match="unknown key 'lite'; known: light, out, samples, seed, size"):
        parse(["out=x", "lite=1"])


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("light=0", "light: found 0.0, expected a number > 0"),
        ("light=nan", "light: found nan"),
        ("light=inf", "light: found inf"),
        ("light=bright", "light: found 'bright', expected a number"),
        ("size=8", "size: found 8, expected pixels a side, an integer from 16 to 4096"),
        ("size=12.5", "size: found '12.5', expected an integer"),
        ("samples=0", "samples: found 0, expected an integer >= 1"),
        ("seed=-1", "seed: found -1"),
        ("views=0", "views: found 0"),
        ("test_views=0", "test_views: found 0"),
        ("out=y", "out: found 'out=y', expected a key given once"),
        ("fast", "argument: found 'fast', expected key=value"),
    ],
)
def test_bad_values(argument, message):
    with pytest.raises(ConfigError) as caught:
        parse(["out=x", argument])
    assert str(caught.value).startswith(message)


def test_the_folder_is_needed():
    with pytest.raises(ConfigError, match="out: found '', expected the folder"):
        parse(["light=1"])


@pytest.mark.parametrize("arguments", [[], ["render"], ["list", "still_life"]])
def test_usage(arguments, capsys):
    assert main(arguments) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("usage: python -m ctm_plugin.scenes render SCENE out=DIR [light=1.0] [size=128]")
    assert all(name in printed for name in SCENES)


def test_unknown_scene(capsys):
    assert main(["render", "still_live", "out=x"]) == 2
    assert capsys.readouterr().err == "unknown scene 'still_live'; known: still_life\n"


def test_without_blender_the_message_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "bpy", None)
    with pytest.raises(CTMError, match=r"pip install 'ctm-plugin\[blender\]'"):
        require_bpy()
    assert main(["render", "still_life", f"out={tmp_path / 'new'}"]) == 2
    assert "pip install 'ctm-plugin[blender]'" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_importing_the_scenes_leaves_blender_alone():
    code = "import sys, ctm_plugin.scenes, ctm_plugin.scenes.__main__; sys.exit('bpy' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
