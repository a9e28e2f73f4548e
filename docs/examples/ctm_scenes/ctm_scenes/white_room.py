"""The scene ``white_room``: a bright, almost empty room, seen from its open side.

Nearly everything in view is blank plaster, which gives a radiance field little to hold on to; a few things stand in
it to make it a place. Lengths are in scene units, about metres, z is up and the floor lies at 0.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ctm_scenes.building import Shader, area_lamp, box, bulb, lathe, mottled, slab, tube, world_light
from ctm_scenes.spec import SceneSpec
from ctm_scenes.trajectory import forward_facing

LEFT, RIGHT, BACK, FRONT, HEIGHT = -1.9, 2.3, 1.4, -4.4, 2.8
WINDOW_Y, WINDOW_Z = (-0.30, 0.80), (0.80, 2.30)
THICK = 0.22


def build() -> None:
    """Fill Blender's current scene."""
    _shell()
    _window()
    _picture()
    _plinth()
    _chair()
    _lamp()
    world_light(lower="#cfc6ba", upper="#dfe6ee", strength=0.5)
    middle = (LEFT - 0.12, sum(WINDOW_Y) / 2, sum(WINDOW_Z) / 2)
    # Inside the room: in the opening it would burn out the reveal.
    area_lamp("sky", (LEFT + 0.15, *middle[1:]), size=1.0, watts=40.0, tint="#e6eefb", target=(0.6, 0.2, 1.1))
    # A low sun, far enough to keep the window's shape on the wall and large enough to soften it.
    sun = (middle[0] - 6.0, middle[1] - 2.7, middle[2] + 2.2)
    area_lamp("sun", sun, size=0.20, watts=400.0, tint="#ffdcb0", target=middle)


def _plaster(name: str, tone: str, faint: str, roughness: float = 0.9) -> Any:
    """Blank but for a slow change of tone at the edge of what can be seen."""
    return mottled(name, 0.9, tone, faint, 2.0, Roughness=roughness)


def _paint(name: str, tone: str, roughness: float = 0.5) -> Any:
    return Shader(name).surface(tone, Roughness=roughness)


def _wood(name: str, dark: str, light: str) -> Any:
    s = Shader(name)
    fibre = s.noise(s.coordinates(scale=(18.0, 18.0, 1.5)), 2.0, 3.0, 0.4)
    return s.surface(s.ramp(fibre, [(0.3, dark), (0.7, light)]), Roughness=0.5)


def _shell() -> None:
    """Walls, floor and ceiling as thick slabs that overlap at the edges, so that no light gets in between."""
    wall = _plaster("wall", "#e6e2da", "#e9e6df")
    out = THICK
    slab("back", (LEFT - out, BACK, -out), (RIGHT + out, BACK + out, HEIGHT + out), wall)
    slab("right", (RIGHT, FRONT, -out), (RIGHT + out, BACK + out, HEIGHT + out), wall)
    slab("ceiling", (LEFT - out, FRONT, HEIGHT), (RIGHT + out, BACK + out, HEIGHT + out), wall)
    floor = _plaster("floor", "#b8aa97", "#bfb2a0", 0.42)
    slab("floor", (LEFT - out, FRONT, -out), (RIGHT + out, BACK + out, 0.0), floor)
    (near, far), (sill, top) = WINDOW_Y, WINDOW_Z
    for name, y, z in (
        ("left_front", (FRONT, near), (-out, HEIGHT + out)),
        ("left_back", (far, BACK + out), (-out, HEIGHT + out)),
        ("left_below", (near, far), (-out, sill)),
        ("left_above", (near, far), (top, HEIGHT + out)),
    ):
        slab(name, (LEFT - out, y[0], z[0]), (LEFT, y[1], z[1]), wall)
    skirting = _paint("skirting", "#eeebe5", 0.6)
    slab("skirting_back", (LEFT + 0.018, BACK - 0.018, 0.0), (RIGHT, BACK + 0.01, 0.11), skirting, 0.005)
    slab("skirting_left", (LEFT - 0.01, FRONT, 0.0), (LEFT + 0.018, BACK, 0.11), skirting, 0.005)


