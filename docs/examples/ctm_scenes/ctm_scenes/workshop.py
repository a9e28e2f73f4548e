"""The scene ``workshop``: a model railway on a round base, full of thin things, all inside 1.2 units.

Rails, hanging wires, pickets, wire mesh, a railed bridge and a lattice mast stand before sky, ground and large painted
walls: at 128x128 pixels most of them are thinner than a pixel. Everything is built here from polygons, modifiers and
procedural textures. Lengths are in scene units, z is up, and the ground lies at ``GROUND``.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ctm_scenes.building import Shader, area_lamp, box, lathe, mesh, mottled, world_light
from ctm_scenes.still_life import STILL_LIFE

GROUND = -0.50
BASE_RADIUS = 1.0

# The track is an arc: its circle's centre lies far in front of the base.
TRACK_RADIUS = 2.0
TRACK_CENTRE = -2.2
GAUGE = 0.17
BED_TOP = 0.035
RAIL_TOP = BED_TOP + 0.045

Part = tuple[list, list]
"""Vertices and faces of a mesh under construction."""


def build() -> None:
    """Fill Blender's current scene."""
    _base()
    _track()
    _wagon()
    _bridge()
    _telegraph()
    _mast()
    _pickets()
    _wire_mesh()
    _cabin()
    _shed()
    world_light(lower="#8d8378", upper="#dfe8f2", strength=0.74)
    area_lamp("key", (-3.2, -2.6, 4.6), size=2.2, watts=570.0, tint="#ffe9cc")
    area_lamp("fill", (4.2, -1.4, 2.6), size=3.0, watts=150.0, tint="#d5e4ff")
    area_lamp("back", (0.8, 4.4, 3.2), size=2.4, watts=265.0, tint="#fff3e0")


def _sweep(into: Part, path: Sequence[Sequence[float] | np.ndarray] | np.ndarray, profile: np.ndarray) -> None:
    """Append a closed body: ``profile`` drawn along a path.

    Args:
        into: (vertices, faces).
        path: ``[N, 3]``.
        profile: ``[K, 2]`` offsets to the right and up, seen along the path, counter-clockwise.
    """
    path = np.asarray(path, dtype=np.float64)
    vertices, faces = into
    first, count = len(vertices), len(profile)
    for i, point in enumerate(path):
        along = path[min(i + 1, len(path) - 1)] - path[max(i - 1, 0)]
        along = along / np.linalg.norm(along)
        # Upright things have no "up" of their own: theirs is -x, so that y is their right.
        right = np.cross(along, [0.0, 0.0, 1.0] if abs(along[2]) < 0.999 else [-1.0, 0.0, 0.0])
        right = right / np.linalg.norm(right)
        vertices.extend(point + profile @ np.stack([right, np.cross(right, along)]))
    for i in range(len(path) - 1):
        for k in range(count):
            a, b = first + i * count + k, first + i * count + (k + 1) % count
            faces.append([a, a + count, b + count, b])
    last = first + (len(path) - 1) * count
    faces.append(list(range(first, first + count)))
    faces.append(list(range(last + count - 1, last - 1, -1)))


def _round(thickness: float, sides: int = 8) -> np.ndarray:
    angle = 2.0 * np.pi * np.arange(sides) / sides
    return 0.5 * thickness * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _flat(width: float, height: float) -> np.ndarray:
    return 0.5 * np.array([[-width, -height], [width, -height], [width, height], [-width, height]])


def _hang(start: np.ndarray, end: np.ndarray, sag: float) -> np.ndarray:
    """``[13, 3]`` points of a wire that hangs ``sag`` below the straight line in its middle."""
    t = np.linspace(0.0, 1.0, 13)[:, None]
    return start + t * (end - start) - 4.0 * sag * t * (1.0 - t) * np.array([0.0, 0.0, 1.0])


def _add(name: str, part: Part, material: Any, smooth: bool = False) -> None:
    mesh(name, np.array(part[0]), part[1], material, smooth=smooth)


