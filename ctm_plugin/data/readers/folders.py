"""Files of a data set: named inside its folder only, every fault told as :class:`DataError`."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath, PureWindowsPath

from ctm_plugin.errors import CTMError, DataError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr")
RAW_HINT = "DNG is read in RawNeRF's layout alone, by dataset=rawnerf"


def reason(error: BaseException) -> str:
    """One line that says what an exception says, without paths."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    if type(error).__name__.startswith("LibRaw"):  # bytes, as Python shows them
        text = text.removeprefix("b'").removesuffix("'")
    return " ".join(text.split())


@contextmanager
def told(path: Path, found: str, expected: str) -> Iterator[None]:
    """Tell of whatever goes wrong inside by file, what was ``found`` and what was ``expected``.

    Systems and decoders raise all that their parsers do on damaged files: OSError, SyntaxError, struct.error, ...

    Raises:
        DataError: anything was raised that is no error of ours.
    """
    try:
        yield
    except CTMError:
        raise
    except Exception as error:
        raise DataError(path, f"{found} ({reason(error)})", expected) from error


def require_folder(root: str | Path, expected: str) -> Path:
    """The folder of a data set.

    Args:
        root: where it should be.
        expected: what it should hold, for the message.

    Raises:
        DataError: missing, not a folder, unreadable or empty.
    """
    with told(Path(root), "a folder that cannot be read", expected):
        root = Path(root).expanduser()
        if not root.exists():
            raise DataError(root, "nothing there", expected)
        if not root.is_dir():
            raise DataError(root, "a file", expected)
        if next(root.iterdir(), None) is None:
            raise DataError(root, "an empty folder", expected)
    return root


def require_file(path: Path, expected: str) -> None:
    """Refuse what is no regular file: a pipe would block, a device never end.

    Raises:
        DataError: missing, something else, or it cannot be looked at.
    """
    with told(path, "a file that cannot be read", expected):
        if not path.exists():
            raise DataError(path, "no such file", expected)
        if not path.is_file():
            raise DataError(path, "something that is not a file", expected)


def read_bytes(path: Path, expected: str) -> bytes:
    """A file's content.

    Raises:
        DataError: missing, not a regular file or unreadable.
    """
    require_file(path, expected)
    with told(path, "a file that cannot be read", expected):
        return path.read_bytes()


def refuse_links(root: Path) -> None:
    """Refuse a folder that holds links to what lies outside it (``dataset.links=false``).

    Raises:
        DataError: it does, or cannot be looked through.
    """
    expected = "no links out of the data set's folder, or dataset.links=true"
    with told(root, "a folder that cannot be read", expected):
        home = root.resolve()
        for folder, folders, names in os.walk(root):
            for path in (Path(folder, name) for name in (*folders, *names)):
                if path.is_symlink() and not path.resolve().is_relative_to(home):
                    raise DataError(path, f"a link to {path.resolve()}", expected)


def plain_name(name: str) -> str:
    """Write a path as a file gives it without ``./``, Windows' separators as ``/``."""
    return str(PurePosixPath(name.replace("\\", "/")))


def inside(root: Path, name: str, source: Path | None = None) -> Path:
    """Find ``root / name``, which stays inside ``root``: ``..`` is resolved in the name itself, links are followed.

    What the folder's owner linked into it is his; what somebody wrote into a file may not lead out of it.

    Args:
        root: the data set's folder.
        name: the path as ``source`` gives it; Windows' separators are read as ``/``.
        source: the file that names it; ``None``: the layout does.

    Raises:
        DataError: it leads outside, or cannot be a path.
    """
    source = source or root / name
    expected = "a path inside the data set's folder"
    plain = plain_name(name)
    parts = os.path.normpath(plain).split(os.sep)
    if plain.startswith("/") or PureWindowsPath(plain).drive or parts[0] == os.pardir:
        raise DataError(source, f"path {name!r}, which leads outside {root}", expected)
    path = root.joinpath(*parts)
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):  # whoever opens it will say so
        pass
    except (OSError, ValueError) as error:
        raise DataError(source, f"path {name!r} ({reason(error)})", expected) from error
    return path


def look_for(root: Path, name: str, source: Path) -> Path | None:
    """The image that ``source`` calls ``name``, written with or without its suffix; ``None`` where there is none.

    Raises:
        DataError: it lies outside ``root``, or cannot be looked for.
    """
    for suffix in ("", *IMAGE_SUFFIXES):
        path = inside(root, name + suffix, source)
        with told(path, "a file that cannot be read", "an image"):
            if path.is_file():
                return path
    return None


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
