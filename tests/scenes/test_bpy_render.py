"""What Blender renders, against closed forms. Needs ``bpy``."""

import math
import os
import signal
import threading

import numpy as np
import pytest

pytest.importorskip("bpy", reason="bpy is not installed: pip install 'ctm-plugin[blender]'", exc_type=ImportError)

from ctm_plugin.scenes import SCENES, blender
from ctm_plugin.scenes.__main__ import main
from ctm_plugin.scenes.encode import srgb_to_linear
from ctm_plugin.scenes.render import distance
from ctm_plugin.scenes.trajectory import look_at

SIZE, ANGLE, FLOOR = 33, 0.7, -0.3
EYE = np.array([2.0, 1.6, 3.0])


def rays() -> tuple[np.ndarray, np.ndarray]:
    """Unit directions ``[H, W, 3]`` in the world through the pixels' centres, and the pose."""
    pose = look_at(EYE)
    focal = 0.5 * SIZE / math.tan(0.5 * ANGLE)
    grid = (np.arange(SIZE) + 0.5 - 0.5 * SIZE) / focal
    x, y = np.meshgrid(grid, -grid)
    direction = np.stack([x, y, -np.ones_like(x)], axis=-1)
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True) @ pose[:3, :3].T, pose


def floor(colour: str = "#808080", strength: float = 1.0) -> None:
    """A square of edge 2 at height FLOOR under an even white sky."""
    corners = np.array([[-1, -1, FLOOR], [1, -1, FLOOR], [1, 1, FLOOR], [-1, 1, FLOOR]])
    shader = blender.Shader("paint")
    diffuse = shader.node("BsdfDiffuse", {"Color": blender.colour(colour)}).outputs[0]
    shader.node("OutputMaterial", {"Surface": diffuse})
    blender.mesh("floor", corners, [[0, 1, 2, 3]], shader.material, smooth=False)
    blender.world_light("#ffffff", "#ffffff", strength)


def test_distance_is_along_the_ray_through_the_pixel_centre():
    direction, pose = rays()
    blender.empty_scene(floor)
    blender.set_up_cycles(SIZE, ANGLE, 2.0, 6.0)
    blender.use_distance()
    blender.place_camera(pose)
    found = distance(blender.picture())
    expected = (FLOOR - EYE[2]) / direction[..., 2]
    point = EYE + expected[..., None] * direction
    expected[np.abs(point[..., :2]).max(axis=-1) > 1.0] = np.nan
    assert 0.2 < np.isnan(expected).mean() < 0.8
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize("light", [1.0, 0.02])
def test_radiance_is_albedo_times_light(light):
    blender.empty_scene(floor)
    blender.dim(light)
    blender.set_up_cycles(SIZE, ANGLE, 2.0, 6.0)
    blender.use_radiance(samples=16, seed=0)
    blender.place_camera(rays()[1])
    middle = blender.picture()[SIZE // 2, SIZE // 2]
    # A matt floor that sees the whole of an even sky of radiance 1 sends back its albedo.
    albedo = float(srgb_to_linear(np.array(0x80 / 255.0)))
    np.testing.assert_allclose(middle, [light * albedo] * 3 + [1.0], rtol=0.01)


def test_every_kind_of_light_is_dimmed():
    def build() -> None:
        blender.area_lamp("lamp", (0.0, 0.0, 3.0), 1.0, 100.0)
        blender.world_light("#000000", "#ffffff", 0.5)
        blender.Shader("glow").emission((1.0, 1.0, 1.0, 1.0))
        blender.Shader("screen").surface("#808080", Emission_Strength=3.0)

    blender.empty_scene(build)
    blender.dim(0.1)
    data = blender.require_bpy().data
    assert data.lights["lamp"].energy == pytest.approx(10.0)
    assert data.worlds["world"].node_tree.nodes["Background"].inputs["Strength"].default_value == pytest.approx(0.05)
    for name, node, socket, expected in (
        ("glow", "Emission", "Strength", 0.1),
        ("screen", "Principled BSDF", "Emission Strength", 0.3),
    ):
        found = data.materials[name].node_tree.nodes[node].inputs[socket].default_value
        assert found == pytest.approx(expected)


def test_the_still_life_fits_its_bounds():
    blender.empty_scene(SCENES["still_life"].build)
    bpy = blender.require_bpy()
    graph = bpy.context.evaluated_depsgraph_get()
    reach = 0.0
    for item in bpy.data.objects:
        if item.type == "MESH":
            solid = item.evaluated_get(graph)
            corners = np.array([vertex.co for vertex in solid.to_mesh().vertices])
            matrix = np.array(solid.matrix_world)
            reach = max(reach, np.linalg.norm(corners @ matrix[:3, :3].T + matrix[:3, 3], axis=-1).max())
    assert 1.0 < reach < 1.25


def test_the_same_command_gives_the_same_files(tmp_path, capfd):
    for name in ("a", "b"):
        command = ["render", "still_life", f"out={tmp_path / name}", "size=24", "samples=2", "views=2", "test_views=1"]
        assert main(command) == 0
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    assert len(files) == 7
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    assert capfd.readouterr().out == ""


def test_ctrl_c_waits_for_the_picture():
    done = []

    @blender.held_interrupt()
    def work() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        done.append(True)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_pictures_can_be_taken_in_another_thread():
    def work() -> None:
        with blender.held_interrupt():
            reached.append(True)

    reached: list[bool] = []
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert reached == [True]
