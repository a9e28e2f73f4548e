"""The scene ``stairwell``: a staircase between plain walls at dusk, blue sky in the window and one warm lamp.

Flat steps, thin balusters and hardly any texture. Lengths are in scene units, about metres, z is up and the floor of
the hall lies at 0.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ctm_scenes.building import Shader, area_lamp, bulb, lathe, mesh, mottled, slab, tube, world_light
from ctm_scenes.spec import SceneSpec
from ctm_scenes.trajectory import forward_facing

LEFT, RIGHT, BACK, FRONT, HEIGHT = -1.75, 2.6, 1.7, -4.4, 4.2
RISE, GOING = 0.18, 0.28
INNER, EDGE = -0.75, 0.70
"""Open side of the lower flight in x, of the upper flight in y; the landing is in the corner behind both."""
LOWER, UPPER = 4, 13
"""Risers up to the landing and from there on."""
LANDING = LOWER * RISE
THICK = 0.25


def build() -> None:
    """Fill Blender's current scene."""
    _walls()
    _window()
    _steps()
    _railing()
    _pendant()
    _pot()
    world_light(lower="#6a7690", upper="#9db4dc", strength=0.30)
    area_lamp("skylight", (0.3, -1.4, 3.95), size=2.0, watts=108.0, tint="#93b3f0", target=(0.2, -0.9, 0.0))
    area_lamp("dusk", (-0.98, BACK - 0.25, 2.4), size=0.6, watts=10.0, tint="#8fb2f5", target=(-0.4, -1.2, 0.9))


def _plaster(name: str, tone: str, faint: str, roughness: float = 0.9) -> Any:
    return mottled(name, 0.8, tone, faint, 2.0, Roughness=roughness)


def _walls() -> None:
    """Thick slabs that overlap at the edges; the back wall has the window's hole and so is made there."""
    wall, out = _plaster("wall", "#d9d4cc", "#dedad3"), THICK
    slab("left", (LEFT - out, FRONT, -out), (LEFT, BACK + out, HEIGHT + out), wall)
    slab("right", (RIGHT, FRONT, -out), (RIGHT + out, BACK + out, HEIGHT + out), wall)
    slab("ceiling", (LEFT - out, FRONT, HEIGHT), (RIGHT + out, BACK + out, HEIGHT + out), wall)
    floor = _plaster("floor", "#a39a90", "#aaa299", 0.5)
    slab("floor", (LEFT - out, FRONT, -out), (RIGHT + out, BACK + out, 0.0), floor)


def _arch(x: float, z: float, radius: float, drop: float, angle: np.ndarray) -> np.ndarray:
    """Outline of a round-headed opening as seen from the middle of its arc: ``[N]`` angles to ``[N, 2]`` (x, z)."""
    cos, sin = np.cos(angle), np.sin(angle)
    # Below the arc the opening goes straight down by ``drop``.
    below = np.minimum(radius / np.maximum(np.abs(cos), 1e-9), drop / np.maximum(-sin, 1e-9))
    reach = np.where(sin < 0.0, below, radius)
    return np.stack([x + reach * cos, z + reach * sin], axis=-1)


