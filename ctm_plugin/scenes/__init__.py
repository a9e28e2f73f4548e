"""Blender files, and scenes of plug-ins, rendered as data sets. Only rendering needs ``bpy``."""
