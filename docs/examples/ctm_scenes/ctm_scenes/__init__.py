"""Scenes made with Blender, as a plug-in of ``ctm_plugin``: the verb ``ctm scenes``, and four scenes for it."""
