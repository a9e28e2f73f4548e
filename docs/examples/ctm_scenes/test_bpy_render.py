"""What Blender renders, against closed forms. Needs ``bpy``."""

import math

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from stand_in import TABLE

pytest.importorskip("bpy", reason="bpy is not installed: make test-blender", exc_type=ImportError)

from ctm_scenes import building as blender
from ctm_scenes import cycles
from ctm_scenes.layouts import to_rgba8
from ctm_scenes.render import distance
from ctm_scenes.trajectory import look_at

from ctm_plugin.cli import main
from ctm_plugin.color.srgb import srgb_to_linear

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
    cycles.empty_scene(floor)
    cycles.set_up_cycles(SIZE, SIZE, ANGLE, 2.0, 6.0)
    cycles.use_distance()
    cycles.place_camera(pose)
    found = distance(cycles.picture())
    expected = (FLOOR - EYE[2]) / direction[..., 2]
    point = EYE + expected[..., None] * direction
    expected[np.abs(point[..., :2]).max(axis=-1) > 1.0] = np.nan
    assert 0.2 < np.isnan(expected).mean() < 0.8
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize("light", [1.0, 0.02])
def test_radiance_is_albedo_times_light(light):
    cycles.empty_scene(floor)
    cycles.dim(light)
    cycles.set_up_cycles(SIZE, SIZE, ANGLE, 2.0, 6.0)
    cycles.use_radiance(samples=16, seed=0)
    cycles.place_camera(rays()[1])
    middle = cycles.picture()[SIZE // 2, SIZE // 2]
    # A matt floor that sees the whole of an even sky of radiance 1 sends back its albedo.
    albedo = float(srgb_to_linear(torch.tensor(0x80 / 255.0)))
    np.testing.assert_allclose(middle, [light * albedo] * 3 + [1.0], rtol=0.01)


def strength(tree, socket: str = "Strength", depth: int = 0):
    """The input of the one node that has it, so many groups deep."""
    for _ in range(depth):
        (tree,) = (node.node_tree for node in tree.nodes if node.type == "GROUP")
    (found,) = (node.inputs[socket] for node in tree.nodes if socket in node.inputs)
    return found


def test_every_kind_of_light_is_dimmed_once():
    """Lamps, worlds, emission and Principled surfaces; a strength that another node makes, inside a group; and a group
    inside a group that a lamp and a material share: the lamp's power is scaled, the material's group is."""

    def build() -> None:
        blender.world_light("#000000", "#ffffff", 0.5)
        blender.Shader("glow").emission((1.0, 1.0, 1.0, 1.0))
        blender.Shader("screen").surface("#808080", Emission_Strength=3.0)
        groups = cycles.require_bpy().data.node_groups
        linked, inner, outer = (groups.new(name, "ShaderNodeTree") for name in ("linked", "inner", "outer"))
        value = linked.nodes.new("ShaderNodeValue")
        value.outputs[0].default_value = 2.0
        linked.links.new(value.outputs[0], linked.nodes.new("ShaderNodeEmission").inputs["Strength"])
        inner.nodes.new("ShaderNodeEmission").inputs["Strength"].default_value = 2.0
        outer.nodes.new("ShaderNodeGroup").node_tree = inner
        blender.Shader("shared").node("Group", node_tree=outer)
        blender.area_lamp("lamp", (0.0, 0.0, 3.0), 1.0, 100.0)
        lamp = cycles.require_bpy().data.lights["lamp"]
        lamp.use_nodes = True
        lamp.node_tree.nodes.clear()
        lamp.node_tree.nodes.new("ShaderNodeGroup").node_tree = outer

    cycles.empty_scene(build)
    cycles.dim(0.25)
    data = cycles.require_bpy().data
    assert data.lights["lamp"].energy == pytest.approx(25.0)
    assert strength(data.lights["lamp"].node_tree, depth=2).default_value == pytest.approx(2.0)
    assert strength(data.materials["shared"].node_tree, depth=2).default_value == pytest.approx(0.5)
    assert strength(data.worlds["world"].node_tree).default_value == pytest.approx(0.125)
    assert strength(data.materials["glow"].node_tree).default_value == pytest.approx(0.25)
    screen = strength(data.materials["screen"].node_tree, "Emission Strength")
    assert screen.default_value == pytest.approx(0.75)
    factor = strength(data.node_groups["linked"]).links[0].from_node
    assert (factor.operation, factor.inputs[1].default_value) == ("MULTIPLY", 0.25)
    assert factor.inputs[0].links[0].from_node.type == "VALUE"


@pytest.mark.parametrize("light", [1.0, 0.02])
def test_materials_are_sampled_alike_in_any_light(light):
    """Cycles sends light paths to bright surfaces only; which are bright is settled before they are dimmed."""

    def build() -> None:
        bpy = cycles.require_bpy()
        group = bpy.data.node_groups.new("group", "ShaderNodeTree")
        group.nodes.new("ShaderNodeEmission").inputs["Strength"].default_value = 3.0
        blender.Shader("grouped").node("Group", node_tree=group)
        blender.Shader("bright").emission((1.0, 0.5, 0.5, 1.0))
        blender.Shader("faint").emission((0.3, 0.2, 0.2, 1.0))
        blender.Shader("matt").surface("#808080")
        blender.Shader("chosen").emission((1.0, 1.0, 1.0, 1.0)).cycles.emission_sampling = "BACK"

    cycles.empty_scene(build)
    cycles.dim(light)
    found = {material.name: material.cycles.emission_sampling for material in cycles.require_bpy().data.materials}
    bright, faint = dict.fromkeys(("grouped", "bright"), "FRONT_BACK"), dict.fromkeys(("faint", "matt"), "NONE")
    assert found == {**bright, **faint, "chosen": "BACK"}


@pytest.fixture
def blend(tmp_path):
    """A floor with a box on it, one lamp, and a camera at EYE that looks at the origin."""
    from mathutils import Matrix

    def build() -> None:
        floor(strength=0.0)
        blender.box("box", (0.6, 0.6, 0.6), blender.Shader("red").surface("#a04030"))
        blender.area_lamp("lamp", (0.0, 0.0, 3.0), 1.0, 100.0)
        bpy = cycles.require_bpy()
        camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
        camera.data.angle_x = ANGLE
        camera.matrix_world = Matrix(look_at(EYE).tolist())
        bpy.context.scene.collection.objects.link(camera)
        bpy.context.scene.camera = camera

    cycles.empty_scene(build)
    path = tmp_path / "box.blend"
    with cycles.quiet():
        cycles.require_bpy().ops.wm.save_as_mainfile(filepath=str(path))
    return path


def test_a_blend_file_is_rendered_from_its_camera_s_place(blend, tmp_path, capfd):
    command = ["scenes", str(blend), f"out={tmp_path / 'out'}", "width=24", "height=16", "samples=4", "views=9"]
    assert main([*command, "extent=0.01", "device=cpu"]) == 0
    rows = np.load(tmp_path / "out/poses_bounds.npy")
    np.testing.assert_allclose(rows[:, 3:15:5], np.broadcast_to(EYE, (9, 3)), atol=0.05)
    back = np.cross(rows[0, 1:15:5], -rows[0, 0:15:5])
    np.testing.assert_allclose(back, EYE / np.linalg.norm(EYE), atol=0.02)
    np.testing.assert_allclose(rows[:, 14], 12 / math.tan(ANGLE / 2))
    depth = np.load(tmp_path / "out/depth/view_004.npy")
    assert 2.5 < np.nanmin(depth) < np.linalg.norm(EYE)
    assert capfd.readouterr().out == ""


def test_the_cameras_of_a_data_set_are_followed_view_by_view(blend, tmp_path):
    """Rendered from the poses in a file, each view equals one taken from that pose directly."""
    small = ["width=24", "samples=4", "denoise=false", "device=cpu"]
    assert (
        main(["scenes", "table", f"out={tmp_path / 'first'}", "width=16", "samples=1", "views=2", "test_views=1"]) == 0
    )
    command = ["scenes", str(blend), f"out={tmp_path / 'second'}", f"trajectory={tmp_path / 'first'}", *small]
    assert main(command) == 0
    cycles.open_blend(blend)
    cycles.set_up_cycles(24, 24, TABLE.camera_angle_x, TABLE.near, TABLE.far)
    cycles.use_radiance(4, 0, denoise=False)
    for index, pose in enumerate(TABLE.train(2, 0)):
        cycles.place_camera(pose)
        found = iio.imread(tmp_path / f"second/train/r_{index}.png")
        np.testing.assert_array_equal(found, to_rgba8(cycles.picture()))


def saved(blend, change) -> None:
    """The file opened, changed and saved again."""
    cycles.open_blend(blend)
    change(cycles.require_bpy())
    with cycles.quiet():
        cycles.require_bpy().ops.wm.save_as_mainfile(filepath=str(blend))


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (
            lambda blend: saved(blend, lambda bpy: setattr(bpy.context.scene, "camera", None)),
            "no perspective camera in its scene",
        ),
        (
            lambda blend: saved(blend, lambda bpy: bpy.data.objects.remove(bpy.data.objects["lamp"])),
            "no lamp, no lit world and no emitting material",
        ),
        (lambda blend: blend.write_bytes(blend.read_bytes()[:100]), "a file that Blender cannot open"),
        (lambda blend: blend.unlink(), "no file"),
    ],
)
def test_bad_blend_files(blend, tmp_path, capfd, spoil, found):
    spoil(blend)
    assert main(["scenes", str(blend), f"out={tmp_path / 'out'}"]) == 1
    assert f"box.blend: found {found}" in capfd.readouterr().err
    assert not (tmp_path / "out").exists()


def test_scripts_in_a_blend_file_are_not_run(blend, tmp_path):
    def add(bpy) -> None:
        text = bpy.data.texts.new("run.py")
        text.write(f"open({str(tmp_path / 'ran')!r}, 'w').close()")
        text.use_module = True

    saved(blend, add)
    cycles.open_blend(blend)
    assert not (tmp_path / "ran").exists()


def test_the_same_command_gives_the_same_files(tmp_path, capfd):
    for name in ("a", "b"):
        command = ["scenes", "table", f"out={tmp_path / name}", "width=24", "samples=2", "views=2", "test_views=1"]
        assert main(command) == 0
    assert len([path for path in (tmp_path / "a").rglob("*") if path.is_file()]) == 9
    assert (tmp_path / "a/SHA256SUMS").read_text() == (tmp_path / "b/SHA256SUMS").read_text()
    assert capfd.readouterr().out == ""
