"""Four scenes made with Blender, as a plug-in of ``ctm_plugin``: their builders and cameras."""
