"""The scene ``still_life``: a vase with branches, books, fruit and brass on a turned stand, all inside 1.2 units.

Everything is built here from polygons, modifiers and procedural textures. Lengths are in scene units, z is up, and the
table top of the stand lies at ``TOP``.
"""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np

from ctm_scenes.building import Shader, area_lamp, box, lathe, mesh, mottled, world_light
from ctm_scenes.spec import SceneSpec
from ctm_scenes.trajectory import hemisphere, orbit

TOP = -0.45
STAND_RADIUS = 0.98
RADIUS = 4.0


def build() -> None:
    """Fill Blender's current scene."""
    _stand()
    _cloth()
    _vase()
    _books()
    _fruit()
    _candlestick()
    _cup()
    world_light(lower="#8d8378", upper="#dfe8f2", strength=0.6)
    area_lamp("key", (-3.2, -2.6, 4.6), size=2.6, watts=400.0, tint="#ffe9cc")
    area_lamp("fill", (4.2, -1.4, 2.6), size=3.0, watts=115.0, tint="#d5e4ff")
    area_lamp("back", (0.8, 4.4, 3.2), size=2.4, watts=185.0, tint="#fff3e0")


def _wood() -> Any:
    s = Shader("wood")
    grain = s.coordinates(scale=(0.35, 1.0, 1.0), turn=(0.1, 0.3, 0.3))
    # Growth rings: noise stretched along the trunk, cut into bands.
    height = s.noise(grain, 1.3, 2.0, 0.4)
    rings = s.math("PINGPONG", s.math("MULTIPLY", height, 22.0), 1.0)
    tone = s.ramp(rings, [(0.0, "#73502f"), (0.5, "#8b6241"), (1.0, "#a07850")])
    fibre = s.noise(s.coordinates(scale=(3.0, 40.0, 40.0), turn=(0.1, 0.25, 0.3)), 2.0)
    shade = s.ramp(fibre, [(0.3, "#b0a89e"), (0.7, "#ffffff")])
    return s.surface(s.mix(0.8, tone, shade, "MULTIPLY"), fibre, 0.004, Roughness=0.45)


def _stand() -> None:
    rim = STAND_RADIUS
    profile = [(0, -0.29), (0.60, -0.29), (0.64, -0.285), (0.66, -0.27), (0.66, -0.25), (0.62, -0.235)]
    profile += [(0.56, -0.21), (0.58, -0.17), (0.72, -0.14), (0.90, -0.12), (rim - 0.01, -0.105), (rim, -0.09)]
    profile += [(rim, -0.075), (rim - 0.025, -0.065), (rim - 0.025, -0.05), (rim, -0.04), (rim, -0.015)]
    profile += [(rim - 0.015, 0), (0.9, 0), (0, 0)]
    lathe("stand", profile, _wood(), location=(0, 0, TOP))


def _linen() -> Any:
    s = Shader("linen")
    uv = s.coordinates("UV", scale=(6.0, 6.0, 1.0))
    split = s.node("SeparateXYZ", {0: uv}).outputs
    stripes = [s.math("GREATER_THAN", s.math("FRACT", split[axis]), 0.5) for axis in ("X", "Y")]
    # Gingham: one thread direction dyed is a half tone, both are the full tone.
    check = s.math("MULTIPLY", s.math("ADD", *stripes), 0.5)
    tone = s.ramp(check, [(0.0, "#d9d0bd"), (0.5, "#b3b39c"), (1.0, "#84917a")])
    warp, weft = (
        s.node("TexWave", {"Vector": uv, "Scale": 9.0, "Distortion": 0.6}, bands_direction=axis).outputs["Fac"]
        for axis in ("X", "Y")
    )
    weave = s.math("MULTIPLY", warp, weft)
    wear = s.ramp(s.noise(uv, 1.5), [(0.3, "#d8d2c8"), (0.7, "#ffffff")])
    tone = s.mix(0.9, tone, wear, "MULTIPLY")
    tone = s.mix(s.math("MULTIPLY", weave, 0.25), tone, "#f0e8d8")
    return s.surface(tone, weave, 0.006, Roughness=0.95)


