"""Names for the arrangement of a scene's cameras, and for the background of rays that hit nothing."""

from typing import Literal, get_args

Geometry = Literal["bounded", "forward", "unbounded"]
Background = Literal["black", "white", "random_matched", "random"]
GEOMETRIES: tuple[str, ...] = get_args(Geometry)
BACKGROUNDS: tuple[str, ...] = get_args(Background)
AUTO = "auto"
"""Name of the choice that finds the geometry from the cameras."""
