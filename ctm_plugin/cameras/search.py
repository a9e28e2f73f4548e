"""The search for cameras: details, pairs, places; more is tried, a line each, where too few pictures find theirs."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float32
from torch import Tensor

from ctm_plugin.cameras.colmap import CLOSER, FEWER_MATCHES, STANDARD, Features, Workshop, choose_pairs, extract
from ctm_plugin.cameras.settings import MIN_PICTURES, CamerasConfig
from ctm_plugin.cameras.trust import Trusted, trusted
from ctm_plugin.color.light import brighten, factor_to_mean
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.data.readers.images import PictureFile
from ctm_plugin.errors import DataError
from ctm_plugin.show.bars import bar, say

T = TypeVar("T")
WANT_SHARPER = "sharper pictures with more light, which overlap more"
WANT_APART = "pictures from different places: these all look alike"
WANT_LESS_NOISE = (
    "most pairs match, but in few details: less noise (longer exposure, lower ISO), or pictures between these"
)
"""Ends of messages: what would help."""
LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of red, green and blue in the luminance of linear sRGB (IEC 61966-2-1)."""
THINNING = 8
"""Rows and columns from one pixel to the next that a picture's brightness is the mean of."""
ENOUGH_PLACED = 0.7
"""Share of the pictures with a camera below which another search is tried."""
MIN_OBSERVATIONS, PLENTY_OBSERVATIONS = 40, 200
"""Mean number of points a picture observes that two others observe too: below the first a model is refused, from the
second on the search ends. Measured on a noisy capture: cameras are off by 3 to 30 % below 40, 1.5 % at 75 to 140, 0.7 %
at 280."""


def find_cameras(
    pictures: Sequence[PictureFile], names: Sequence[str], settings: CamerasConfig
) -> tuple[Trusted, float]:
    """COLMAP's model of pictures of these names, and the factor on their light that it was found with.

    Details are searched first as usual, then, where they hold too little, pooled over sizes (J. Dong and S. Soatto,
    Domain-size pooling in local descriptors, CVPR 2015), in twice the time. Of several models the one that most sights
    hold is taken.

    Raises:
        DataError: too few pictures find a place, or too little holds them.
    """
    paths, headers, gain, best = [each.path for each in pictures], [each.header for each in pictures], 1.0, Trusted()
    pairs = choose_pairs(len(paths), settings.all_pairs)
    with (
        tempfile.TemporaryDirectory(prefix="ctm_cameras_") as scratch,
        ThreadPoolExecutor(None if settings.threads < 0 else settings.threads) as pool,
    ):
        if settings.brighten:
            thin = pool.map(lambda each: read_grey(each, settings.size)[0][::THINNING, ::THINNING], pictures)
            gain = find_gain(list(with_progress("brightness", thin, paths)))
        for pooled in (False, True):
            work = Workshop(Path(scratch, "pooled" if pooled else "usual"), settings.threads, settings.seed)
            work.folder.mkdir()
            searched = pool.map(partial(details, size=settings.size, gain=gain, pooled=pooled), pictures)
            features = list(with_progress("details", searched, paths))
            work.store(headers, settings.lens, features)
            with bar("pairs", len(pairs)) as done:
                matched = work.match(pairs, done)
            for start in (FEWER_MATCHES if pooled else STANDARD, CLOSER)[: 2 if matched else 0]:
                with bar("placed", len(paths)) as done:
                    model = trusted(work.reconstruct(names, start, done), work.database)
                best = max(best, model, key=lambda each: (each.sights, each.placed))
                if sound := best.placed >= ENOUGH_PLACED * len(paths) and not best.taken_out:
                    break
                if start is not CLOSER:
                    say(f"{told(best, len(paths))}: placed again from another start, with fewer matches")
            if pooled or (matched and sound and best.mean >= PLENTY_OBSERVATIONS):
                break
            say(f"{told(best, len(paths))}: searched again for details pooled over sizes, in twice the time")
    if best.placed < MIN_PICTURES or best.mean < MIN_OBSERVATIONS:
        mean = sum(len(each.places) for each in features) / len(paths)
        found = (
            f"{told(best, len(paths))} ({mean:.0f} details in a mean picture; {matched} of {len(pairs)} pairs match)"
        )
        hint = WANT_LESS_NOISE if matched > len(pairs) / 2 else WANT_SHARPER
        hint = WANT_APART if matched == len(pairs) and not best.placed else hint
        more = "" if settings.brighten else "brighten=true; "
        raise DataError(
            paths[0].parent, found, f"for {MIN_PICTURES} at least, {MIN_OBSERVATIONS} such points each: {more}{hint}"
        )
    return best, gain


def told(trusted: Trusted, count: int) -> str:
    """How many of ``count`` pictures have a place, and what holds it."""
    text = f"a place for {trusted.placed} of {count} pictures"
    text += f", of which a mean one sees {trusted.mean:.0f} points that two others see" if trusted.placed else ""
    return f"{text}; {trusted.taken_out} more contradict their matches" if trusted.taken_out else text


def details(picture: PictureFile, size: int, gain: float, pooled: bool) -> Features:
    """Details of a picture's copy with sides up to ``size``, brightened by ``gain``."""
    grey, factor = read_grey(picture, size)
    return extract(brighten(grey, gain).numpy(), factor, pooled)


def read_grey(picture: PictureFile, size: int) -> tuple[Float32[Tensor, "h w"], int]:
    """A picture's luminance ``[H // factor, W // factor]``, averaged as light, as sRGB in [0, 1]; a rest is cut.

    The factor, returned too, is the least whole one that leaves no side above ``size``.
    """
    factor = -(-max(picture.header.height, picture.header.width) // size)
    light = srgb_to_linear(picture.image()[..., :3]) @ torch.tensor(LUMINANCE)
    return linear_to_srgb(F.avg_pool2d(light[None, None], factor)[0, 0].clamp(0, 1)), factor


def find_gain(greys: Sequence[Float32[Tensor, "h w"]]) -> float:
    """Find the factor >= 1 on light that brings pictures ``[h, w]``, sRGB in [0, 1], together to a usual one's mean."""
    levels = torch.cat([grey.flatten() for grey in greys])
    return factor_to_mean(levels, torch.ones_like(levels))


def with_progress(what: str, results: Iterable[T], paths: Sequence[Path]) -> Iterator[T]:
    """Results of pictures, with a bar on how many there are."""
    with bar(what, len(paths)) as done:
        for number, (result, path) in enumerate(zip(results, paths, strict=True), 1):
            done(number, path.name)
            yield result
