"""Dark captures whose files list lit pictures of their test views: which picture is which, and who has not noticed."""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from ctm_plugin.color.srgb import srgb_to_linear
from ctm_plugin.data.photographs import find_listed
from ctm_plugin.data.readers.folders import inside
from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.views import Pixels, Views, unit

BRIGHTER = 4.0
"""Times the mean linear light of the training pictures, above which test pictures were not taken in the same light."""


def check_folder(root: Path, key: str, name: str | None) -> None:
    """Refuse the name of a folder that the data set does not have.

    Raises:
        ConfigError: there is no such folder.
        DataError: it lies outside.
    """
    if name is not None and not inside(root, name, root).is_dir():
        there = ", ".join(sorted(path.name for path in root.iterdir() if path.is_dir())) or "there are none"
        raise ConfigError(key, name, f"the name of a folder in {root}: {there}")


def as_captured(name: str, dark: str | None, lit: str | None) -> tuple[str | None, str | None]:
    """Name a view's picture as it was captured and of its lit reference.

    Args:
        name: of its picture, as the data set's file has it.
        dark, lit: folders with both; a picture has the same name in each.

    Returns:
        The picture's name, ``None`` where only its lit reference is listed and there is no ``dark``; and the
        reference's, ``None`` without ``lit``.
    """
    path = PurePosixPath(name)
    home = next((each for each in (lit, dark) if each and path.is_relative_to(each)), path.parent)
    rest = path.relative_to(home)
    captured = f"{dark}/{rest}" if dark else None if home == lit else name
    return captured, f"{lit}/{rest}" if lit else None


def warn_of_lit(root: Path, trained: Sequence[str], tested: Sequence[str], train: Views, test: Views) -> None:
    """Say so where test pictures are far brighter than those that are trained on, and lie in another folder.

    Args:
        root: the data set's folder.
        trained, tested: the pictures' names, as the data set's file has them.
        train, test: their views.
    """
    homes = [{PurePosixPath(name).parent for name in names} for names in (trained, tested)]
    pictures = test.images if test.pictured is None else test.images[test.pictured]
    if homes[0] & homes[1] or not len(pictures):
        return
    ratio = mean_light(pictures) / max(mean_light(train.images), 1e-9)
    if ratio <= BRIGHTER:
        return
    keys = ""
    if all(len(home) == 1 for home in homes):
        dark, lit = (home.pop() for home in homes)
        same = find_listed(root, str(dark / PurePosixPath(tested[0]).relative_to(lit)), root)
        keys = f", which is {shlex.quote(f'dataset.lit={lit}')}" + f" {shlex.quote(f'dataset.dark={dark}')}" * bool(
            same
        )
    warnings.warn(
        f"{root}: test pictures are {ratio:.3g} times as bright as those that are trained on, and scored as if they "
        f"were not. They may be lit references{keys}",
        stacklevel=3,
    )


def mean_light(images: Pixels) -> float:
    """Average the linear light of pictures ``[N, H, W, C]``."""
    return float(np.mean([float(srgb_to_linear(unit(image[..., :3])).mean()) for image in images]))
