"""Scenes made with Blender: their builders, cameras and the renderer. ``bpy`` is needed for rendering alone."""

from ctm_plugin.scenes.spec import SceneSpec
from ctm_plugin.scenes.still_life import STILL_LIFE

SCENES: dict[str, SceneSpec] = {scene.name: scene for scene in (STILL_LIFE,)}

__all__ = ["SCENES", "SceneSpec"]