def _moved(point: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    return point + np.array([x, y, z])


def _on_track(along: float, across: float, height: float) -> np.ndarray:
    """``[3]`` point of the track's own coordinates: along the rails, to the back, above the ground."""
    angle = along / TRACK_RADIUS
    reach = TRACK_RADIUS + across
    return np.array([reach * math.sin(angle), TRACK_CENTRE + reach * math.cos(angle), GROUND + height])


def _on_rim(degrees: float, radius: float, height: float) -> np.ndarray:
    angle = math.radians(degrees)
    return np.array([radius * math.cos(angle), radius * math.sin(angle), GROUND + height])


def _wood(name: str, dark: str, light: str, along: str = "X") -> Any:
    """Planed wood, its fibres along one axis."""
    s = Shader(name)
    thin, wide = (3.0, 34.0), (0.5, 3.0)
    scale, slow = (tuple(long if axis == along else fine for axis in "XYZ") for long, fine in (thin, wide))
    fibre = s.noise(s.coordinates(scale=scale), 1.5)
    rings = s.math("PINGPONG", s.math("MULTIPLY", s.noise(s.coordinates(scale=slow), 1.2, 2.0, 0.3), 14.0), 1.0)
    tone = s.ramp(rings, [(0.0, dark), (1.0, light)])
    shade = s.ramp(fibre, [(0.3, "#b8b0a6"), (0.7, "#ffffff")])
    return s.surface(s.mix(0.8, tone, shade, "MULTIPLY"), fibre, 0.003, Roughness=0.5)


def _paint(name: str, base: str, worn: str, **surface: float) -> Any:
    """Brushed paint: broad soft patches of a worn tone."""
    s = Shader(name)
    patch = s.noise(s.coordinates(), 4.0, 4.0)
    stroke = s.noise(s.coordinates(scale=(40.0, 40.0, 4.0)), 1.5)
    tone = s.mix(0.18, s.ramp(patch, [(0.35, base), (0.75, worn)]), s.ramp(stroke, [(0.3, base), (0.7, worn)]))
    return s.surface(tone, stroke, 0.001, **{"Roughness": 0.55, **surface})


def _metal(name: str, dark: str, light: str, roughness: float = 0.45, metallic: float = 0.6) -> Any:
    return mottled(name, 9.0, dark, light, 4.0, Metallic=metallic, Roughness=roughness)


def _base() -> None:
    """A turned wooden disc with flock on top: sand and moss."""
    rim = BASE_RADIUS
    profile = [(0, -0.125), (rim - 0.05, -0.125), (rim - 0.03, -0.122), (rim - 0.03, -0.108), (rim - 0.04, -0.1)]
    profile += [(rim - 0.01, -0.095), (rim, -0.085), (rim, -0.025), (rim - 0.008, -0.012), (rim - 0.03, -0.01)]
    profile += [(rim - 0.05, -0.012), (0, -0.012)]
    lathe("base", profile, _wood("base", "#785840", "#a1815f"), location=(0, 0, GROUND))

    s = Shader("flock")
    place = s.coordinates()
    moss = s.ramp(s.noise(place, 2.2, 4.0, 0.4), [(0.40, "#a3936b"), (0.52, "#8f8a5a"), (0.66, "#6f7a4c")])
    grain = s.noise(place, 60.0, 2.0)
    tone = s.mix(0.7, moss, s.ramp(grain, [(0.3, "#a8a294"), (0.7, "#ffffff")]), "MULTIPLY")
    flock = s.surface(tone, grain, 0.012, Roughness=0.95)
    edge = rim - 0.045
    profile = [(0, 0), (edge - 0.04, 0), (edge - 0.02, -0.002), (edge, -0.014), (edge, -0.03)]
    lathe("flock", profile[::-1], flock, location=(0, 0, GROUND))


def _track() -> None:
    """Gravel bed with loose stones, sleepers, and rails with head, web and foot."""
    s = Shader("gravel")
    cells = s.node("TexVoronoi", {"Vector": s.coordinates(), "Scale": 55.0})
    stone = s.ramp(
        s.node("SeparateXYZ", {0: cells.outputs["Color"]}).outputs["X"], [(0.0, "#77706a"), (1.0, "#b5ada2")]
    )
    gravel = s.surface(stone, s.math("SUBTRACT", 1.0, cells.outputs["Distance"]), 0.012, Roughness=0.9)
    line = np.linspace(-0.875, 0.875, 49)
    centre = [_on_track(a, 0.0, 0.0) for a in line]
    bed: Part = ([], [])
    _sweep(bed, centre, np.array([[-0.22, -0.005], [0.22, -0.005], [0.17, BED_TOP], [-0.17, BED_TOP]]))
    chance = random.Random(5)
    for _ in range(420):
        across = chance.uniform(-0.24, 0.24)
        height = np.interp(abs(across), [0.17, 0.22], [BED_TOP, 0.0])
        _stone(bed, _on_track(chance.uniform(-0.87, 0.87), across, height), chance)
    _add("bed", bed, gravel)

    sleepers: Part = ([], [])
    for along in np.linspace(-0.85, 0.85, 21):
        ends = [_on_track(along, side * 0.155, BED_TOP + 0.004) for side in (-1.0, 1.0)]
        _sweep(sleepers, ends, _flat(0.042, 0.026))
    _add("sleepers", sleepers, _wood("sleeper", "#58432f", "#7d6248", "Y"))

    rails: Part = ([], [])
    foot = BED_TOP + 0.016
    half = [(0.014, foot), (0.014, foot + 0.004), (0.004, foot + 0.008), (0.004, RAIL_TOP - 0.010)]
    half += [(0.009, RAIL_TOP - 0.007), (0.009, RAIL_TOP)]
    rail = np.array([*half, *((-x, z) for x, z in half[::-1])])
    for side in (-1.0, 1.0):
        _sweep(rails, [_on_track(a, side * GAUGE / 2, 0.0) for a in np.linspace(-0.89, 0.89, 49)], rail)
    _add("rails", rails, _metal("rail", "#8a7a6c", "#b4b0aa", 0.35, 0.7))

    # The buffer stop: two posts, held by struts, and a beam across.
    stop: Part = ([], [])
    for side in (-1.0, 1.0):
        across, top = side * GAUGE / 2, RAIL_TOP + 0.10
        _sweep(stop, [_on_track(-0.84, across, BED_TOP), _on_track(-0.84, across, top + 0.02)], _flat(0.02, 0.02))
        _sweep(stop, [_on_track(-0.84, across, top), _on_track(-0.74, across, RAIL_TOP)], _flat(0.014, 0.014))
    _sweep(stop, [_on_track(-0.828, side * 0.13, RAIL_TOP + 0.085) for side in (-1.0, 1.0)], _flat(0.02, 0.038))
    _add("stop", stop, _paint("stop", "#8f4a3c", "#a9695a"))


def _stone(into: Part, spot: np.ndarray, chance: random.Random) -> None:
    """Append a pebble: an octahedron pulled about."""
    vertices, faces = into
    first, size = len(vertices), chance.uniform(0.007, 0.014)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            corner = [chance.uniform(-0.35, 0.35) for _ in range(3)]
            corner[axis] = sign * chance.uniform(0.7, 1.1)
            vertices.append(spot + size * np.array(corner))
    # Vertices 2 i and 2 i + 1 lie on the negative and positive side of axis i.
    for x, y, z in ((0, 2, 4), (0, 2, 5), (0, 3, 4), (0, 3, 5), (1, 2, 4), (1, 2, 5), (1, 3, 4), (1, 3, 5)):
        flip = (x + y + z) % 2 == 0
        faces.append([first + x, first + (z if flip else y), first + (y if flip else z)])


def _wagon() -> None:
    """A flat wagon with low painted sides, stakes, and a load of logs."""
    middle, length, width = 0.33, 0.50, 0.23
    turn = -math.degrees(middle / TRACK_RADIUS)
    heading = math.radians(turn)
    forward = np.array([math.cos(heading), math.sin(heading), 0.0])
    aside = np.array([-math.sin(heading), math.cos(heading), 0.0])
    floor = RAIL_TOP + 0.115

    def at(along: float, across: float, height: float) -> np.ndarray:
        return _on_track(middle, 0.0, height) + along * forward + across * aside

    oxide, iron = _paint("oxide", "#8f4a3c", "#a9695a"), _metal("iron", "#3d3b3a", "#5a5754")
    place = {"rotation": (0, 0, turn)}
    box("floor", (length, width, 0.03), oxide, 0.004, location=at(0, 0, floor), **place)
    for side in (-1.0, 1.0):
        edge = side * (width / 2 - 0.008)
        box(f"side{side}", (length, 0.016, 0.075), oxide, 0.003, location=at(0, edge, floor + 0.05), **place)
        edge = side * (length / 2 - 0.008)
        box(f"end{side}", (0.016, width - 0.03, 0.075), oxide, 0.003, location=at(edge, 0, floor + 0.05), **place)
    frame: Part = ([], [])
    wheel = [(0, -0.02), (0.045, -0.02), (0.05, -0.015), (0.05, 0.008), (0.062, 0.010), (0.062, 0.018), (0, 0.018)]
    for axle in (-0.15, 0.15):
        _sweep(frame, [at(axle, -0.10, RAIL_TOP + 0.05), at(axle, 0.10, RAIL_TOP + 0.05)], _round(0.018))
        for side in (-1.0, 1.0):
            spot = at(axle, side * (GAUGE / 2 + 0.003), RAIL_TOP + 0.05)
            # The flange is the profile's upper end, which the turn about x sends between the rails.
            lathe(f"wheel{axle}{side}", wheel, iron, 24, location=spot, rotation=(90 * side, 0, turn))
    for side in (-1.0, 1.0):
        for along in (-0.20, -0.07, 0.07, 0.20):
            edge = side * (width / 2 + 0.007)
            _sweep(frame, [at(along, edge, floor - 0.02), at(along, edge, floor + 0.22)], _flat(0.015, 0.015))
        for across in (-0.07, 0.07):
            _sweep(
                frame, [at(side * 0.25, across, floor - 0.01), at(side * 0.285, across, floor - 0.01)], _round(0.028)
            )
    _add("frame", frame, iron)
    logs: Part = ([], [])
    rows = [(-0.068, 0.052), (0.0, 0.050), (0.068, 0.052), (-0.035, 0.112), (0.036, 0.110), (0.0, 0.168)]
    for i, (across, height) in enumerate(rows):
        reach, shift = 0.215 + 0.008 * (i % 3), 0.012 * (i % 2)
        _sweep(logs, [at(shift + e * reach, across, floor + height) for e in (-1, 1)], _round(0.066, 12))
    _add("logs", logs, _wood("log", "#9a7650", "#c4a276"))


def _bridge() -> None:
    """A railed walkway over the track: a plank deck on braced legs, with stairs at both ends."""
    iron, planks, deck = ([], []), ([], []), 0.43
    middle, reach, half = -0.38, 0.30, 0.065

    def at(along: float, across: float, height: float) -> np.ndarray:
        return _on_track(middle + along, across, height)

    def bar(*path: np.ndarray, size: float = 0.015) -> None:
        _sweep(iron, path, _flat(size, size))

    for across in np.linspace(-reach, reach, 17):
        _sweep(planks, [at(-half - 0.01, across, deck), at(half + 0.01, across, deck)], _flat(0.030, 0.014))
    for side in (-1.0, 1.0):
        edge = side * half
        bar(at(edge, -reach, deck - 0.02), at(edge, reach, deck - 0.02), size=0.024)
        # The stairs leave to the right in front and to the left behind: there the railing is open.
        low, high = (-reach + 0.13 if side > 0 else -reach), (reach - 0.13 if side < 0 else reach)
        for height in (0.08, 0.16):
            bar(at(edge, low, deck + height), at(edge, high, deck + height), size=0.014)
        for across in np.linspace(low, high, 5):
            bar(at(edge, across, deck - 0.02), at(edge, across, deck + 0.16))
        for height in (0.08, 0.16):
            bar(at(-half, side * reach, deck + height), at(half, side * reach, deck + height), size=0.014)
        # A trestle on each side of the track, braced crosswise.
        across = side * 0.27
        for leg in (-half, half):
            bar(at(leg, across, 0.0), at(leg, across, deck - 0.02), size=0.020)
            bar(at(leg, across, 0.02), at(-leg, across, deck - 0.03), size=0.012)
        # Stairs run along the track: side -1 is the front, and there they go to the right.
        run, steps = -side, 9
        for across in (side * (reach - 0.12), side * reach):
            top, bottom = at(run * half, across, deck), at(run * (half + 0.34), across, 0.0)
            bar(top, bottom, size=0.018)
            rise = np.array([0.0, 0.0, 0.16])
            bar(top + rise, bottom + rise, size=0.014)
            for share in (0.0, 0.5, 1.0):
                bar(top + share * (bottom - top), top + share * (bottom - top) + rise, size=0.014)
        for step in range(1, steps):
            along, height = run * (half + 0.34 * step / steps), deck * (1.0 - step / steps)
            ends = [at(along, side * (reach - 0.12), height), at(along, side * reach, height)]
            _sweep(planks, ends, _flat(0.045, 0.010))
    _add("bridge", iron, _paint("bridge", "#4d6a72", "#6f8a8f"))
    _add("planks", planks, _wood("plank", "#876a4c", "#b2926d", "X"))


def _telegraph() -> None:
    """Three poles with two cross-arms, insulators, and wires that hang between them and end at the cabin."""
    poles: Part = ([], [])
    knobs: Part = ([], [])
    wires: Part = ([], [])
    spots = [(-0.84, 0.26, 80.0), (-0.03, 0.20, 92.0), (0.84, 0.25, 100.0)]
    ends: list[list[np.ndarray]] = []
    for x, y, turn in spots:
        foot = np.array([x, y, GROUND])
        arm = np.array([math.cos(math.radians(turn)), math.sin(math.radians(turn)), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        _sweep(poles, [foot, foot + 0.99 * up], _round(0.038, 12))
        hooks = []
        for height, half in ((0.92, 0.13), (0.79, 0.13)):
            _sweep(poles, [foot + height * up - half * arm, foot + height * up + half * arm], _flat(0.024, 0.024))
            for side in (-0.9, 0.9):
                spot = foot + (height + 0.012) * up + side * half * arm
                _sweep(knobs, [spot, spot + 0.032 * up], _round(0.022))
                hooks.append(spot + 0.028 * up)
        ends.append(hooks)
    for first, second in itertools.pairwise(ends):
        for k, (start, end) in enumerate(zip(first, second, strict=True)):
            _sweep(wires, _hang(start, end, 0.055 + 0.012 * k), _round(0.015))
    # One more goes to an insulator on the cabin's roof.
    roof = np.array([0.27, 0.345, GROUND + 0.48])
    _sweep(knobs, [roof, _moved(roof, 0.0, 0.0, 0.045)], _round(0.022))
    _sweep(wires, _hang(ends[1][2], _moved(roof, 0.0, 0.0, 0.038), 0.03), _round(0.013))
    # Stays hold the outer poles against the pull.
    for (x, y, _), foot in zip((spots[0], spots[2]), ((-0.81, 0.45), (0.90, -0.06)), strict=True):
        _sweep(wires, [np.array([x, y, GROUND + 0.86]), np.array([*foot, GROUND])], _round(0.012))
    _add("poles", poles, _wood("pole", "#665240", "#8c7359", "Z"))
    _add("insulators", knobs, _paint("porcelain", "#d9dcd6", "#c7cfcd", Roughness=0.25))
    _add("wires", wires, _metal("wire", "#35322f", "#4a4440", 0.5, 0.3), smooth=True)


def _mast() -> None:
    """A tapering lattice mast with a signal arm, a sign and two stays."""
    lattice: Part = ([], [])
    centre, height, levels = np.array([0.55, -0.63, GROUND]), 1.24, 8

    def corner(k: int, level: float) -> np.ndarray:
        half = 0.095 - 0.055 * level / levels
        across = [(-half, -half), (half, -half), (half, half), (-half, half)][k % 4]
        return centre + np.array([*across, height * level / levels])

    for k in range(4):
        _sweep(lattice, [corner(k, 0), corner(k, levels)], _flat(0.017, 0.017))
        for level in range(levels):
            _sweep(lattice, [corner(k, level + 1), corner(k + 1, level + 1)], _flat(0.012, 0.012))
            low, high = (k, k + 1) if (level + k) % 2 else (k + 1, k)
            _sweep(lattice, [corner(low, level), corner(high, level + 1)], _flat(0.012, 0.012))
    _add("mast", lattice, _paint("mast", "#bfbaad", "#d2cdc1"))
    wires: Part = ([], [])
    top = centre + np.array([0.0, 0.0, 0.97 * height])
    for foot in ((0.91, -0.22), (0.12, -0.80)):
        _sweep(wires, [top, np.array([*foot, GROUND])], _round(0.012))
    _add("stays", wires, _metal("stay", "#5b5753", "#77726c", 0.5, 0.3), smooth=True)

    red, white = _paint("signal_red", "#a8443a", "#b85a4c"), _paint("signal_white", "#e4dfd3", "#d3ccbd")
    face = centre + np.array([0.0, -0.060, 0.0])
    box("arm", (0.30, 0.014, 0.062), red, 0.003, location=_moved(face, -0.15, 0.0, 1.14), rotation=(0, 14, 0))
    box("stripe", (0.035, 0.018, 0.064), white, location=_moved(face, -0.235, 0.0, 1.161), rotation=(0, 14, 0))
    box("sign", (0.25, 0.014, 0.19), white, 0.003, location=_moved(face, 0.0, -0.016, 0.66))
    box("sign_band", (0.252, 0.018, 0.052), red, location=_moved(face, 0.0, -0.016, 0.66))


def _pickets() -> None:
    """A picket fence along the front rim."""
    wood: Part = ([], [])
    low, high, radius = 212.0, 318.0, 0.90
    tip = np.array([[-0.012, 0.0], [0.012, 0.0], [0.012, 0.155], [0.0, 0.175], [-0.012, 0.155]])
    for degrees in np.linspace(low, high, 36):
        _sweep(wood, [_on_rim(degrees, radius + r, 0.01) for r in (0.0, 0.010)], tip)
    for height in (0.05, 0.125):
        path = [_on_rim(d, radius - 0.006, height) for d in np.linspace(low, high, 37)]
        _sweep(wood, path, _flat(0.012, 0.020))
    _add("pickets", wood, _paint("picket", "#e0d9c9", "#cdc3af"))


def _wire_mesh() -> None:
    """A fence of diamond wire mesh along the back rim, between round posts."""
    posts: Part = ([], [])
    wires: Part = ([], [])
    low, high, radius, height = 40.0, 140.0, 0.915, 0.26
    for degrees in np.linspace(low, high, 8):
        _sweep(posts, [_on_rim(degrees, radius, 0.0), _on_rim(degrees, radius, height + 0.02)], _round(0.020))
    for level in (0.012, height):
        path = [_on_rim(d, radius, level) for d in np.linspace(low, high, 49)]
        _sweep(wires, path, _round(0.014))
    # At 45 degrees a wire climbs the fence while it goes its height along the rim.
    climb = math.degrees(height / radius)
    for start in np.arange(low - climb, high, 6.2):
        shares = np.clip((np.array([low, high]) - start) / climb, 0.0, 1.0)
        for lean in (1.0, -1.0):
            # The two families are mirror images about the fence's middle and cross without touching.
            degrees = [
                start + climb * t if lean > 0 else low + high - start - climb * t for t in np.linspace(*shares, 5)
            ]
            rise = height * np.linspace(*shares, 5)
            path = [_on_rim(d, radius + 0.005 * lean, z) for d, z in zip(degrees, rise, strict=True)]
            if shares[1] - shares[0] > 0.05:
                _sweep(wires, path, _round(0.012, 6))
    _add("mesh_posts", posts, _paint("mesh_post", "#6c7468", "#87907f"), smooth=True)
    _add("mesh_wires", wires, _metal("zinc", "#8d9293", "#b0b4b4", 0.4, 0.5), smooth=True)


def _cabin() -> None:
    """A plain block with large cream walls, a flat roof, a door, a barred window and a stove pipe."""
    turn, size, spot = 6.0, np.array([0.46, 0.30, 0.46]), np.array([0.36, 0.51, GROUND])
    heading = math.radians(turn)
    frame = np.array([[math.cos(heading), math.sin(heading), 0], [-math.sin(heading), math.cos(heading), 0], [0, 0, 1]])

    def at(x: float, y: float, z: float) -> np.ndarray:
        return spot + np.array([x, y, z]) @ frame

    place = {"rotation": (0, 0, turn)}
    cream, green = _paint("cream", "#d0bf97", "#decfad"), _paint("green", "#55705a", "#6f8a70")
    dark = _paint("glass", "#39454b", "#4c5a60", Roughness=0.15)
    box("cabin", size.tolist(), cream, 0.006, location=at(0, 0, size[2] / 2), **place)
    box(
        "plinth", (0.475, 0.315, 0.07), _paint("plinth", "#7d746a", "#958b80"), 0.004, location=at(0, 0, 0.035), **place
    )
    box("roof", (0.53, 0.37, 0.03), _paint("roof", "#6a5f5c", "#857873"), 0.006, location=at(0, 0, 0.475), **place)
    front = -size[1] / 2
    box("door", (0.11, 0.012, 0.25), green, 0.003, location=at(-0.13, front, 0.195), **place)
    # The window looks to the right, so that the wall behind stays plain.
    side = size[0] / 2
    box("window", (0.008, 0.17, 0.15), dark, location=at(side, 0.0, 0.29), **place)
    bars: Part = ([], [])
    for y in np.linspace(-0.085, 0.085, 4):
        _sweep(bars, [at(side + 0.006, y, 0.21), at(side + 0.006, y, 0.37)], _flat(0.012, 0.012))
    for z in (0.215, 0.29, 0.365):
        _sweep(bars, [at(side + 0.006, -0.09, z), at(side + 0.006, 0.09, z)], _flat(0.012, 0.012))
    _add("bars", bars, _paint("bars", "#e0d9c9", "#d0c7b4"))
    pipe: Part = ([], [])
    _sweep(pipe, [at(0.15, 0.07, 0.46), at(0.15, 0.07, 0.66)], _round(0.030, 12))
    _sweep(pipe, [at(0.15, 0.07, 0.675), at(0.15, 0.07, 0.683)], _round(0.055, 12))
    _sweep(pipe, [at(0.15, 0.07, 0.65), at(0.15, 0.07, 0.68)], _round(0.010))
    _add("pipe", pipe, _metal("pipe", "#4a4644", "#6a6562"))


def _shed() -> None:
    """A lower block with large blue walls and a lamp on a bent post beside it."""
    spot, turn = np.array([-0.40, 0.54, GROUND]), -10.0
    place = {"rotation": (0, 0, turn)}
    blue, ochre = _paint("blue", "#5c7f8c", "#7b9ca4"), _paint("ochre", "#9c7f55", "#ae946c")
    box("shed", (0.42, 0.28, 0.28), blue, 0.006, location=_moved(spot, 0, 0, 0.14), **place)
    box("shed_roof", (0.46, 0.32, 0.022), ochre, 0.005, location=_moved(spot, 0, 0, 0.29), **place)
    post: Part = ([], [])
    foot = np.array([-0.08, 0.62, GROUND])
    bend = [
        _moved(foot, -0.06 + 0.06 * math.cos(a), 0.0, 0.55 + 0.06 * math.sin(a)) for a in np.linspace(0, math.pi, 9)
    ]
    _sweep(post, [foot, *bend], _round(0.016))
    iron = _metal("lamp_iron", "#3d3b3a", "#5a5754")
    _add("lamp_post", post, iron, smooth=True)
    shade = [(0.045, -0.035), (0.047, -0.033), (0.012, 0.0), (0.0, 0.002)]
    lathe("lamp_shade", shade, iron, 24, location=bend[-1])


# Seen by the still life's cameras.
WORKSHOP = replace(STILL_LIFE, name="workshop", build=build)
