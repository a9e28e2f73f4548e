"""Thin helpers over ``bpy``: meshes, materials, lamps, the camera, and pictures as arrays.

``bpy`` (Blender as a module, GPL) is an optional dependency, so it is imported inside the functions alone.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctm_plugin.errors import CTMError
from ctm_plugin.scenes.encode import srgb_to_linear
from ctm_plugin.scenes.spec import Number


def require_bpy() -> Any:
    """The ``bpy`` module.

    Raises:
        CTMError: it is not installed, or a shared library it needs is missing.
    """
    try:
        import bpy
    except ImportError as error:
        raise CTMError(
            f"rendering needs Blender's Python module: pip install 'ctm-plugin[blender]' (Python 3.11). "
            f"Where it is installed, a system library may be missing, see docs/scenes.md. Import said: {error}"
        ) from error
    return bpy


def colour(code: str) -> tuple[float, float, float, float]:
    """``"#rrggbb"`` in sRGB to the linear RGBA that Blender's sockets take."""
    srgb = np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    red, green, blue = srgb_to_linear(srgb).tolist()
    return (red, green, blue, 1.0)


class Shader:
    """A material under construction: nodes are added by short type name, inputs are values or other sockets."""

    def __init__(self, name: str):
        bpy = require_bpy()
        self.material = bpy.data.materials.new(name)
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

    def coordinates(
        self, kind: str = "Object", scale: Sequence[Number] = (1, 1, 1), turn: Sequence[Number] = (0, 0, 0)
    ):
        """Socket of texture coordinates (``Object``, ``Generated`` or ``UV``), scaled and turned (radians)."""
        vector = self.node("TexCoord").outputs[kind]
        return self.node("Mapping", {"Vector": vector, "Scale": scale, "Rotation": turn}).outputs["Vector"]

    def noise(self, vector: Any, scale: Number, detail: Number = 3.0, distortion: Number = 0.0):
        """Socket of fractal noise in about [0, 1]."""
        inputs = {"Vector": vector, "Scale": scale, "Detail": detail, "Distortion": distortion}
        return self.node("TexNoise", inputs).outputs["Fac"]

    def ramp(self, factor: Any, stops: Sequence[tuple[Number, str]], interpolation: str = "LINEAR"):
        """Socket of a colour looked up at ``factor`` between ``(position, "#rrggbb")`` stops."""
        node = self.node("ValToRGB", {"Fac": factor})
        node.color_ramp.interpolation = interpolation
        elements = node.color_ramp.elements
        while len(elements) < len(stops):
            elements.new(0.5)
        for element, (position, code) in zip(elements, stops, strict=True):
            element.position, element.color = position, colour(code)
        return node.outputs["Color"]

    def mix(self, factor: Any, first: Any, second: Any, blend: str = "MIX"):
        """Socket of two colours (sockets or ``"#rrggbb"``) blended by ``factor``."""
        first, second = (colour(c) if isinstance(c, str) else c for c in (first, second))
        # The node shows one set of sockets a data type under repeated names; 6, 7 and output 2 are the colours.
        node = self.node("Mix", {0: factor, 6: first, 7: second}, data_type="RGBA", blend_type=blend)
        return node.outputs[2]

    def math(self, operation: str, *values: Any):
        """Socket of ``ShaderNodeMath``."""
        return self.node("Math", dict(enumerate(values)), operation=operation).outputs[0]

    def surface(self, base: Any, bump: Any = None, bump_height: Number = 0.01, **principled: Any) -> Any:
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


