"""Scenes made with Blender: their builders, cameras and the renderer. ``bpy`` is only needed for rendering."""

from ctm_plugin.scenes.spec import SceneSpec
from ctm_plugin.scenes.stairwell import STAIRWELL
from ctm_plugin.scenes.still_life import STILL_LIFE
from ctm_plugin.scenes.white_room import WHITE_ROOM
from ctm_plugin.scenes.workshop import WORKSHOP

SCENES: dict[str, SceneSpec] = {scene.name: scene for scene in (STILL_LIFE, WORKSHOP, WHITE_ROOM, STAIRWELL)}

__all__ = ["SCENES", "SceneSpec"]
