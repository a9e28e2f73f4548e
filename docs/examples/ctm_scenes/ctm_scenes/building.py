"""Thin helpers over ``bpy`` to build scenes with: meshes, materials, lamps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from ctm_plugin.color.srgb import srgb_to_linear
from ctm_scenes.cycles import require_bpy


def colour(code: str) -> tuple[float, float, float, float]:
    """Turn ``"#rrggbb"`` in sRGB into the linear RGBA that Blender's sockets take."""
    srgb = torch.tensor([int(code[i : i + 2], 16) / 255.0 for i in (1, 3, 5)], dtype=torch.float64)
    red, green, blue = srgb_to_linear(srgb).tolist()
    return (red, green, blue, 1.0)


class Shader:
    """A material under construction: nodes are added by short type name, inputs are values or other sockets.

    Args:
        name: of the material.
        owner: of the nodes, a world say, if not a new material.
    """

    def __init__(self, name: str, owner: Any = None):
        self.material = owner or require_bpy().data.materials.new(name)
        self.tree = self.material.node_tree
        self.tree.nodes.clear()

    def node(self, kind: str, inputs: dict[str | int, Any] | None = None, **attributes: Any) -> Any:
        """Add ``ShaderNode<kind>``; ``inputs`` by name or index, a socket is linked and anything else is a default."""
        node = self.tree.nodes.new(f"ShaderNode{kind}")
        for name, value in attributes.items():
            setattr(node, name, value)
        for key, value in (inputs or {}).items():
            if hasattr(value, "is_linked"):
                self.tree.links.new(value, node.inputs[key])
            else:
                node.inputs[key].default_value = value
        return node

    def coordinates(self, kind: str = "Object", scale: Sequence[float] = (1, 1, 1), turn: Sequence[float] = (0, 0, 0)):
        """Add a socket of texture coordinates (``Object``, ``Generated`` or ``UV``), scaled and turned (radians)."""
        vector = self.node("TexCoord").outputs[kind]
        return self.node("Mapping", {"Vector": vector, "Scale": scale, "Rotation": turn}).outputs["Vector"]

    def noise(self, vector: Any, scale: float, detail: float = 3.0, distortion: float = 0.0):
        """Add a socket of fractal noise in about [0, 1]."""
        inputs = {"Vector": vector, "Scale": scale, "Detail": detail, "Distortion": distortion}
        return self.node("TexNoise", inputs).outputs["Fac"]

    def ramp(self, factor: Any, stops: Sequence[tuple[float, str]]):
        """Add a socket of a colour looked up at ``factor`` between ``(position, "#rrggbb")`` stops."""
        node = self.node("ValToRGB", {"Fac": factor})
        elements = node.color_ramp.elements
        while len(elements) < len(stops):
            elements.new(0.5)
        for element, (position, code) in zip(elements, stops, strict=True):
            element.position, element.color = position, colour(code)
        return node.outputs["Color"]

    def tone(self, scale: float, dark: str, light: str, detail: float = 3.0):
        """Add a socket of a colour that changes from ``dark`` to ``light`` with noise."""
        return self.ramp(self.noise(self.coordinates(), scale, detail), [(0.3, dark), (0.7, light)])

    def mix(self, factor: Any, first: Any, second: Any, blend: str = "MIX"):
        """Add a socket of two colours (sockets or ``"#rrggbb"``) blended by ``factor``."""
        first, second = (colour(c) if isinstance(c, str) else c for c in (first, second))
        # The node shows one set of sockets a data type under repeated names; 6, 7 and output 2 are the colours.
        node = self.node("Mix", {0: factor, 6: first, 7: second}, data_type="RGBA", blend_type=blend)
        return node.outputs[2]

    def math(self, operation: str, *values: Any):
        """Add a socket of ``ShaderNodeMath``, of values and sockets."""
        return self.node("Math", dict(enumerate(values)), operation=operation).outputs[0]

    def surface(self, base: Any, bump: Any = None, bump_height: float = 0.01, **principled: Any) -> Any:
        """Finish with a Principled surface; keys are input names with ``_`` for a space. Returns the material."""
        inputs = {key.replace("_", " "): value for key, value in principled.items()}
        inputs["Base Color"] = colour(base) if isinstance(base, str) else base
        if bump is not None:
            inputs["Normal"] = self.node("Bump", {"Height": bump, "Distance": bump_height}).outputs["Normal"]
        return self._finish(self.node("BsdfPrincipled", inputs).outputs[0])

    def emission(self, value: Any) -> Any:
        """Finish with a surface that emits ``value`` and reflects nothing. Returns the material."""
        return self._finish(self.node("Emission", {"Color": value}).outputs[0])

    def _finish(self, shader: Any) -> Any:
        self.node("OutputMaterial", {"Surface": shader})
        return self.material