def _window() -> None:
    """The back wall around an arched window, its bars, and the evening sky behind."""
    x, z, radius, drop = -0.98, 2.62, 0.36, 0.78
    # The wall reaches a little into its neighbours.
    left, right, low, high = LEFT - 0.1, RIGHT + 0.1, -0.1, HEIGHT + 0.1
    corners = np.array([[left, low], [right, low], [right, high], [left, high]])
    hole_corners = np.array([[x - radius, z - drop], [x + radius, z - drop]])
    special = np.concatenate([corners, hole_corners]) - [x, z]
    # The corners of the wall and of the opening must be among the directions, or they would be cut off.
    angle = np.concatenate([np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False), np.arctan2(*special.T[::-1])])
    angle = np.unique(np.round(np.mod(angle, 2.0 * np.pi), 9))
    cos, sin = np.cos(angle), np.sin(angle)
    to_x = np.where(cos > 0.0, right - x, x - left) / np.maximum(np.abs(cos), 1e-9)
    to_z = np.where(sin > 0.0, high - z, z - low) / np.maximum(np.abs(sin), 1e-9)
    reach = np.minimum(to_x, to_z)
    rim = np.stack([x + reach * cos, z + reach * sin], axis=-1)
    outline = _arch(x, z, radius, drop, angle)
    count = len(angle)
    inner = np.insert(outline, 1, BACK, axis=1)
    vertices = np.concatenate([inner, np.insert(rim, 1, BACK, axis=1), inner + np.array([0.0, THICK, 0.0])])
    faces = []
    for k in range(count):
        after = (k + 1) % count
        faces.append([k, after, count + after, count + k])
        faces.append([after, k, 2 * count + k, 2 * count + after])
    mesh("back", vertices, faces, _plaster("back", "#d9d4cc", "#dedad3"), smooth=False)

    paint = Shader("sash").surface("#5d554c", Roughness=0.5)
    depth = BACK + 0.14
    frame = np.insert(_arch(x, z, radius - 0.012, drop - 0.012, angle), 1, depth, axis=1)
    tube("sash", [*frame, frame[0]], 0.022, paint, 8)
    tube("bar_upright", [(x, depth, z - drop), (x, depth, z + radius)], 0.012, paint, 8)
    for level in (z - 0.40, z):
        tube("bar", [(x - radius, depth, level), (x + radius, depth, level)], 0.012, paint, 8)
    s = Shader("evening")
    height = s.node("SeparateXYZ", {0: s.coordinates("Generated")}).outputs["Z"]
    tones = [(0.30, "#f0bd92"), (0.42, "#c9b2bd"), (0.55, "#86a0d0"), (0.80, "#5f80bf")]
    slab("evening", (LEFT - 2.5, BACK + 0.9, 0.5), (RIGHT + 1.0, BACK + 0.92, 5.5), s.emission(s.ramp(height, tones)))


def _steps() -> None:
    """Both flights as solid blocks down to the floor, with treads of stone that stand out a little."""
    body = _plaster("body", "#d6d1c9", "#dbd7d0")
    tread = _plaster("tread", "#8f8a86", "#98938f", 0.6)
    nose, thin = 0.02, 0.035

    def block(name: str, low: tuple[float, float], high: tuple[float, float], top: float) -> None:
        slab(name, (*low, -0.1), (*high, top - thin), body)

    for k in range(1, LOWER + 1):
        front = EDGE - (LOWER - k) * GOING
        # The blocks only touch: faces that lie in one plane would shade each other.
        block("lower", (LEFT - 0.1, front), (INNER, BACK + 0.1 if k == LOWER else front + GOING), k * RISE)
        behind = BACK if k == LOWER else front + GOING + 0.01
        slab("lower_tread", (LEFT, front - nose, k * RISE - thin), (INNER + nose, behind, k * RISE), tread, 0.005)
    for k in range(1, UPPER + 1):
        left, top = INNER + (k - 1) * GOING, LANDING + k * RISE
        block("upper", (left, EDGE), (left + GOING, BACK + 0.1), top)
        low, high = (left - nose, EDGE - nose, top - thin), (left + GOING + 0.01, BACK, top)
        slab("upper_tread", low, high, tread, 0.005)


