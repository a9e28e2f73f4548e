"""Every rendering inside the package is as it was written; that its pictures fit one another: ``tests/data``."""

import hashlib
import json
from pathlib import Path

import pytest

from ctm_plugin import data

ASSETS = Path(data.__file__).parent / "assets"


@pytest.mark.parametrize("light", ["lit", "dark"])
@pytest.mark.parametrize("scene", ["still_life", "white_room"])
def test_every_file_is_as_it_was_rendered(scene, light):
    root = ASSETS / scene / light
    sums = (root / "SHA256SUMS").read_text()
    assert hashlib.sha256(sums.encode()).hexdigest() in (root / "README.md").read_text()
    told = dict(reversed(line.split("  ")) for line in sums.splitlines())
    there = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    assert there - {"README.md", "SHA256SUMS"} == set(told)
    for name, digest in told.items():
        assert hashlib.sha256((root / name).read_bytes()).hexdigest() == digest, name


@pytest.mark.parametrize("scene", ["still_life", "white_room"])
def test_settings_differ_only_in_light(scene):
    lit, dark = (json.loads((ASSETS / scene / light / "settings.json").read_text()) for light in ("lit", "dark"))
    assert {key: (lit[key], dark[key]) for key in lit if lit[key] != dark[key]} == {"light": (1.0, 0.02)}