def _cloth() -> None:
    """A square of linen, off centre, its corners hanging over the rim in soft folds."""
    count, edge = 120, 1.28
    line = np.linspace(-edge / 2, edge / 2, count)
    u, v = np.meshgrid(line, line, indexing="ij")
    turn = math.radians(27.0)
    x = math.cos(turn) * u - math.sin(turn) * v + 0.20
    y = math.sin(turn) * u + math.cos(turn) * v - 0.22
    distance, angle = np.hypot(x, y), np.arctan2(y, x)
    bend, lift = 0.035, 0.012
    over = np.maximum(distance - STAND_RADIUS, 0.0)
    arc = np.minimum(over / bend, math.pi / 2)
    hang = np.maximum(over - bend * math.pi / 2, 0.0)
    reach = np.minimum(distance, STAND_RADIUS) + bend * np.sin(arc)
    reach = reach + hang * (0.10 + 0.22 * np.sin(14.0 * angle + 3.0 * u))
    ripple = 0.004 * np.sin(9.0 * u + 4.0 * v) * np.sin(7.0 * v - 2.0 * u)
    z = lift + ripple * (over == 0.0) - bend * (1.0 - np.cos(arc)) - hang
    vertices = np.stack([reach * np.cos(angle), reach * np.sin(angle), z], axis=-1).reshape(-1, 3)
    grid = np.arange(count * count).reshape(count, count)
    faces = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=-1).reshape(-1, 4)
    uv = (np.stack([u, v], axis=-1).reshape(-1, 2) / edge + 0.5)[faces.ravel()]
    cloth = mesh("cloth", vertices, faces.tolist(), _linen(), uv, location=(0, 0, TOP))
    cloth.modifiers.new("thickness", "SOLIDIFY").thickness = 0.012


def _glaze() -> Any:
    """Cream crackle glaze with a hand-painted blue band, zigzags and rings, laid out in the vase's UV."""
    s = Shader("glaze")
    split = s.node("SeparateXYZ", {0: s.coordinates("UV")}).outputs
    wobble = s.math("MULTIPLY", s.math("SUBTRACT", s.noise(s.coordinates(), 9.0), 0.5), 0.012)
    height = s.math("ADD", split["Y"], wobble)
    around = split["X"]

    def band(low: float, high: float) -> Any:
        return s.math("MULTIPLY", s.math("GREATER_THAN", height, low), s.math("LESS_THAN", height, high))

    zigzag = s.math("PINGPONG", s.math("MULTIPLY", around, 14.0), 1.0)
    # The profile's length is the vertical axis: the zigzag climbs from 0.165 to 0.235, lozenges stand around 0.335.
    line = s.math("ABSOLUTE", s.math("SUBTRACT", height, s.math("MULTIPLY_ADD", zigzag, 0.07, 0.165)))
    zigzag = s.math("LESS_THAN", line, 0.013)
    cell = s.math("SUBTRACT", s.math("FRACT", s.math("MULTIPLY", around, 9.0)), 0.5)
    rise = s.math("DIVIDE", s.math("SUBTRACT", height, 0.335), 0.075)
    lozenge = s.math("ADD", s.math("MULTIPLY", s.math("ABSOLUTE", cell), 2.2), s.math("ABSOLUTE", rise))
    ring = s.math("MULTIPLY", s.math("GREATER_THAN", lozenge, 0.72), s.math("LESS_THAN", lozenge, 1.0))
    paint = s.math("ADD", ring, s.math("LESS_THAN", lozenge, 0.38))
    bands = [(0.135, 0.148), (0.255, 0.268), (0.405, 0.42), (0.445, 0.475), (0.53, 0.545)]
    for part in (zigzag, *(band(low, high) for low, high in bands)):
        paint = s.math("MAXIMUM", paint, part)
    cream, blue = s.tone(5.0, "#c9bda6", "#dcd3bf"), s.tone(14.0, "#34507c", "#5f7fa6")
    crackle = s.node("TexVoronoi", {"Vector": s.coordinates(), "Scale": 16.0}, feature="DISTANCE_TO_EDGE").outputs[0]
    cracked = s.ramp(crackle, [(0.0, "#b7a98f"), (0.05, "#ffffff")])
    tone = s.mix(0.5, s.mix(paint, cream, blue), cracked, "MULTIPLY")
    return s.surface(tone, Roughness=0.28, Coat_Weight=0.25, Coat_Roughness=0.12)


def _vase() -> None:
    outside = [(0, 0), (0.13, 0), (0.15, 0.005), (0.155, 0.03), (0.175, 0.09), (0.235, 0.20), (0.27, 0.31)]
    outside += [(0.262, 0.42), (0.215, 0.51), (0.145, 0.575), (0.098, 0.63), (0.09, 0.68), (0.105, 0.725)]
    outside += [(0.135, 0.745)]
    inside = [(0.138, 0.755), (0.130, 0.757), (0.095, 0.735), (0.075, 0.68), (0.082, 0.62), (0.12, 0.56), (0, 0.45)]
    spot = (-0.30, 0.30, TOP)
    lathe("vase", outside + inside, _glaze(), location=spot)
    _branches(np.array([spot[0], spot[1], TOP + 0.60]))