def _railing() -> None:
    """Newels, two balusters a step and a rail that follows each flight."""
    wood = Shader("rail").surface("#5a3b28", Roughness=0.35)
    iron = Shader("iron").surface("#2e2d30", Roughness=0.45)
    inset, tall, thin = 0.06, 0.86, 0.0085
    x, y = INNER - inset, EDGE + inset

    def newel(name: str, at: tuple[float, float], bottom: float, top: float) -> None:
        slab(name, (at[0] - 0.035, at[1] - 0.035, bottom), (at[0] + 0.035, at[1] + 0.035, top), wood, 0.006)
        cap = [(0, 0), (0.045, 0), (0.048, 0.012), (0.045, 0.02), (0.035, 0.03), (0.045, 0.06), (0.03, 0.09)]
        cap += [(0, 0.098)]
        lathe(f"{name}_cap", cap, wood, 32, location=(*at, top))

    start = EDGE - (LOWER - 1) * GOING
    # Height of the rail where a step's middle is: its tread and ``tall``.
    slope = RISE / GOING
    foot = (x, start + 0.06)

    def lower(along: float) -> float:
        return RISE + tall + slope * (along - start - GOING / 2)

    def upper(along: float) -> float:
        return LANDING + RISE + tall + slope * (along - INNER - GOING / 2)

    newel("newel_foot", foot, RISE - 0.01, lower(foot[1]) + 0.03)
    newel("newel_turn", (x, y), LANDING - 0.01, upper(x) + 0.06)
    tube("lower_rail", [(x, foot[1], lower(foot[1])), (x, y, lower(y))], 0.026, wood, 20)
    end = INNER + UPPER * GOING
    tube("upper_rail", [(x, y, upper(x)), (end, y, upper(end))], 0.026, wood, 20)
    for k in range(LOWER - 1):
        for part in (0.25, 0.75):
            along = start + (k + part) * GOING
            if along > foot[1] + 0.05:
                tube("baluster", [(x, along, (k + 1) * RISE - 0.01), (x, along, lower(along))], thin, iron, 10)
    for k in range(UPPER):
        for part in (0.25, 0.75):
            along = INNER + (k + part) * GOING
            tube("baluster", [(along, y, LANDING + (k + 1) * RISE - 0.01), (along, y, upper(along))], thin, iron, 10)


def _pendant() -> None:
    """A glass globe on a long cord. The lamp is inside, so the globe must not cast its own shadow."""
    x, y, z, radius = 0.22, 0.10, 2.42, 0.115
    brass = Shader("brass").surface("#a9834c", Metallic=1.0, Roughness=0.35)
    cord = Shader("cord").surface("#2b2826", Roughness=0.8)
    tube("cord", [(x, y, z + radius), (x, y, HEIGHT)], 0.006, cord, 8)
    cup = [(0.05, -0.01), (0.05, 0.02), (0.03, 0.05), (0.01, 0.065), (0, 0.066)]
    lathe("cup", cup, brass, 32, location=(x, y, z + radius))
    turn = np.linspace(-math.pi / 2, math.pi / 2, 13)
    ball = [(radius * math.cos(a), radius * math.sin(a)) for a in turn.tolist()]
    s = Shader("globe")
    facing = s.node("LayerWeight", {"Blend": 0.4}).outputs["Facing"]
    glass = s.emission(s.ramp(facing, [(0.0, "#ffedc9"), (1.0, "#f2bf80")]))
    globe = lathe("globe", ball, glass, 48, location=(x, y, z))
    globe.visible_shadow = False
    bulb("warm", (x, y, z), 0.09, 74.0, "#ffb56b")


def _pot() -> None:
    """An earthen jar in the corner of the hall."""
    earth = mottled("earth", 3.0, "#a8603f", "#b97353", Roughness=0.7)
    jar = [(0, 0), (0.12, 0), (0.13, 0.01), (0.19, 0.12), (0.235, 0.27), (0.23, 0.40), (0.17, 0.52), (0.12, 0.565)]
    jar += [(0.115, 0.60), (0.15, 0.63), (0.14, 0.638), (0.10, 0.60), (0.10, 0.56), (0.15, 0.50), (0, 0.30)]
    lathe("jar", jar, earth, location=(1.12, 0.28, 0))


STAIRWELL = SceneSpec(
    name="stairwell",
    build=build,
    train=lambda count, seed: forward_facing(count, (0.30, -3.2, 1.55), (-0.02, 0.60, 1.40), (0.7, 0.6), seed=seed),
    test=None,
    camera_angle_x=math.radians(52.0),
    near=2.7,
    far=7.0,
    views=49,
    transparent=False,
)
