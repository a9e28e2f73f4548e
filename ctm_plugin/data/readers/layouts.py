"""Layouts of a data set's folder, recognised by its files. Errors name the layout that fits."""

from __future__ import annotations

import shlex
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path

from ctm_plugin.data.readers.clip import CLIP_SUFFIXES
from ctm_plugin.data.readers.folders import as_data_error, is_picture, require_folder
from ctm_plugin.data.readers.frames import angle_alone
from ctm_plugin.errors import DataError

TRANSFORMS, TRAIN, TEST, VAL = (f"transforms{split}.json" for split in ("", "_train", "_test", "_val"))
LLFF_FILE = "poses_bounds.npy"
"""Name of LLFF's file of cameras."""
MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap_sparse/0", "colmap_text")
"""Folders where COLMAP's model may lie, before other folders of ``sparse`` are tried. The third is nerfstudio's, the
last instant-ngp's."""
LAYOUT_EXPECTED = {
    "blender": f"a folder with {TRAIN} and {TEST}",
    "transforms": f"a folder with {TRANSFORMS}, or {TRAIN} and {TEST}",
    "colmap": "a folder with sparse/0 and images",
    "llff": f"a folder with {LLFF_FILE} and images",
    "rawnerf": f"a folder with {LLFF_FILE} and images or raw",
}


def open_layout(root: str | Path, layout: str) -> Path:
    """Find the folder of a data set, or refuse one without files of ``layout``."""
    with suppress(OSError, ValueError, RuntimeError):  # what cannot be a path is refused below
        path = Path(root).expanduser()
        if path.is_file() and layouts(path.parent):
            raise DataError(path, "a file", f"its folder, dataset.root={shlex.quote(str(path.parent))}")
    expected = LAYOUT_EXPECTED.get(layout, "the folder of a data set")
    root = require_folder(root, expected)
    fitting = layouts(root)
    if layout in LAYOUT_EXPECTED and fitting and layout not in fitting:
        raise DataError(root, "files of another layout", f"{expected}; dataset={fitting[0]} reads what is there")
    if layout in LAYOUT_EXPECTED and not fitting and (hint := way_out(root)):
        raise DataError(root, "no cameras", f"{expected}; {hint}")
    return root


def way_out(root: Path) -> str:
    """Word the hint for a folder without files of any layout: a folder near it that has some, or how to make them."""
    quoted = shlex.quote(str(root))
    with as_data_error(root, "a folder that cannot be read", "the folder of a data set"):
        for path in sorted(root.glob("*.[jJ][sS][oO][nN]")):
            if meant := get_close_matches(path.name.lower(), (TRANSFORMS, TRAIN, TEST, VAL), 1, 0.8):
                return f"did you mean {meant[0]}, which dataset=transforms reads? {path.name} lies there"
        inner = sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
        home = root.absolute()
        for path in (*inner, *home.parents[:3]):
            with suppress(OSError):  # what lies around is not ours
                names = layouts(path)
                if names == ["colmap"] and path in inner and not any(map(is_picture, path.glob("*/*"))):
                    return f"{path} has them without pictures: move its folder sparse to {quoted}"
                if names:
                    return f"{path} has them: dataset={names[0]} dataset.root={shlex.quote(str(path))}"
        if any((root / f"cameras{suffix}").exists() for suffix in (".bin", ".txt")):
            return "COLMAP's files are to lie in a folder sparse there, the pictures in images"
        return of_photographs(root)


def of_photographs(root: Path) -> str:
    """Word the hint how to find the cameras of a folder's photographs; empty where there are no photographs."""
    quoted = shlex.quote(str(root))
    if any(map(is_picture, root.iterdir())):
        return f"ctm cameras {quoted} finds those of the photographs, for dataset=colmap"
    inner = sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
    homes = [path.name for path in inner if any(map(is_picture, path.iterdir()))]
    if homes:
        name = "images" if "images" in homes else homes[0]
        folder = "" if name == "images" else f" pictures={shlex.quote(name)}"
        return f"ctm cameras {quoted}{folder} finds those of the photographs in {name}, for dataset=colmap"
    if clips := sorted(path.name for path in root.iterdir() if path.suffix.lower() in CLIP_SUFFIXES):
        return f"ctm cameras {quoted} finds those of the frames of {clips[0]}, for dataset=colmap"
    return ""


def layouts(root: Path) -> list[str]:
    """List the layouts that a folder has files of, the one that fits best first."""
    names = []
    if (root / TRANSFORMS).exists():
        names.append("transforms")
    if (root / TRAIN).exists() and (root / TEST).exists():
        names += ["blender", "transforms"] if angle_alone(root / TRAIN) else ["transforms", "blender"]
    if any((root / name).exists() for name in (TRAIN, TEST, VAL)):
        names.append("transforms")
    if model_folder(root):
        names.append("colmap")
    if (root / LLFF_FILE).exists():
        if not (root / "raw").is_dir() or (root / "images").is_dir():
            names.append("llff")
        names += ["rawnerf", "llff"] if any(root.glob("images*")) else ["rawnerf"]
    return list(dict.fromkeys(names))


def model_folder(root: Path) -> Path | None:
    """Find the folder of COLMAP's model, binary or text; ``None``: there is none."""
    return next(iter(model_folders(root)), None)


def model_folders(root: Path) -> list[Path]:
    """List the folders of COLMAP's models, first the one that is read."""
    folders = dict.fromkeys([*(root / name for name in MODEL_FOLDERS), *sorted(root.glob("*sparse/[0-9]*"))])
    return [each for each in folders if any((each / f"cameras.{kind}").exists() for kind in ("bin", "txt"))]