def _branches(root: np.ndarray) -> None:
    """Eucalyptus: bent stems as tubes with round grey-green leaves in pairs, one mesh for each material."""
    chance = random.Random(11)
    stems: tuple[list, list] = ([], [])
    leaves: tuple[list, list] = ([], [])
    t = np.linspace(0.0, 1.0, 22)[:, None]
    sprigs = [(20, 0.30, 0.62), (150, 0.42, 0.60), (255, 0.50, 0.58), (320, 0.26, 0.78), (85, 0.16, 0.72)]
    for degrees, lean, length in sprigs:
        outward = np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees)), 0.0])
        aside, up = np.array([-outward[1], outward[0], 0.0]), np.array([0.0, 0.0, length])
        path = root + t * up + (lean * t**1.7 + 0.03 * t) * outward + 0.05 * np.sin(5.0 * t) * aside
        _tube(stems, path, 0.011, 0.006)
        for step in range(6, 22, 2):
            for side in (-1.0, 1.0):
                along = path[step] - path[step - 1]
                along = along / np.linalg.norm(along)
                turn = 0.9 * step + (0.0 if side > 0 else math.pi) + chance.uniform(-0.3, 0.3)
                stick = math.cos(turn) * aside + math.sin(turn) * np.cross(along, aside)
                size = (0.088 - 0.0022 * step) * chance.uniform(0.85, 1.1)
                _leaf(leaves, path[step], 0.85 * stick + 0.55 * along, along, size)
    for name, (vertices, faces), material in (("stems", stems, _bark()), ("leaves", leaves, _leaf_skin())):
        mesh(name, np.array(vertices), faces, material)


def _tube(into: tuple[list, list], path: np.ndarray, thick: float, thin: float, sides: int = 8) -> None:
    """Append a tapering tube around ``path`` ``[N, 3]`` to (vertices, faces)."""
    vertices, faces = into
    first = len(vertices)
    for i, point in enumerate(path):
        along = path[min(i + 1, len(path) - 1)] - path[max(i - 1, 0)]
        across = np.cross(along, [1.0, 0.0, 0.0])
        across = across / np.linalg.norm(across)
        other = np.cross(along / np.linalg.norm(along), across)
        radius = thick + (thin - thick) * i / (len(path) - 1)
        for k in range(sides):
            angle = 2.0 * math.pi * k / sides
            vertices.append(point + radius * (math.cos(angle) * across + math.sin(angle) * other))
    for i in range(len(path) - 1):
        for k in range(sides):
            a, b = first + i * sides + k, first + i * sides + (k + 1) % sides
            faces.append([a, b, b + sides, a + sides])


def _leaf(into: tuple[list, list], base: np.ndarray, stick: np.ndarray, along: np.ndarray, size: float) -> None:
    """Append a round, slightly cupped leaf that grows from ``base`` towards ``stick``."""
    vertices, faces = into
    first, sides = len(vertices), 14
    forward = stick / np.linalg.norm(stick)
    across = np.cross(forward, along)
    across = across / np.linalg.norm(across)
    normal = np.cross(across, forward)
    centre = base + forward * size * 1.05
    vertices.append(centre - 0.12 * size * normal)
    for k in range(sides):
        angle = 2.0 * math.pi * k / sides
        vertices.append(centre + size * (math.cos(angle) * forward + 0.8 * math.sin(angle) * across))
    faces.extend([first, first + 1 + k, first + 1 + (k + 1) % sides] for k in range(sides))


def _bark() -> Any:
    return mottled("bark", 12.0, "#6a5340", "#8a7056", Roughness=0.8)


def _leaf_skin() -> Any:
    s = Shader("leaf")
    tone = s.ramp(s.noise(s.coordinates(), 7.0, 4.0), [(0.3, "#4f6a58"), (0.5, "#6f8a74"), (0.7, "#93a78c")])
    return s.surface(tone, Roughness=0.55)


