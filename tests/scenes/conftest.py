"""What tests of the renderer share: a registered scene, and the builders of the example."""

import sys

import pytest
from pages import ROOT
from stand_in import TABLE, Painter

from ctm_plugin.scenes import plan, render
from ctm_plugin.settings.registry import SCENES

sys.path.append(str(ROOT / "docs" / "examples" / "ctm_scenes"))


@pytest.fixture(autouse=True)
def _a_scene_of_a_plug_in(monkeypatch):
    monkeypatch.setitem(SCENES.added, "table", TABLE)


@pytest.fixture
def painter(monkeypatch) -> Painter:
    """In place of Blender."""
    painter = Painter()
    monkeypatch.setattr(render, "cycles", painter)
    monkeypatch.setattr(plan, "cycles", painter)
    return painter
