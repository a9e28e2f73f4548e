"""What tests share: the verb and a scene as installed packages have them, and a stand-in for Blender."""

import pytest
from ctm_scenes import plan, render
from ctm_scenes.settings import VERB
from ctm_scenes.spec import SCENES
from stand_in import TABLE, Painter

from ctm_plugin.settings.commands import VERBS_OF_OTHERS


@pytest.fixture(autouse=True)
def _installed(monkeypatch):
    monkeypatch.setitem(VERBS_OF_OTHERS.added, "scenes", VERB)
    monkeypatch.setitem(SCENES.added, "table", TABLE)


@pytest.fixture
def painter(monkeypatch) -> Painter:
    """In place of Blender."""
    painter = Painter()
    monkeypatch.setattr(render, "cycles", painter)
    monkeypatch.setattr(plan, "cycles", painter)
    return painter
