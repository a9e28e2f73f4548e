"""Color Transform Module: learn, with the scene, the colour space in which a radiance field is trained."""

__version__ = "0.10.0"