def mottled(name: str, scale: float, dark: str, light: str, detail: float = 3.0, **principled: Any) -> Any:
    """Make a material whose tone changes with noise; the other keys are those of :meth:`Shader.surface`."""
    s = Shader(name)
    return s.surface(s.tone(scale, dark, light, detail), **principled)


def mesh(
    name: str,
    vertices: np.ndarray,
    faces: Sequence[Sequence[int]],
    material: Any,
    uv: np.ndarray | None = None,
    smooth: bool = True,
    location: Sequence[float] | np.ndarray = (0, 0, 0),
    rotation: Sequence[float] = (0, 0, 0),
) -> Any:
    """Add a mesh object.

    Args:
        name: of the object.
        vertices: ``[V, 3]`` in scene units.
        faces: vertex indices of each polygon, counter-clockwise from outside.
        material: of all faces.
        uv: ``[sum of face sizes, 2]`` texture coordinates of the face corners in order.
        smooth: shade smoothly.
        location, rotation: of the object; Euler angles XYZ in degrees.

    Returns:
        The object.
    """
    bpy = require_bpy()
    data = bpy.data.meshes.new(name)
    data.from_pydata([tuple(v) for v in np.asarray(vertices).tolist()], [], [list(f) for f in faces])
    data.polygons.foreach_set("use_smooth", [smooth] * len(data.polygons))
    if uv is not None:
        data.uv_layers.new().data.foreach_set("uv", np.asarray(uv, dtype=np.float32).ravel())
    data.materials.append(material)
    data.update()
    item = _placed(name, data, location)
    item.rotation_euler = np.deg2rad(rotation)
    return item


def lathe(name: str, profile: Sequence[tuple[float, float]], material: Any, sides: int = 96, **place: Any) -> Any:
    """Add a turned object: ``profile`` points ``(radius, z)``, bottom to top outside, spun around z.

    A subdivision modifier rounds the profile; two points close together keep an edge. UV: u around, v along the
    profile, both in [0, 1].
    """
    points = np.array(profile, dtype=np.float64)
    points[:, 0] = np.maximum(points[:, 0], 1e-4)
    rows = len(points)
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)]) / lengths.sum()
    angle = 2.0 * np.pi * np.arange(sides) / sides
    radius, z = points[:, :1], points[:, 1:]
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), z + 0.0 * angle], axis=-1).reshape(-1, 3)
    faces, uv = [], []
    for row in range(rows - 1):
        for side in range(sides):
            after = (side + 1) % sides
            faces.append([row * sides + side, row * sides + after, (row + 1) * sides + after, (row + 1) * sides + side])
            left, right = side / sides, (side + 1) / sides
            uv += [(left, along[row]), (right, along[row]), (right, along[row + 1]), (left, along[row + 1])]
    item = mesh(name, vertices, faces, material, np.array(uv), **place)
    item.modifiers.new("round", "SUBSURF").render_levels = 2
    return item


