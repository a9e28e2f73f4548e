"""Files of a data set: found inside its folder only, every fault told as :class:`DataError`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ctm_plugin.errors import DataError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr")


def reason(error: BaseException) -> str:
    """One line that says what an exception says, without paths."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(text.split())


def require_folder(root: str | Path, expected: str) -> Path:
    """The folder of a data set.

    Args:
        root: where it should be.
        expected: what it should hold, for the message.

    Raises:
        DataError: missing, not a folder, unreadable or empty.
    """
    try:
        root = Path(root).expanduser()
        if not root.exists():
            raise DataError(root, "nothing there", expected)
        if not root.is_dir():
            raise DataError(root, "a file", expected)
        if next(root.iterdir(), None) is None:
            raise DataError(root, "an empty folder", expected)
    except (OSError, ValueError, RuntimeError) as error:
        raise DataError(root, f"a folder that cannot be read ({reason(error)})", expected) from error
    return root


def require_file(path: Path, expected: str) -> None:
    """Refuse what is no regular file: a pipe would block, a device never end.

    Raises:
        DataError: missing, something else, or it cannot be looked at.
    """
    try:
        if not path.exists():
            raise DataError(path, "no such file", expected)
        if not path.is_file():
            raise DataError(path, "something that is not a file", expected)
    except (OSError, ValueError, RuntimeError) as error:
        raise DataError(path, f"a file that cannot be read ({reason(error)})", expected) from error


def read_bytes(path: Path, expected: str) -> bytes:
    """A file's content.

    Raises:
        DataError: missing, not a regular file or unreadable.
    """
    require_file(path, expected)
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise DataError(path, f"a file that cannot be read ({reason(error)})", expected) from error


def inside(root: Path, name: str, source: Path) -> Path:
    """``root / name``, which has to lie inside ``root`` once ``..`` and links are resolved.

    Args:
        root: the data set's folder.
        name: the path as ``source`` gives it.
        source: the file that names it.

    Raises:
        DataError: it lies outside, or cannot be a path.
    """
    expected = "a path inside the data set's folder"
    try:
        path = root / name
        contained = path.resolve().is_relative_to(root.resolve())
    except (OSError, ValueError, RuntimeError) as error:
        raise DataError(source, f"path {name!r} ({reason(error)})", expected) from error
    if not contained:
        raise DataError(source, f"path {name!r}, which leads outside {root}", expected)
    return path


def look_for(root: Path, name: str, source: Path) -> Path | None:
    """The image that ``source`` calls ``name``, written with or without its suffix; ``None`` where there is none.

    Raises:
        DataError: it lies outside ``root``, or cannot be looked for.
    """
    for suffix in ("", *IMAGE_SUFFIXES):
        path = inside(root, name + suffix, source)
        try:
            if path.is_file():
                return path
        except OSError as error:
            raise DataError(path, f"a file that cannot be read ({reason(error)})", "an image") from error
    return None


def own(root: Path, name: str) -> Path:
    """The file of a layout that is called ``name`` in ``root``, see :func:`inside`."""
    return inside(root, name, root / name)


def find_image(root: Path, name: str, source: Path) -> Path:
    """The image that ``source`` calls ``name``, see :func:`look_for`.

    Raises:
        DataError: it lies outside ``root``, or there is none.
    """
    if path := look_for(root, name, source):
        return path
    expected = f"an image there, also tried with {', '.join(IMAGE_SUFFIXES)}"
    raise DataError(inside(root, name, source), f"no such file, though {source.name} lists {name!r}", expected)


def view_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """A unique name for each image: its file name without the suffix, numbered where two are alike."""
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return tuple(stems)
    return tuple(f"{index:04d}_{stem}" for index, stem in enumerate(stems))
