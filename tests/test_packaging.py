"""The wheel holds what a run needs, and packages of others plug in."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import ctm_plugin

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "docs" / "examples"


def python(*arguments: str, cwd: Path, path: Path | None = None) -> str:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    if path is not None:
        environment["PYTHONPATH"] = str(path)
    done = subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_wheel_holds_configs_and_scenes(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    configs = {f"ctm_plugin/conf/{path.relative_to(ROOT / 'conf')}" for path in (ROOT / "conf").rglob("*.yaml")}
    assert configs <= names
    for light in ("lit", "dark"):
        counts = {"still_life/{}/train/": 100, "white_room/{}/images/": 49, "white_room/{}/depth/": 49}
        for folder, count in counts.items():
            assert len([name for name in names if folder.format(light) in name and name.endswith(".png")]) == count
        assert f"ctm_plugin/data/assets/white_room/{light}/poses_bounds.npy" in names
    assets = [info for info in zipfile.ZipFile(wheel).infolist() if "/data/assets/" in info.filename]
    assert sum(info.file_size for info in assets) <= 10_000_000
    assert f"ctm_plugin-{ctm_plugin.__version__}.dist-info/entry_points.txt" in names
    assert {"ctm_plugin/report/tables.yaml", "ctm_plugin/report/page.html.jinja"} <= names


@pytest.mark.slow
def test_wheel_composes_away_from_the_checkout(wheel, tmp_path):
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    asked = "import ctm_plugin.cli as c; print(c.conf_dir()); " + (
        "from hydra.core.plugins import Plugins; from hydra.plugins.sweeper import Sweeper; import sys; "
        "print(*(sys.modules[each.__module__].__file__ for each in Plugins.instance().discover(Sweeper))); "
        "c.main(['+backbone=dvgo', '+ctm=on', '--cfg', 'job'])"
    )
    where, sweepers, *printed = python("-c", asked, cwd=tmp_path, path=site).splitlines()
    assert "  preset: 'on'" in printed
    assert Path(where) == site / "ctm_plugin" / "conf"
    assert str(site / "hydra_plugins" / "ctm_rows" / "sweeper.py") in sweepers.split()


@pytest.fixture(scope="module")
def plugged_in(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the examples are installed."""
    folder = tmp_path_factory.mktemp("plugged_in")
    pip = ["-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index", "--ignore-requires-python"]
    examples = [str(EXAMPLES / name) for name in ("tiny_backbone", "ctm_controls", "ctm_scenes")]
    python(*pip, "--target", str(folder / "site"), *examples, cwd=folder)
    return folder / "site"


@pytest.mark.slow
def test_packages_of_others(plugged_in, tmp_path):
    """A backbone, colours, a transform, an appearance, a verb: trained, scored, listed in one process."""
    small = ["trainer=smoke", "backbone=tiny", "backbone.steps=4", "dataset.downscale=8", "dataset.skip=10"]
    flow = ["ctm=flow", "color_space=whiten", "appearance=affine"]
    chosen = {"off": ["ctm=off", "color_space=equalize"], "flow": flow}
    lines = [[*small, *given, f"hydra.run.dir={name}"] for name, given in chosen.items()]
    lines += [["evaluate", "flow"], ["list"], ["--help"], ["scenes", "--help"]]
    asked = f"from ctm_plugin.cli import main; from ctm_scenes.spec import SCENES; import sys; n = {lines}\n"
    asked += "code = max(main(each) for each in n); print(*(SCENES.get(name).name for name in SCENES.names()))\n"
    *listed, scenes = python("-c", f"{asked}sys.exit(code)", cwd=tmp_path, path=plugged_in).splitlines()
    found = {name: json.loads((tmp_path / name / "metrics.json").read_text()) for name in chosen}
    for ctm, (_, space, *_) in chosen.items():
        assert [found[ctm][key] for key in ("backbone", "ctm", "color_space")] == ["tiny", ctm, space.partition("=")[2]]
    assert found["flow"]["appearance"] == "affine"
    again = json.loads((tmp_path / "flow" / "evaluation" / "metrics.json").read_text())
    assert again["psnr"] == found["flow"]["psnr"]
    assert all(name in "\n".join(listed) for name in ("asinh", "equalize", "gamma", "linear_log", "whiten"))
    assert scenes.split() == ["stairwell", "still_life", "white_room", "workshop"]
    assert ["scenes", "make", "scenes", "with", "Blender"] in map(str.split, listed)
    assert {"usage: ctm scenes SCENE [key=value ...]", "Render a scene into a folder"} <= {
        line.partition(" that")[0] for line in listed
    }
    assert len((EXAMPLES / "tiny_backbone" / "tiny_backbone.py").read_text().splitlines()) < 60