def box(name: str, size: Sequence[float], material: Any, bevel: float = 0.0, **place: Any) -> Any:
    """Add a box of edge lengths ``size`` around its own origin, its edges rounded by ``bevel``."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * np.array(size)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    item = mesh(name, corners, faces, material, smooth=False, **place)
    if bevel > 0.0:
        modifier = item.modifiers.new("bevel", "BEVEL")
        modifier.width, modifier.segments = bevel, 3
    return item


def slab(name: str, low: Sequence[float], high: Sequence[float], material: Any, bevel: float = 0.0) -> Any:
    """Add a box from its lowest corner to its highest, its edges rounded by ``bevel``."""
    first, second = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    return box(name, (second - first).tolist(), material, bevel, location=((first + second) / 2.0).tolist())


def tube(
    name: str,
    path: Sequence[Sequence[float] | np.ndarray] | np.ndarray,
    radius: float,
    material: Any,
    sides: int = 12,
) -> Any:
    """Add a round bar of ``radius`` along the points ``path`` ``[N, 3]``, both ends closed."""
    points = np.asarray(path, dtype=np.float64)
    along = np.gradient(points, axis=0)
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    # Any direction across the first piece will do; each point passes it on, so that the bar does not twist.
    across = np.eye(3)[np.argmin(np.abs(along[0]))]
    angle = 2.0 * np.pi * np.arange(sides)[:, None] / sides
    rings = []
    for point, ahead in zip(points, along, strict=True):
        across = across - np.dot(across, ahead) * ahead
        across = across / np.linalg.norm(across)
        rings.append(point + radius * (np.cos(angle) * across + np.sin(angle) * np.cross(ahead, across)))
    last = (len(points) - 1) * sides
    faces = [list(range(sides))[::-1], list(range(last, last + sides))]
    for first in range(0, last, sides):
        pairs = [(first + k, first + (k + 1) % sides) for k in range(sides)]
        faces += [[a, b, b + sides, a + sides] for a, b in pairs]
    item = mesh(name, np.concatenate(rings), faces, material)
    # Round along the bar, flat at its ends.
    item.data.polygons.foreach_set("use_smooth", [len(face) == 4 for face in faces])
    return item


def area_lamp(
    name: str,
    location: Sequence[float],
    size: float,
    watts: float,
    tint: str = "#ffffff",
    target: Sequence[float] = (0, 0, 0),
) -> Any:
    """Add a square lamp that cameras do not see.

    Args:
        name: of the object.
        location: ``[3]`` scene units.
        size: edge in scene units.
        watts: power at normal light.
        tint: colour.
        target: ``[3]`` the point it shines at.
    """
    from mathutils import Vector

    item = _lamp(name, "AREA", location, watts, tint)
    item.data.size = size
    item.rotation_euler = (Vector(target) - Vector(location)).to_track_quat("-Z", "Y").to_euler()
    return item


def bulb(name: str, location: Sequence[float], radius: float, watts: float, tint: str = "#ffffff") -> Any:
    """Add a ball that shines all around with ``watts`` at normal light and that cameras do not see."""
    item = _lamp(name, "POINT", location, watts, tint)
    item.data.shadow_soft_size = radius
    return item


def _lamp(name: str, kind: str, location: Sequence[float], watts: float, tint: str) -> Any:
    data = require_bpy().data.lights.new(name, kind)
    data.energy, data.color = watts, colour(tint)[:3]
    item = _placed(name, data, location)
    item.visible_camera = False
    return item


def _placed(name: str, data: Any, location: Sequence[float] | np.ndarray) -> Any:
    bpy = require_bpy()
    item = bpy.data.objects.new(name, data)
    item.location = location
    bpy.context.scene.collection.objects.link(item)
    return item


def world_light(lower: str, upper: str, strength: float) -> None:
    """Light the scene from all around, blending from ``lower`` (straight down) to ``upper`` (straight up)."""
    bpy = require_bpy()
    world = bpy.context.scene.world = bpy.data.worlds.new("world")
    s = Shader("world", world)
    up = s.node("SeparateXYZ", {0: s.node("TexCoord").outputs["Generated"]}).outputs["Z"]
    blend = s.ramp(s.math("MULTIPLY_ADD", up, 0.5, 0.5), [(0.0, lower), (1.0, upper)])
    background = s.node("Background", {"Color": blend, "Strength": strength})
    s.node("OutputWorld", {"Surface": background.outputs[0]})
