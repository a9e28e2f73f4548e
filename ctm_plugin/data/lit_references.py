"""Lit references of dark captures: pair test pictures with them; warn if pictures are unpaired."""

from __future__ import annotations

import shlex
import warnings
from pathlib import Path, PurePosixPath

import numpy as np

from ctm_plugin.color.srgb import srgb_to_linear
from ctm_plugin.data.capture import Capture
from ctm_plugin.data.photographs import find_listed
from ctm_plugin.data.readers.folders import inside
from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.views import Views, unit

MAX_LIGHT_RATIO = 4.0
"""Largest ratio of mean linear light, test to training pictures, that counts as the same light."""


def check_folder(root: Path, key: str, name: str | None) -> None:
    """Refuse the name of a folder that the data set does not have."""
    if name is not None and not inside(root, name, root).is_dir():
        there = ", ".join(sorted(path.name for path in root.iterdir() if path.is_dir())) or "there are none"
        raise ConfigError(key, name, f"the name of a folder in {root}: {there}")


def as_captured(name: str, dark: str | None, lit: str | None) -> tuple[str | None, str | None]:
    """Name a view's picture as captured, and its lit reference, from the name in the data set's file.

    A picture has the same name in both folders. The first is ``None`` where only the lit reference is listed and
    there is no ``dark``, the second without ``lit``.
    """
    path = PurePosixPath(name)
    home = next((each for each in (lit, dark) if each and path.is_relative_to(each)), path.parent)
    rest = path.relative_to(home)
    captured = f"{dark}/{rest}" if dark else None if home == lit else name
    return captured, f"{lit}/{rest}" if lit else None


def warn_of_lit(capture: Capture, train: Views, test: Views) -> None:
    """Warn if test pictures are far brighter than training pictures, and lie in another folder."""
    names = np.array([each.name for each in capture.photographs])
    homes = [{PurePosixPath(name).parent for name in names[split]} for split in (~capture.testing, capture.testing)]
    pictures = test.images if test.pictured is None else test.images[test.pictured]
    if homes[0] & homes[1] or not len(pictures):
        return
    tested, trained = (
        np.mean([float(srgb_to_linear(unit(image[..., :3])).mean()) for image in images])
        for images in (pictures, train.images)
    )
    ratio = tested / max(trained, 1e-9)
    if ratio <= MAX_LIGHT_RATIO:
        return
    keys = ""
    if all(len(home) == 1 for home in homes):
        dark, lit = (home.pop() for home in homes)
        first = PurePosixPath(names[capture.testing][0]).relative_to(lit)
        same = find_listed(capture.root, str(dark / first), capture.root)
        keys = f", which is {shlex.quote(f'dataset.lit={lit}')}"
        keys += f" {shlex.quote(f'dataset.dark={dark}')}" if same else ""
    warnings.warn(
        f"{capture.root}: test pictures are {ratio:.3g} times as bright as those that are trained on, and scored as if "
        f"they were not. They may be lit references{keys}",
        stacklevel=3,
    )
