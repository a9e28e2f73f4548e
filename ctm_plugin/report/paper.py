"""The paper's tables: their rows, and its own figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files

import yaml

from ctm_plugin.errors import CTMError
from ctm_plugin.report.runs import Setting

IMAGES = ("psnr", "ssim", "lpips")
BASE = {"color_space": "rgb", "loss": "mse", "without": frozenset(), "encoding": None, "appearance": "none"}
OURS = {"P": 4, "k": 3}


@dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes:
        label: as in the paper.
        fits: whether a setting belongs here.
        paper: the paper's values by metric, or by scene in a table of scenes; ``None``: N.C.
        against: label of the row that it is compared with, the table's reference unless said here.
        name: the label as the table has it, where a preset or a backbone is added to ``label``.
    """

    label: str
    fits: Callable[[Setting], bool]
    paper: Mapping[str, float | None] = field(default_factory=dict)
    against: str | None = None
    name: str = ""


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper.

    Attributes:
        number, title: the paper's.
        data: what the paper's values were measured on.
        rows: in the paper's order.
        metrics: its columns.
        reference: label of the row that the others are compared with.
        by_scene: a column a scene, of the one metric.
    """

    number: int
    title: str
    data: str
    rows: tuple[Row, ...]
    metrics: tuple[str, ...]
    reference: str
    by_scene: bool = False


def is_like(learned: bool, **wanted: object) -> Callable[[Setting], bool]:
    """Whether a setting has these values, and the paper's own where nothing is said."""
    expected = BASE | (OURS if learned else {}) | wanted

    def fits(setting: Setting) -> bool:
        return (setting.ctm != "off") == learned and all(getattr(setting, key) == v for key, v in expected.items())

    return fits


def _images(*values: float) -> dict[str, float]:
    return dict(zip(IMAGES, values, strict=True))


RGB_OFF, FULL = _images(31.67, 0.8261, 0.1994), _images(33.38, 0.8752, 0.1585)
NOT_CONVERGED = dict.fromkeys(IMAGES)

METHODS = (
    ("DVGO", "dvgo", False), ("DVGO w/ CTM", "dvgo", True), ("NeRF", "nerf", False), ("NeRF w/ CTM", "nerf", True),
)  # fmt: skip


def _method(label: str, backbone: str, learned: bool, paper: Mapping[str, float | None]) -> Row:
    return Row(label, is_like(learned, backbone=backbone), paper, label.removesuffix(" w/ CTM") if learned else None)


PER_METHOD = {
    "Synthetic-NeRF": (
        _images(31.47, 0.9566, 0.0280), _images(31.12, 0.9549, 0.0289),
        _images(28.60, 0.9261, 0.0601), _images(28.32, 0.9259, 0.0606),
    ),
    "RawNeRF": (RGB_OFF, FULL, NOT_CONVERGED, _images(33.60, 0.8736, 0.1539)),
    "Synthetic-NeRF-Dark": (
        _images(30.35, 0.7935, 0.2645), _images(34.95, 0.9181, 0.1396),
        NOT_CONVERGED, _images(38.86, 0.9616, 0.0494),
    ),
    "Low-Texture-Blender": (
        _images(36.34, 0.9610, 0.0503), _images(36.99, 0.9652, 0.0395),
        _images(37.94, 0.9628, 0.0458), _images(38.13, 0.9630, 0.0457),
    ),
}  # fmt: skip
"""Table 1: DVGO, DVGO with CTM, NeRF, NeRF with CTM."""


def _methods(values: tuple[dict, ...]) -> tuple[Row, ...]:
    return tuple(_method(*method, paper) for method, paper in zip(METHODS, values, strict=True))


SPACES = {
    "rgb": ("RGB", RGB_OFF),
    "hls": ("HLS", _images(31.85, 0.8303, 0.1610)),
    "hls_cart": ("HLS cart", _images(32.63, 0.8515, 0.1645)),
    "hsv": ("HSV", _images(32.31, 0.8427, 0.1615)),
    "hsv_cart": ("HSV cart", _images(32.86, 0.8579, 0.1698)),
    "lab": ("Lab", _images(28.34, 0.7359, 0.2574)),
    "luv": ("Luv", _images(28.50, 0.7346, 0.2564)),
}
"""Table 2: colour spaces by name, their labels and values."""


def _spaces() -> tuple[Row, ...]:
    rows = [Row(label, is_like(False, color_space=name), paper) for name, (label, paper) in SPACES.items()]
    return (*rows, Row("CTM", is_like(True), FULL))


def _alignments() -> tuple[Row, ...]:
    values = {
        "none": ("No PE", (0.3559, 21.87), (0.2156, 22.47)),
        "naive": ("Naive PE", (0.3981, 19.89), (0.3721, None)),
        "barf": ("BARF", (0.2922, 26.22), (0.2357, 29.24)),
    }
    rows = []
    for encoding, (label, off, on) in values.items():
        for learned, (warp, psnr) in ((False, off), (True, on)):
            paper = {"warp_error": warp} | ({} if psnr is None else {"patch_psnr_pooled": psnr})
            fits = is_like(learned, encoding=encoding)
            rows.append(Row(f"{label} w/ CTM", fits, paper, label) if learned else Row(label, fits, paper))
    return tuple(rows)


