"""Blender as a renderer: scenes and files opened, light dimmed, a camera placed, pictures as arrays, by Cycles."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctm_plugin.errors import CTMError, DataError, held_interrupt
from ctm_plugin.settings.setting import Number

EMITTERS = {"BACKGROUND": "Strength", "EMISSION": "Strength", "BSDF_PRINCIPLED": "Emission Strength"}
"""Nodes that give off light, and the input that says how much."""

BRIGHT = 0.5
"""Radiance above which Cycles sends light paths to a material's surface."""

GPU_KINDS = ("OPTIX", "CUDA", "HIP", "METAL", "ONEAPI")


def require_bpy() -> Any:
    """Import Blender's module (GPL), a dependency of this package that may be left out.

    Raises:
        CTMError: it is not installed, or a shared library it needs is missing.
    """
    try:
        import bpy
    except ImportError as error:
        raise CTMError(
            f"rendering needs Blender's Python module: pip install -e docs/examples/ctm_scenes (Python 3.11). "
            f"Where it is installed, a system library may be missing, see docs/scenes.md. Import said: {error}"
        ) from error
    return bpy


def empty_scene(build: Callable[[], None]) -> None:
    """Start Blender from nothing and let ``build`` fill it."""
    require_bpy().ops.wm.read_factory_settings(use_empty=True)
    build()


@dataclass(frozen=True)
class FoundCamera:
    """The camera of a ``.blend``: its pose ``[4, 4]``, camera to world, and its horizontal field of view in radians."""

    pose: np.ndarray
    angle_x: float


def open_blend(path: Path) -> FoundCamera:
    """Open a ``.blend``; scripts in it are not run.

    Raises:
        DataError: it is missing, broken, or has no perspective camera or no light.
    """
    bpy = require_bpy()
    if not path.is_file():
        raise DataError(path, "no file", "a .blend file")
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path.resolve()), load_ui=False, use_scripts=False)
    except RuntimeError as error:
        found = f"a file that Blender cannot open ({' '.join(str(error).split())})"
        raise DataError(path, found, "a .blend file") from error
    camera = bpy.context.scene.camera
    if camera is None or camera.type != "CAMERA" or camera.data.type != "PERSP":
        raise DataError(path, "no perspective camera in its scene", "a .blend file with one")
    if not has_light():
        raise DataError(path, "no lamp, no lit world and no emitting material", "a .blend file with light")
    pose = np.array(camera.matrix_world.normalized())
    return FoundCamera(pose, float(camera.data.angle_x))


def trees_in(tree: Any, copied: bool = False) -> Iterator[Any]:
    """Go through a node tree, the groups in it and those in them; ``copied``: it gets its own copies of them first."""
    yield tree
    for node in tree.nodes:
        if node.type == "GROUP" and node.node_tree:
            if copied:
                node.node_tree = node.node_tree.copy()
            yield from trees_in(node.node_tree, copied)