def _cover(name: str, base: str, worn: str, band: str) -> Any:
    """Book cloth: a fine weave, worn patches, and a band in another colour across the boards and the spine."""
    s = Shader(name)
    place = s.coordinates()
    worn_patch = s.ramp(s.noise(place, 6.0, 4.0), [(0.35, base), (0.75, worn)])
    x = s.node("SeparateXYZ", {0: place}).outputs["X"]
    edge = s.math("ABSOLUTE", s.math("SUBTRACT", s.math("ABSOLUTE", x), 0.20))
    tone = s.mix(s.math("LESS_THAN", edge, 0.022), worn_patch, band)
    weave = s.node("TexChecker", {"Vector": place, "Scale": 90.0}).outputs["Fac"]
    return s.surface(s.mix(s.math("MULTIPLY", weave, 0.10), tone, "#000000"), weave, 0.002, Roughness=0.75)


def _paper() -> Any:
    s = Shader("paper")
    leaves = s.noise(s.coordinates(scale=(2.0, 2.0, 90.0)), 1.2)
    return s.surface(s.ramp(leaves, [(0.3, "#b5a88c"), (0.7, "#ded3ba")]), Roughness=0.9)


def _books() -> None:
    """Three books, lying on each other, their spines towards -y of each book."""
    paper, z = _paper(), TOP + 0.015
    for name, size, turn, shift, tones in (
        ("book_green", (0.66, 0.47, 0.105), 24.0, (0.0, 0.0), ("#3f5a50", "#5d7a6c", "#b59a5f")),
        ("book_red", (0.58, 0.42, 0.085), 12.0, (0.01, -0.01), ("#7a3f38", "#97605a", "#cdb98e")),
        ("book_ochre", (0.50, 0.36, 0.070), 38.0, (-0.01, 0.01), ("#a9803f", "#c29f63", "#5a4a3a")),
    ):
        length, width, height = size
        board, cover = 0.014, _cover(name, *tones)
        centre = np.array([0.42 + shift[0], 0.26 + shift[1], z + height / 2])
        around = math.radians(turn)
        inward = np.array([-math.sin(around), math.cos(around), 0.0])
        place = {"rotation": (0, 0, turn)}
        box(
            f"{name}_pages", (length - 0.03, width - 0.03, height - 2 * board), paper, location=centre.tolist(), **place
        )
        for sign in (-1, 1):
            lid = centre + np.array([0.0, 0.0, sign * (height - board) / 2])
            box(f"{name}_board{sign}", (length, width, board), cover, 0.004, location=lid.tolist(), **place)
        spine = centre - inward * (width - board) / 2
        box(f"{name}_spine", (length, board, height), cover, 0.006, location=spine.tolist(), **place)
        z += height


def _skin(name: str, stops: list[tuple[float, str]], scale: float, bump: float, **surface: float) -> Any:
    """Fruit skin: a ramp over coarse noise, finer speckles, dimples by Voronoi cells."""
    s = Shader(name)
    place = s.coordinates()
    tone = s.ramp(s.noise(place, scale, 4.0, 0.6), stops)
    speckle = s.ramp(s.noise(place, 26.0, 2.0), [(0.35, "#d8c9b0"), (0.55, "#ffffff")])
    pores = s.node("TexVoronoi", {"Vector": place, "Scale": 42.0}).outputs["Distance"]
    return s.surface(s.mix(0.6, tone, speckle, "MULTIPLY"), pores, bump, **surface)