def _terms() -> tuple[Row, ...]:
    values = {
        "dec": _images(32.96, 0.8689, 0.1634), "img": _images(31.48, 0.7664, 0.1935),
        "rand": _images(33.40, 0.8751, 0.1567), "latent": _images(33.31, 0.8721, 0.1574),
    }  # fmt: skip
    rows = [
        Row(f"w/o {term}", is_like(True, without=frozenset([term])), paper, against="full")
        for term, paper in values.items()
    ]
    return (Row("w/o CTM", is_like(False), RGB_OFF), *rows, Row("full", is_like(True), FULL))


def _sizes() -> tuple[Row, ...]:
    frequencies = {
        0: (33.32, 0.8699, 0.1573), 2: (33.37, 0.8750, 0.1568), 4: (33.38, 0.8752, 0.1585),
        6: (31.53, 0.8307, 0.1875), 8: (30.86, 0.8172, 0.2007), 10: (26.93, 0.7036, 0.2747),
    }  # fmt: skip
    channels = {
        1: (32.75, 0.8676, 0.1610), 2: (33.37, 0.8735, 0.1570), 3: (33.38, 0.8752, 0.1585),
        4: (33.27, 0.8733, 0.1597), 5: (33.07, 0.8678, 0.1632),
    }  # fmt: skip
    return (
        *(Row(f"P = {p}", is_like(True, P=p), _images(*paper)) for p, paper in frequencies.items()),
        *(Row(f"k = {k}", is_like(True, k=k), _images(*paper), against="k = 3") for k, paper in channels.items()),
    )


def _distances() -> tuple[Row, ...]:
    return (
        Row("MSE w/o CTM", is_like(False), RGB_OFF),
        Row("L1 w/o CTM", is_like(False, loss="l1"), _images(32.21, 0.8548, 0.1701)),
        Row("MSE w/ CTM", is_like(True), FULL),
        Row("L1 w/ CTM", is_like(True, loss="l1"), _images(33.10, 0.8720, 0.1540), against="L1 w/o CTM"),
    )


SEEDS = (_images(31.80, 0.9554, 0.0364), _images(31.59, 0.9547, 0.0365))

TABLES = {
    1: PaperTable(1, "novel views", "RawNeRF", _methods(PER_METHOD["RawNeRF"]), IMAGES, "DVGO"),
    2: PaperTable(2, "colour spaces", "RawNeRF, DVGO", _spaces(), IMAGES, "RGB"),
    3: PaperTable(
        3, "planar alignment", "cat, squirrel, ducks; 10 seeds", _alignments(), ("warp_error", "patch_psnr_pooled"),
        "BARF",
    ),
    4: PaperTable(4, "CTM's loss terms", "RawNeRF, DVGO", _terms(), IMAGES, "w/o CTM"),
    5: PaperTable(5, "frequencies P and latent channels k", "RawNeRF, DVGO", _sizes(), IMAGES, "P = 4"),
    6: PaperTable(6, "distances between colours", "RawNeRF, DVGO", _distances(), IMAGES, "MSE w/o CTM"),
    7: PaperTable(
        7, "four seeds", "Synthetic-NeRF, DVGO",
        (Row("DVGO", is_like(False), SEEDS[0]), Row("DVGO w/ CTM", is_like(True), SEEDS[1])), IMAGES, "DVGO",
    ),
}  # fmt: skip


@cache
def per_scene() -> dict[int, PaperTable]:
    """Tables 8 to 19."""
    found = {}
    for number, given in yaml.safe_load((files(__package__) / "per_scene.yaml").read_text(encoding="utf-8")).items():
        rows = tuple(_method(*method, given["rows"][method[0]] or {"*": None}) for method in METHODS)
        title = f"{given['metric'].upper()} by scene"
        found[number] = PaperTable(number, title, given["data"], rows, (given["metric"],), "DVGO", by_scene=True)
    return found


def datasets(number: int) -> list[str]:
    """The data sets that the values of a table are of; Table 1 has one at a time."""
    return list(PER_METHOD) if number == 1 else [(TABLES | per_scene())[number].data.partition(",")[0]]


def paper_table(number: int, data: str | None = None) -> PaperTable:
    """A table by its number; Table 1 with the paper's values of one of its four data sets.

    Raises:
        CTMError: there is no such table, or it has no values of that data set.
    """
    tables = TABLES | per_scene()
    if number not in tables:
        raise CTMError(f"table: found {number}, expected one of {', '.join(map(str, sorted(tables)))}")
    if data is not None and data not in datasets(number):
        raise CTMError(f"data: found {data!r}, expected, with table={number}, one of {', '.join(datasets(number))}")
    return replace(tables[1], data=data, rows=_methods(PER_METHOD[data])) if number == 1 and data else tables[number]