def _window() -> None:
    """Six panes without glass, and a sky behind them that lets the sun's light through."""
    (near, far), (sill, top) = WINDOW_Y, WINDOW_Z
    paint = _paint("sash", "#e9e6e0")
    width, bar = 0.045, 0.022
    inner, low, high = (near + width, far - width), sill + width, top - width
    # Pieces meet or differ in depth: faces that lie in one plane would shade each other.
    for name, depth, y, z in (
        ("sash_near", 0.050, (near, inner[0]), (sill, top)),
        ("sash_far", 0.050, (inner[1], far), (sill, top)),
        ("sash_low", 0.050, inner, (sill, low)),
        ("sash_high", 0.050, inner, (high, top)),
        ("bar_upright", 0.040, ((near + far - bar) / 2, (near + far + bar) / 2), (low, high)),
        ("bar_low", 0.036, inner, ((2 * low + high) / 3 - bar / 2, (2 * low + high) / 3 + bar / 2)),
        ("bar_high", 0.036, inner, ((low + 2 * high) / 3 - bar / 2, (low + 2 * high) / 3 + bar / 2)),
    ):
        slab(name, (LEFT - 0.075 - depth / 2, y[0], z[0]), (LEFT - 0.075 + depth / 2, y[1], z[1]), paint)
    slab("sill", (LEFT - 0.12, near - 0.05, sill - 0.02), (LEFT + 0.07, far + 0.05, sill + 0.012), paint, 0.006)
    s = Shader("daylight")
    height = s.node("SeparateXYZ", {0: s.coordinates("Generated")}).outputs["Z"]
    daylight = s.emission(s.ramp(height, [(0.2, "#efe9df"), (0.7, "#d9e4f0")]))
    sky = slab("daylight", (LEFT - 1.0, -4.0, -1.5), (LEFT - 0.98, 5.0, 4.5), daylight)
    sky.visible_shadow = False


def _art() -> Any:
    """Sun over hills, in flat shapes, laid out in [0, 1] across and up the sheet."""
    s = Shader("art")
    place = s.coordinates("Generated")
    split = s.node("SeparateXYZ", {0: place}).outputs
    across, up = split["X"], split["Z"]

    def disc(x: float, z: float, radius: float) -> Any:
        # The sheet is higher than wide; 1.3 makes the disc round.
        dx, dz = s.math("SUBTRACT", across, x), s.math("MULTIPLY", s.math("SUBTRACT", up, z), 1.3)
        square = s.math("ADD", s.math("MULTIPLY", dx, dx), s.math("MULTIPLY", dz, dz))
        return s.math("LESS_THAN", square, radius * radius)

    def hill(level: float, height: float, waves: float, shift: float) -> Any:
        wave = s.math("SINE", s.math("MULTIPLY_ADD", across, waves, shift))
        return s.math("LESS_THAN", up, s.math("MULTIPLY_ADD", wave, height, level))

    grain = s.noise(place, 60.0)
    tone = s.mix(disc(0.62, 0.66, 0.20), "#e4d6bd", "#c4623f")
    hills = [("#d39c52", 0.47, 0.06, 5.0, 1.0), ("#7d9a97", 0.34, 0.08, 4.0, 3.4), ("#2f5561", 0.17, 0.07, 6.0, 0.3)]
    for paint, *shape in hills:
        tone = s.mix(hill(*shape), tone, paint)
    return s.surface(s.mix(s.math("MULTIPLY", grain, 0.12), tone, "#f3ead9"), Roughness=0.8)


def _picture() -> None:
    x, z, width, height, edge = 0.26, 1.52, 0.66, 0.84, 0.03
    oak = _wood("oak", "#8f6a45", "#a98158")
    low, high = (x - width / 2, z - height / 2), (x + width / 2, z + height / 2)
    front, back = BACK - 0.035, BACK
    slab("frame_left", (low[0], front, low[1]), (low[0] + edge, back, high[1]), oak, 0.003)
    slab("frame_right", (high[0] - edge, front, low[1]), (high[0], back, high[1]), oak, 0.003)
    slab("frame_low", (low[0] + edge, front, low[1]), (high[0] - edge, back, low[1] + edge), oak, 0.003)
    slab("frame_high", (low[0] + edge, front, high[1] - edge), (high[0] - edge, back, high[1]), oak, 0.003)
    for name, rim, depth, material in (
        ("mount", 0.01, 0.015, _paint("mount", "#ece8df", 0.9)),
        ("art", 0.12, 0.012, _art()),
    ):
        slab(name, (low[0] + rim, front + depth, low[1] + rim), (high[0] - rim, back, high[1] - rim), material)


