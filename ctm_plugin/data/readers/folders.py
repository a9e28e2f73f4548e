"""Access to a data set's files: only inside its folder, every fault a :class:`DataError`."""

from __future__ import annotations

import os
import shlex
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path, PurePosixPath, PureWindowsPath

from ctm_plugin.errors import CTMError, DataError

PHONE_SUFFIXES = (".heic", ".heif", ".hif", ".avif")
"""Suffixes of pictures from phones."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr", *PHONE_SUFFIXES)
UNREAD_SUFFIXES = (".bmp", ".gif", ".ppm", ".pgm", ".jp2", ".tga")
"""Suffixes of pictures that are not read."""
LFS_POINTER = b"version https://git-lfs"
"""First bytes of a file that Git LFS has not fetched."""
RAW_SUFFIXES = (
    ".dng", ".nef", ".nrw", ".cr2", ".cr3", ".crw", ".arw", ".srf", ".sr2", ".raf", ".orf", ".rw2", ".rwl", ".pef",
    ".srw", ".raw", ".iiq", ".3fr", ".fff", ".x3f", ".erf", ".kdc",
)  # fmt: skip
"""Suffixes of raw pictures."""
RAW_HINT = (
    "pictures developed all alike to TIFF of 16 bits, as ctm photos FOLDER does; "
    "dataset=rawnerf reads RawNeRF's raw ones"
)


def others_hint(paths: Iterable[Path]) -> str:
    """Word the hint how to convert the first of these files that is a picture in an unsupported format."""
    known = (*UNREAD_SUFFIXES, *IMAGE_SUFFIXES)
    path = next((path for path in paths if path.suffix.lower() in known), Path("images", "1.BMP"))
    into = "png" if path.suffix.lower() in UNREAD_SUFFIXES else path.suffix[1:]
    return f"others turned into these first (mogrify -format {into} {shlex.quote(str(path.parent))}/*{path.suffix})"


def reason(error: BaseException) -> str:
    """An exception's message in one line, without paths."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    if type(error).__name__.startswith("LibRaw"):  # bytes, as Python shows them
        text = text.removeprefix("b'").removesuffix("'")
    return " ".join(text.split())


@contextmanager
def as_data_error(path: Path, found: str, expected: str) -> Iterator[None]:
    """Context that turns any error into a :class:`DataError` with the file, what was ``found`` and ``expected``.

    Systems and decoders raise all that their parsers do on damaged files: OSError, SyntaxError, struct.error, ... Where
    the file is empty or was not fetched by Git LFS, the error says so.
    """
    try:
        yield
    except CTMError:
        raise
    except Exception as error:
        with suppress(OSError), path.open("rb") as file:
            check_head(path, file.read(len(LFS_POINTER)), expected)
        raise DataError(path, f"{found} ({reason(error)})", expected) from error


def require_folder(root: str | Path, expected: str) -> Path:
    """Find a data set's folder, or refuse it if missing; ``expected`` says in the error what it should hold."""
    with as_data_error(Path(root), "a folder that cannot be read", expected):
        root = Path(root).expanduser()
        if not root.exists():
            raise DataError(root, "nothing there", expected)
        if not root.is_dir():
            raise DataError(root, "a file", expected)
        if next(root.iterdir(), None) is None:
            raise DataError(root, "an empty folder", expected)
    return root


def require_file(path: Path, expected: str) -> None:
    """Refuse a path that is no regular file: a pipe would block, a device never end. The file is not opened."""
    with as_data_error(path, "a file that cannot be read", expected):
        if not path.exists():
            raise DataError(path, "no such file", expected)
        if not path.is_file():
            raise DataError(path, "something that is not a file", expected)


def check_head(path: Path, head: bytes, expected: str) -> None:
    """Refuse a file by its first bytes: an empty one, or one not fetched by Git LFS."""
    if not head:
        raise DataError(path, "an empty file", expected)
    if head.startswith(LFS_POINTER):
        raise DataError(path, "a Git LFS pointer in place of the file", f"{expected}: git lfs pull fetches it")


def state_of(path: Path) -> tuple[int, int] | None:
    """Time of a file's last change, and its size: what was read of it is kept until they differ; ``None``: no file."""
    with suppress(OSError, ValueError):
        state = path.stat()
        return state.st_mtime_ns, state.st_size
    return None


def read_bytes(path: Path, expected: str) -> bytes:
    """Read a file's content."""
    require_file(path, expected)
    with as_data_error(path, "a file that cannot be read", expected):
        content = path.read_bytes()
    check_head(path, content, expected)
    return content


def is_picture(path: Path) -> bool:
    """Tell whether a file is a picture by its suffix; hidden files, such as macOS's ``._IMG_1.jpg``, are not."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def plain_name(name: str, root: Path | None = None) -> str:
    """Normalise a path in a file: no ``./``, Windows' separators as ``/``, relative where it lies in ``root``."""
    plain = str(PurePosixPath(name.replace("\\", "/")))
    return plain if root is None else plain.removeprefix(f"{os.path.abspath(root)}/")


def inside(root: Path, name: str, source: Path | None = None) -> Path:
    """Find ``root / name``, which stays inside ``root``: ``..`` is resolved in the name itself, links are followed.

    Links that the folder's owner made may lead out of it; a name in the file ``source`` that does is a DataError.
    """
    source = source or root / name
    expected = "a path inside the data set's folder, relative to it"
    plain = plain_name(name, root)
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

    Without an exact match, a name that other systems take for the same is accepted: ``a.JPG`` for ``a.jpg``, or
    an umlaut that is composed in another way.
    """
    for suffix in ("", *IMAGE_SUFFIXES):
        path = inside(root, name + suffix, source)
        with as_data_error(path, "a file that cannot be read", "an image"):
            if path.is_file():
                return path
    *folders, last = inside(root, name, source).relative_to(root).parts or ("",)
    with as_data_error(root / name, "a file that cannot be read", "an image"):
        home = root
        for folder in folders:
            home = home / folder if (home / folder).is_dir() else folded(home).get(fold(folder), home / folder)
        candidates = (folded(home).get(fold(last + suffix)) for suffix in ("", *IMAGE_SUFFIXES))
        return next((path for path in candidates if path and path.is_file()), None)


def fold(name: str) -> str:
    """Normalise a file name so that names that macOS or Windows take for the same become equal."""
    return unicodedata.normalize("NFC", name).casefold()


def folded(folder: Path) -> dict[str, Path]:
    """Map each :func:`fold`-ed name in a folder to its path; empty if the folder does not exist."""
    return _listed(folder, folder.stat().st_mtime_ns) if folder.is_dir() else {}


@lru_cache(maxsize=16)
def _listed(folder: Path, _changed: int) -> dict[str, Path]:
    return {fold(path.name): path for path in sorted(folder.iterdir(), reverse=True)}


def view_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """A unique name for each image: its file name without the suffix, numbered where two are alike."""
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return tuple(stems)
    return tuple(f"{index:04d}_{stem}" for index, stem in enumerate(stems))