def emitters(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Go through the nodes of a tree that give off light, and their inputs that say how much."""
    yield from ((node, node.inputs[EMITTERS[node.type]]) for node in tree.nodes if node.type in EMITTERS)


def strengths() -> Iterator[tuple[Any, Any]]:
    """Go through the node trees of all worlds, materials and groups, with the inputs that say how much light is given
    off."""
    data = require_bpy().data
    trees = [owner.node_tree for owner in (*data.worlds, *data.materials) if owner.node_tree]
    for tree in (*trees, *(group for group in data.node_groups if group.type == "SHADER")):
        yield from ((tree, strength) for _, strength in emitters(tree))


def has_light() -> bool:
    """Tell whether anything in the open file gives off light."""
    bpy = require_bpy()
    lamps = any(item.type == "LIGHT" and item.data.energy > 0 for item in bpy.context.scene.objects)
    world = bpy.context.scene.world
    plain = world is not None and not world.node_tree and max(world.color) > 0
    return lamps or plain or any(socket.is_linked or socket.default_value > 0 for _, socket in strengths())


def brightest(material: Any) -> float:
    """Find what a material gives off at most, in radiance; numbers that other nodes make count as 1."""
    found = [0.0]
    for node, strength in (each for tree in trees_in(material.node_tree) for each in emitters(tree)):
        tint = node.inputs["Emission Color" if node.type == "BSDF_PRINCIPLED" else "Color"]
        color = 1.0 if tint.is_linked else max(tint.default_value[:3])
        found.append(color * (1.0 if strength.is_linked else strength.default_value))
    return max(found)


def settle_sampling() -> None:
    """Settle for each material whether light paths are sent to it, by its brightness now.

    Cycles' own choice does so when it renders: a dimmed material would be left to chance hits, with more noise.
    """
    for material in require_bpy().data.materials:
        if material.node_tree and material.cycles.emission_sampling == "AUTO":
            material.cycles.emission_sampling = "FRONT_BACK" if brightest(material) > BRIGHT else "NONE"


def dim(light: Number) -> None:
    """Multiply the power of every lamp, world and emitting material by ``light``; linear light follows."""
    bpy = require_bpy()
    settle_sampling()
    spared: set[Any] = set()  # nodes of lamps are scaled by the lamp's power
    for lamp in bpy.data.lights:
        lamp.energy *= light
        if lamp.node_tree:
            spared |= {*trees_in(lamp.node_tree, copied=True)}
    for world in bpy.data.worlds:
        world.color = [light * channel for channel in world.color]
    for tree, socket in [found for found in strengths() if found[0] not in spared]:
        if socket.is_linked:
            source = socket.links[0].from_socket
            factor = tree.nodes.new("ShaderNodeMath")
            factor.operation, factor.inputs[1].default_value = "MULTIPLY", light
            tree.links.new(source, factor.inputs[0])
            tree.links.new(factor.outputs[0], socket)
        else:
            socket.default_value *= light


def reach(camera: FoundCamera, size: int = 64) -> float:
    """Measure the median distance of what the camera of the open file sees, in scene units.

    Raises:
        CTMError: it sees nothing.
    """
    set_up_cycles(size, size, camera.angle_x, None, None)
    use_distance()
    place_camera(camera.pose)
    image = picture()
    seen = image[..., 0][image[..., 3] > 0.5]
    if not len(seen):
        raise CTMError("the camera of the .blend file sees nothing")
    return float(np.median(seen))


def place_camera(pose: np.ndarray) -> None:
    """Move the scene's camera to a ``[4, 4]`` camera-to-world matrix (Blender's axes are OpenGL's)."""
    bpy = require_bpy()
    from mathutils import Matrix

    bpy.context.scene.camera.matrix_world = Matrix(pose.tolist())


def set_up_cycles(
    width: int, height: int, camera_angle_x: Number, near: Number | None, far: Number | None, device: str = "cpu"
) -> None:
    """Take pictures from Cycles, with everything off that is not linear in light or differs from a pinhole camera.

    Args:
        width, height: in pixels.
        camera_angle_x: horizontal field of view in radians.
        near, far: the camera clips at half the one and twice the other; ``None``: at 1/1000 and 100,000.
        device: ``cpu``, ``gpu``, or ``auto``: a GPU where there is one.

    Raises:
        CTMError: a GPU is asked for and there is none.
    """
    bpy = require_bpy()
    scene = bpy.context.scene
    data = bpy.data.cameras.new("camera")
    data.sensor_fit = "HORIZONTAL"
    data.angle_x = camera_angle_x
    data.clip_start, data.clip_end = 0.5 * near if near else 1e-3, 2.0 * far if far else 1e5
    scene.camera = bpy.data.objects.new("camera", data)
    scene.collection.objects.link(scene.camera)
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y = width, height
    render.resolution_percentage = 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
    render.use_border = render.use_motion_blur = render.use_multiview = False
    render.use_persistent_data = True
    render.use_compositing = render.use_sequencer = False
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_mode = "RGBA"
    render.image_settings.color_depth = "32"
    cycles = scene.cycles
    cycles.device = choose_device(device)
    # Clamping, light culling and adaptive sampling decide by absolute brightness: a dimmed scene would not be the
    # bright one scaled.
    cycles.use_adaptive_sampling = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.light_sampling_threshold = 0.0
    cycles.film_exposure = 1.0


def choose_device(device: str) -> str:
    """Find Cycles' name of a device: ``GPU`` where one is wanted and found, set up for use, else ``CPU``.

    Raises:
        CTMError: a GPU is asked for and there is none.
    """
    preferences = require_bpy().context.preferences.addons["cycles"].preferences
    for kind in GPU_KINDS if device != "cpu" else ():
        with contextlib.suppress(TypeError):  # this build of Blender does not know it
            preferences.compute_device_type = kind
            preferences.get_devices()
            for found in preferences.devices:
                found.use = found.type == kind
            if any(found.use for found in preferences.devices):
                return "GPU"
    if device == "gpu":
        raise CTMError("device=gpu: Cycles finds none that it can use here; device=cpu renders on the processor")
    return "CPU"


def use_radiance(samples: int, seed: int, denoise: bool = True, transparent: bool = True) -> None:
    """Render radiance next: ``samples`` paths a pixel; the same seed gives the same picture.

    What lies behind the scene is ``transparent``, or the world is seen there.
    """
    scene = require_bpy().context.scene
    scene.render.film_transparent = transparent
    scene.view_layers[0].material_override = None
    scene.cycles.samples, scene.cycles.seed = samples, seed
    # What error is left lies in high frequencies, where the denoiser finds it: 0.2 dB for nothing.
    scene.cycles.sampling_pattern = "BLUE_NOISE"
    scene.cycles.use_denoising = denoise
    scene.cycles.denoiser = "OPENIMAGEDENOISE"
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BLACKMAN_HARRIS", 1.5


def use_distance() -> None:
    """Render distance next: one ray through each pixel's centre, its length up to the first surface as the colour."""
    bpy = require_bpy()
    scene = bpy.context.scene
    material = bpy.data.materials.new("distance")
    tree = material.node_tree
    tree.nodes.clear()
    camera, glow, out = (tree.nodes.new(f"ShaderNode{kind}") for kind in ("CameraData", "Emission", "OutputMaterial"))
    # The ray's length; "View Z Depth" would be the coordinate along the viewing axis.
    tree.links.new(camera.outputs["View Distance"], glow.inputs["Color"])
    tree.links.new(glow.outputs[0], out.inputs["Surface"])
    # Otherwise every triangle becomes a lamp, and sorting them takes ten times as long as the picture.
    material.cycles.emission_sampling = "NONE"
    scene.view_layers[0].material_override = material
    scene.render.film_transparent = True
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
        with held_interrupt():  # Cycles would swallow it and hand over half a picture as a whole one
            bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(str(path))
        width, height = image.size
        pixels = np.empty(width * height * 4, dtype=np.float32)
        image.pixels.foreach_get(pixels)
        bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1]