def _plinth() -> None:
    """A plinth of plaster with a stoneware vase and three twigs in bud."""
    x, y, top = -0.98, 0.72, 0.86
    stone = _plaster("plinth", "#d8d3ca", "#dedad2")
    box("plinth", (0.36, 0.36, top), stone, 0.006, location=(x, y, top / 2), rotation=(0, 0, 12))
    s = Shader("vase")
    height = s.node("SeparateXYZ", {0: s.coordinates()}).outputs["Z"]
    rim = s.math("MULTIPLY_ADD", s.noise(s.coordinates(), 8.0), 0.06, height)
    wet = s.math("GREATER_THAN", rim, 0.13)
    glaze = s.surface(s.mix(wet, "#8a6a50", s.tone(6.0, "#2f5a60", "#487a7e")), Roughness=0.35)
    vase = [(0, 0), (0.065, 0), (0.075, 0.008), (0.095, 0.05), (0.125, 0.13), (0.13, 0.19), (0.105, 0.255)]
    vase += [(0.06, 0.30), (0.04, 0.335), (0.038, 0.375), (0.05, 0.40), (0.044, 0.402), (0.030, 0.375), (0.030, 0.33)]
    vase += [(0, 0.26)]
    lathe("vase", vase, glaze, location=(x, y, top))
    twig = _paint("twig", "#6b5138", 0.8)
    bud = _paint("bud", "#d9a5a0", 0.7)
    t = np.linspace(0.0, 1.0, 16)[:, None]
    for k, (degrees, lean, length) in enumerate(((15.0, 0.34, 0.62), (165.0, 0.22, 0.78), (60.0, 0.10, 0.70))):
        outward = np.array([math.cos(math.radians(degrees)), 0.4 * math.sin(math.radians(degrees)), 0.0])
        path = np.array([x, y, top + 0.30]) + t * [0.0, 0.0, length] + (lean * t**1.8) * outward
        path = path + 0.015 * np.sin(9.0 * t + k) * [1.0, 0.5, 0.0]
        tube(f"twig_{k}", path, 0.0055, twig, 8)
        for step in range(6, 16):
            side = -1.0 if step % 2 else 1.0
            spot = path[step] + [0.022 * side, 0.012 * math.sin(step + k), 0.012]
            size = 0.017 + 0.006 * math.sin(2.3 * step + k)
            ball = [(0, -size), (0.7 * size, -0.6 * size), (size, 0), (0.7 * size, 0.6 * size), (0, size)]
            lathe(f"bud_{k}_{step}", ball, bud, 10, location=spot.tolist())


def _chair() -> None:
    """A chair of round bars with a solid seat, half turned to the window."""
    x, y, turn = 0.34, 0.32, math.radians(28.0)
    paint = _wood("chair", "#b9822f", "#c9933f")

    def at(u: float, v: float, z: float) -> tuple[float, float, float]:
        return (x + math.cos(turn) * u - math.sin(turn) * v, y + math.sin(turn) * u + math.cos(turn) * v, z)

    place = {"location": at(0, 0, 0.45), "rotation": (0, 0, math.degrees(turn))}
    box("seat", (0.44, 0.42, 0.035), paint, 0.012, **place)
    for side in (-1.0, 1.0):
        tube("front_leg", [at(0.21 * side, -0.21, 0), at(0.17 * side, -0.16, 0.44)], 0.016, paint)
        tube("back_leg", [at(0.21 * side, 0.22, 0), at(0.17 * side, 0.16, 0.44)], 0.016, paint)
        tube("rail", [at(0.19 * side, -0.185, 0.22), at(0.19 * side, 0.19, 0.22)], 0.010, paint)
        tube("post", [at(0.185 * side, 0.18, 0.44), at(0.20 * side, 0.25, 0.90)], 0.014, paint)
    tube("stretcher", [at(-0.19, 0, 0.22), at(0.19, 0, 0.22)], 0.010, paint)
    for k in range(5):
        u = 0.066 * (k - 2)
        tube(f"spindle_{k}", [at(u, 0.18, 0.46), at(1.05 * u, 0.262, 0.86)], 0.008, paint, 8)
    t = np.linspace(-1.0, 1.0, 13)
    crest = [at(0.225 * k, 0.272 - 0.03 * k * k, 0.885) for k in t.tolist()]
    tube("crest", crest, 0.024, paint, 16)


def _lamp() -> None:
    """A floor lamp whose linen shade glows a little."""
    x, y = 1.16, 0.98
    metal = _paint("metal", "#33302c", 0.4)
    foot = [(0, 0), (0.14, 0), (0.145, 0.006), (0.14, 0.016), (0.02, 0.022), (0, 0.022)]
    lathe("foot", foot, metal, location=(x, y, 0))
    tube("pole", [(x, y, 0.01), (x, y, 1.52)], 0.009, metal)
    s = Shader("shade")
    weave = s.noise(s.coordinates(scale=(30.0, 30.0, 4.0)), 3.0)
    linen = s.ramp(weave, [(0.3, "#d8c8ac"), (0.7, "#e2d4bb")])
    glow = s.mix(1.0, linen, "#ffc98a", "MULTIPLY")
    shade = s.surface(linen, Roughness=0.9, Emission_Color=glow, Emission_Strength=0.35)
    # Two points close together keep the edges of the shade.
    drum = [(0.215, 1.37), (0.214, 1.375), (0.166, 1.655), (0.165, 1.66), (0.161, 1.66), (0.160, 1.655)]
    drum += [(0.209, 1.375), (0.211, 1.37)]
    lathe("shade", drum, shade, location=(x, y, 0))
    bulb("glow", (x, y, 1.50), 0.04, 2.5, "#ffb66b")


WHITE_ROOM = SceneSpec(
    name="white_room",
    build=build,
    train=lambda count, seed: forward_facing(count, (0.78, -2.75, 1.36), (-0.20, 0.75, 1.08), (0.7, 0.6), seed=seed),
    test=None,
    camera_angle_x=math.radians(54.0),
    near=2.0,
    far=6.5,
    views=49,
    transparent=False,
)