def _fruit() -> None:
    stalk = _bark()
    cloth = TOP + 0.015
    pear_skin = _skin("pear", [(0.35, "#8d8f3f"), (0.55, "#b3a550"), (0.72, "#b8793f")], 4.0, 0.002, Roughness=0.42)
    pear = [(0, 0.02), (0.05, 0.0), (0.11, 0.02), (0.165, 0.08), (0.175, 0.145), (0.15, 0.22), (0.105, 0.29)]
    pear += [(0.08, 0.345), (0.062, 0.39), (0.03, 0.412), (0, 0.40)]
    place = {"location": (-0.56, -0.28, cloth - 0.015), "rotation": (5, -6, 30)}
    lathe("pear", pear, pear_skin, **place)
    lathe("pear_stalk", [(0.012, 0.39), (0.009, 0.45), (0.012, 0.48), (0, 0.482)], stalk, 12, **place)

    orange_skin = _skin("orange", [(0.3, "#c8752d"), (0.7, "#dd9546")], 3.0, 0.003, Roughness=0.4)
    orange = [(0, 0.0), (0.06, 0.006), (0.12, 0.04), (0.163, 0.10), (0.172, 0.16), (0.155, 0.23), (0.105, 0.295)]
    orange += [(0.045, 0.322), (0.016, 0.318), (0, 0.31)]
    lathe("orange", orange, orange_skin, location=(-0.16, -0.50, cloth), rotation=(0, 0, 10))

    apple_skin = _skin("apple", [(0.35, "#8e3a35"), (0.52, "#a8524a"), (0.70, "#b99b55")], 2.2, 0.001, Roughness=0.3)
    apple = [(0, 0.03), (0.035, 0.012), (0.07, 0.0), (0.12, 0.03), (0.165, 0.11), (0.178, 0.19), (0.155, 0.265)]
    apple += [(0.10, 0.305), (0.05, 0.30), (0.018, 0.27), (0, 0.26)]
    place = {"location": (0.23, -0.42, cloth), "rotation": (6, 4, 200)}
    lathe("apple", apple, apple_skin, **place)
    lathe("apple_stalk", [(0.01, 0.26), (0.008, 0.31), (0.011, 0.345), (0, 0.347)], stalk, 12, **place)

    lemon_skin = _skin("lemon", [(0.3, "#c9ae45"), (0.7, "#dcc665")], 3.0, 0.003, Roughness=0.4)
    lemon = [(0, -0.19), (0.022, -0.182), (0.036, -0.16), (0.075, -0.125), (0.115, -0.06), (0.125, 0.0)]
    lemon += [(0.113, 0.065), (0.07, 0.125), (0.035, 0.152), (0.025, 0.172), (0, 0.178)]
    lathe("lemon", lemon, lemon_skin, location=(0.60, -0.27, cloth + 0.122), rotation=(90, 0, 62))


def _brass() -> Any:
    s = Shader("brass")
    tone = s.ramp(s.noise(s.coordinates(), 6.0, 4.0), [(0.3, "#9a7a45"), (0.65, "#c4a265")])
    rough = s.math("MULTIPLY_ADD", s.noise(s.coordinates(), 9.0), 0.25, 0.25)
    return s.surface(tone, Metallic=1.0, Roughness=rough)


def _candlestick() -> None:
    stick = [(0, 0), (0.12, 0), (0.125, 0.008), (0.12, 0.02), (0.07, 0.035), (0.03, 0.055), (0.022, 0.09)]
    stick += [(0.04, 0.115), (0.022, 0.14), (0.018, 0.22), (0.03, 0.25), (0.045, 0.262), (0.075, 0.275)]
    stick += [(0.08, 0.285), (0.05, 0.285), (0.045, 0.30), (0.045, 0.325), (0, 0.325)]
    spot = (0.0, -0.10, TOP + 0.012)
    lathe("candlestick", stick, _brass(), location=spot)
    wax = mottled("wax", 8.0, "#cfc4ab", "#ded5c0", Roughness=0.5)
    lathe("candle", [(0.036, 0.30), (0.036, 0.55), (0.033, 0.562), (0.015, 0.555), (0, 0.553)], wax, 32, location=spot)
    wick = Shader("wick").surface("#3a332c", Roughness=0.9)
    lathe("wick", [(0.006, 0.55), (0.006, 0.585), (0, 0.587)], wick, 8, location=spot)


def _cup() -> None:
    s = Shader("stoneware")
    place = s.coordinates()
    speckle = s.node("TexVoronoi", {"Vector": place, "Scale": 24.0}).outputs["Distance"]
    body = s.ramp(s.noise(place, 4.0), [(0.3, "#7e8c92"), (0.7, "#9daab0")])
    height = s.node("SeparateXYZ", {0: place}).outputs["Z"]
    glazed = s.math("GREATER_THAN", s.math("MULTIPLY_ADD", s.noise(place, 7.0), 0.05, height), 0.13)
    tone = s.mix(glazed, "#8b6f57", body)
    tone = s.mix(s.math("LESS_THAN", speckle, 0.16), tone, "#564a42")
    stoneware = s.surface(tone, Roughness=0.4)
    cup = [(0, 0), (0.085, 0), (0.095, 0.006), (0.10, 0.03), (0.125, 0.10), (0.135, 0.17), (0.132, 0.225)]
    cup += [(0.128, 0.232), (0.120, 0.228), (0.118, 0.17), (0.108, 0.09), (0, 0.03)]
    lathe("cup", cup, stoneware, location=(0.08, 0.66, TOP))


STILL_LIFE = SceneSpec(
    name="still_life",
    build=build,
    train=lambda count, seed: hemisphere(count, RADIUS, (2.0, 75.0), seed=seed),
    test=lambda count, seed: orbit(count, RADIUS, (15.0, 50.0)),
    camera_angle_x=math.radians(36.0),
    near=2.0,
    far=6.0,
)
