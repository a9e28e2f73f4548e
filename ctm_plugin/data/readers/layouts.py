"""Which layouts a folder's files are of: each loader opens its folder here, and a wrong one is told which fits."""

from __future__ import annotations

import shlex
from contextlib import suppress
from pathlib import Path

from ctm_plugin.data.readers.folders import is_picture, refuse_links, require_folder, told
from ctm_plugin.data.readers.frames import says_more
from ctm_plugin.data.readers.records import Record, read_record
from ctm_plugin.errors import DataError

TRANSFORMS, TRAIN, TEST, VAL = (f"transforms{split}.json" for split in ("", "_train", "_test", "_val"))
POSES = "poses_bounds.npy"
MODELS = ("sparse/0", "sparse", "colmap/sparse/0")
"""Where COLMAP's model may lie, in a folder; nerfstudio puts it into the last one. Else it is in another of sparse."""
EXPECTED = {
    "blender": f"a folder with {TRAIN} and {TEST}",
    "transforms": f"a folder with {TRANSFORMS}, or {TRAIN} and {TEST}",
    "colmap": "a folder with sparse/0 and images",
    "llff": f"a folder with {POSES} and images",
    "rawnerf": f"a folder with {POSES} and images or raw",
}

TURNED = "--data {root} --output-dir capture, of nerfstudio's, writes a transforms.json of it"
FOREIGN = {
    "keyframes/cameras": f"Polycam's raw data: ns-process-data polycam {TURNED}",
    "metadata.json": f"Record3D's: ns-process-data record3d {TURNED}",
    "EXR_RGBD/metadata.json": f"Record3D's: ns-process-data record3d {TURNED}",
    "cameras_sphere.npz": "DTU's or NeuS's cameras, which are not read: ctm cameras {root} pictures=image finds those "
    "of the photographs, for dataset=colmap dataset.images=image",
}
"""What other programs leave and nothing here reads, by a file of theirs, and the way from there."""


def open_layout(root: str | Path, layout: str, links: bool) -> Path:
    """Open the folder of a data set of this layout.

    Args:
        root: where it should be.
        layout: its name, as in ``dataset=``.
        links: whether it may hold links to what lies outside it.

    Raises:
        DataError: it is no folder, holds such links, or holds files of other layouts alone, which the message names.
    """
    with suppress(OSError, ValueError, RuntimeError):  # what cannot be a path is told below
        path = Path(root).expanduser()
        if path.is_file() and layouts(path.parent):
            raise DataError(path, "a file", f"its folder, dataset.root={shlex.quote(str(path.parent))}")
    root = require_folder(root, EXPECTED[layout])
    if not links:
        refuse_links(root)
    fitting = layouts(root)
    if fitting and layout not in fitting:
        raise DataError(
            root, "files of another layout", f"{EXPECTED[layout]}; dataset={fitting[0]} reads what is there"
        )
    if not fitting and (hint := way_out(root)):
        raise DataError(root, "no cameras", f"{EXPECTED[layout]}; {hint}")
    return root


def way_out(root: Path) -> str:
    """Say what to do with a folder without files of any layout: which folder near it has some, or where to get them."""
    quoted = shlex.quote(str(root))
    with told(root, "a folder that cannot be read", "the folder of a data set"):
        for name, hint in FOREIGN.items():
            if (root / name).exists():
                return hint.format(root=quoted)
        inner = sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
        home = root.absolute()
        for path in (*inner, *home.parents[:3]):
            with suppress(OSError):  # what lies around is not ours
                if found := layouts(path):
                    return f"{path} has them: dataset={found[0]} dataset.root={shlex.quote(str(path))}"
        if any((root / f"cameras{suffix}").exists() for suffix in (".bin", ".txt")):
            return "COLMAP's files are to lie in a folder sparse there, the pictures in images"
        if any(map(is_picture, root.iterdir())):
            return f"photographs alone are to lie in {root / 'images'}: ctm cameras {quoted} finds their cameras"
        homes = [path.name for path in inner if any(map(is_picture, path.iterdir()))]
        if homes:
            name = "images" if "images" in homes else homes[0]
            folder = "" if name == "images" else f" pictures={shlex.quote(name)}"
            return f"ctm cameras {quoted}{folder} finds those of the photographs in {name}, for dataset=colmap"
    return ""


def layouts(root: Path) -> list[str]:
    """List the layouts that a folder has files of, the one that fits best first."""
    found = []
    if (root / TRANSFORMS).exists():
        found.append("transforms")
    if (root / TRAIN).exists() or (root / TEST).exists():
        found += ["transforms", "blender"] if not angle_alone(root / TRAIN) else ["blender", "transforms"]
    if model_folder(root):
        found.append("colmap")
    if (root / POSES).exists():
        raw = (root / "raw").is_dir() and not (root / "images").is_dir()
        found += ["rawnerf", "llff"] if raw else ["llff", "rawnerf"]
    return list(dict.fromkeys(found))


def angle_alone(path: Path) -> bool:
    """Tell whether a ``transforms_train.json`` gives its cameras by ``camera_angle_x`` alone, as Synthetic-NeRF's."""
    try:
        return beyond_angle(read_record(path)) is None
    except DataError:
        return True


def beyond_angle(record: Record) -> tuple[Record, str] | None:
    """Find the first thing that a file or a frame of it says of its lenses beside ``camera_angle_x``, and who does."""
    owners = [record, *(record.records("frames", "a list of frames") if record.values.get("frames") else ())]
    return next(((owner, key) for owner in owners if (key := says_more(owner))), None)


def model_folder(root: Path) -> Path | None:
    """Find where COLMAP's model lies, binary or text; ``None``: nowhere."""
    return next(iter(model_folders(root)), None)


def model_folders(root: Path) -> list[Path]:
    """List where COLMAP's models lie, the one that is taken first."""
    folders = dict.fromkeys([*(root / name for name in MODELS), *sorted((root / "sparse").glob("[0-9]*"))])
    return [each for each in folders if any((each / f"cameras.{kind}").exists() for kind in ("bin", "txt"))]