def mesh(
    name: str,
    vertices: np.ndarray,
    faces: Sequence[Sequence[int]],
    material: Any,
    uv: np.ndarray | None = None,
    smooth: bool = True,
    location: Sequence[Number] = (0, 0, 0),
    rotation: Sequence[Number] = (0, 0, 0),
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
    item = bpy.data.objects.new(name, data)
    item.location = location
    item.rotation_euler = np.deg2rad(rotation)
    bpy.context.scene.collection.objects.link(item)
    return item


def lathe(name: str, profile: Sequence[tuple[Number, Number]], material: Any, sides: int = 96, **place: Any) -> Any:
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


def box(name: str, size: Sequence[Number], material: Any, bevel: Number = 0.0, **place: Any) -> Any:
    """Add a box of edge lengths ``size`` around its own origin, its edges rounded by ``bevel``."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * np.array(size)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    item = mesh(name, corners, faces, material, smooth=False, **place)
    if bevel > 0.0:
        modifier = item.modifiers.new("bevel", "BEVEL")
        modifier.width, modifier.segments = bevel, 3
    return item


def area_lamp(name: str, location: Sequence[Number], size: Number, watts: Number, tint: str = "#ffffff") -> Any:
    """Add a square lamp that shines at the origin and that cameras do not see.

    Args:
        name: of the object.
        location: ``[3]`` scene units.
        size: edge in scene units.
        watts: power at normal light.
        tint: colour.
    """
    bpy = require_bpy()
    from mathutils import Vector

    data = bpy.data.lights.new(name, "AREA")
    data.energy, data.size, data.color = watts, size, colour(tint)[:3]
    item = bpy.data.objects.new(name, data)
    item.location = location
    item.rotation_euler = (-Vector(location)).to_track_quat("-Z", "Y").to_euler()
    item.visible_camera = False
    bpy.context.scene.collection.objects.link(item)
    return item


def world_light(lower: str, upper: str, strength: Number) -> None:
    """Light the scene from all around, blending from ``lower`` (straight down) to ``upper`` (straight up)."""
    bpy = require_bpy()
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    tree = world.node_tree
    coordinate, split = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeSeparateXYZ")
    shift, ramp = tree.nodes.new("ShaderNodeMath"), tree.nodes.new("ShaderNodeValToRGB")
    shift.operation = "MULTIPLY_ADD"
    shift.inputs[1].default_value = shift.inputs[2].default_value = 0.5
    ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[1].color = colour(lower), colour(upper)
    background = tree.nodes["Background"]
    background.inputs["Strength"].default_value = strength
    tree.links.new(coordinate.outputs["Generated"], split.inputs[0])
    tree.links.new(split.outputs["Z"], shift.inputs[0])
    tree.links.new(shift.outputs[0], ramp.inputs["Fac"])
    tree.links.new(ramp.outputs["Color"], background.inputs["Color"])


def dim(light: Number) -> None:
    """Multiply the power of every lamp, world and emitting material by ``light``; linear light follows."""
    bpy = require_bpy()
    for lamp in bpy.data.lights:
        lamp.energy *= light
    for owner in (*bpy.data.worlds, *bpy.data.materials):
        for node in owner.node_tree.nodes if owner.node_tree else ():
            name = {"BACKGROUND": "Strength", "EMISSION": "Strength", "BSDF_PRINCIPLED": "Emission Strength"}.get(
                node.type
            )
            if name:
                node.inputs[name].default_value *= light


def place_camera(pose: np.ndarray) -> None:
    """Move the scene's camera to a ``[4, 4]`` camera-to-world matrix (Blender's axes are OpenGL's)."""
    bpy = require_bpy()
    from mathutils import Matrix

    bpy.context.scene.camera.matrix_world = Matrix(pose.tolist())


def set_up_cycles(size: int, camera_angle_x: Number, near: Number, far: Number) -> None:
    """Square transparent pictures from Cycles on the CPU, with everything off that is not linear in light.

    Args:
        size: width and height in pixels.
        camera_angle_x: field of view in radians.
        near, far: the camera clips at half the one and twice the other.
    """
    bpy = require_bpy()
    scene = bpy.context.scene
    data = bpy.data.cameras.new("camera")
    data.angle_x, data.clip_start, data.clip_end = camera_angle_x, 0.5 * near, 2.0 * far
    scene.camera = bpy.data.objects.new("camera", data)
    scene.collection.objects.link(scene.camera)
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x = render.resolution_y = size
    render.resolution_percentage = 100
    render.film_transparent = True
    render.use_persistent_data = True
    render.use_compositing = render.use_sequencer = False
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_mode = "RGBA"
    render.image_settings.color_depth = "32"
    cycles = scene.cycles
    cycles.device = "CPU"
    # Clamping, light culling and adaptive sampling decide by absolute brightness: a dimmed scene would not be the
    # bright one scaled.
    cycles.use_adaptive_sampling = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.light_sampling_threshold = 0.0


def use_radiance(samples: int, seed: int) -> None:
    """Render radiance next: ``samples`` paths a pixel, denoised; the same seed gives the same picture."""
    scene = require_bpy().context.scene
    scene.view_layers[0].material_override = None
    scene.cycles.samples, scene.cycles.seed = samples, seed
    scene.cycles.use_denoising = True
    scene.cycles.denoiser = "OPENIMAGEDENOISE"
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BLACKMAN_HARRIS", 1.5


def use_distance() -> None:
    """Render distance next: one ray through each pixel's centre, its length up to the first surface as the colour."""
    scene = require_bpy().context.scene
    shader = Shader("distance")
    # The ray's length; "View Z Depth" would be the coordinate along the viewing axis.
    material = shader.emission(shader.node("CameraData").outputs["View Distance"])
    # Otherwise every triangle becomes a lamp, and sorting them takes ten times as long as the picture.
    material.cycles.emission_sampling = "NONE"
    scene.view_layers[0].material_override = material
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    # The narrowest filter puts the only sample within 0.005 pixels of the centre.
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BLACKMAN_HARRIS", 0.01


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Send the standard output to nowhere: Blender's C code reports every file there. The standard error is kept."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


@contextlib.contextmanager
def held_interrupt() -> Iterator[None]:
    """Hold Ctrl-C back until the block is done. Cycles would swallow it and hand over half a picture as a whole one."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


def picture() -> np.ndarray:
    """Render the current scene.

    Returns:
        ``[H, W, 4]`` float32, linear, premultiplied alpha, first row on top.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed meanwhile.
    """
    bpy = require_bpy()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "view.exr"
        bpy.context.scene.render.filepath = str(path)
        with held_interrupt():
            bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(str(path))
        width, height = image.size
        pixels = np.empty(width * height * 4, dtype=np.float32)
        image.pixels.foreach_get(pixels)
        bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1]


def empty_scene(build: Callable[[], None]) -> None:
    """Start Blender from nothing and let ``build`` fill it."""
    bpy = require_bpy()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build()
