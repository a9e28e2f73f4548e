"""RawNeRF's scenes: LLFF's layout with raw pictures in ``raw`` and their EXIF data, shot by hand in the dark."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from ctm_plugin.data.capture import Capture
from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.data.readers.folders import RAW_SUFFIXES, fold, folded, inside
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.data.readers.layouts import open_layout
from ctm_plugin.data.readers.picture import exposure_of
from ctm_plugin.data.readers.raw import open_raw, raw_exif
from ctm_plugin.data.readers.records import read_record
from ctm_plugin.data.settings import RawNeRFSettings
from ctm_plugin.errors import DataError
from ctm_plugin.scene.views import Scene


class RawNeRFConfig(RawNeRFSettings, LLFFConfig):
    layout = "rawnerf"

    def capture(self) -> Capture:
        """Read one of RawNeRF's scenes.

        Raw pictures are developed with the camera's white balance, to sRGB, without automatic brightness, in more than
        8 bits.
        Where exposures differ, shorter ones are brightened to the level of the longest. JSON files with EXIF data next
        to the pictures say shutter time and ISO, as RawNeRF's do; without these files the pictures' own EXIF does, with
        the f-number. Where one does not tell, all stay as shot.

        The developed pictures in ``images_<downscale>`` or ``images`` are taken where there are any; else those in
        ``raw`` are developed, every time anew and in memory: a second or two for each of 12 megapixels.

        The scene's exposure is not known.
        """
        root = open_layout(Path(self.root) / (self.scene or ""), self.layout)
        developed = self.factor or any((root / name).is_dir() for name in ("images", f"images_{self.whole_factor}"))
        if developed or not (root / "raw").is_dir():
            return self.posed(root, *self.developed(root))
        names = sorted(path.name for path in (root / "raw").iterdir() if path.suffix.lower() in RAW_SUFFIXES)
        if not names:
            raise DataError(root / "raw", "no raw pictures", f"files ending in {', '.join(RAW_SUFFIXES)}")
        paths = [inside(root, f"raw/{name}") for name in names]
        beside = folded(root / "raw")
        exif = [beside.get(fold(f"{path.stem}.json"), path.with_suffix(".json")) for path in paths]
        factors = relative_brightness(exif, paths)
        pictures = [read_picture(path, partial(open_raw, brightness=f)) for path, f in zip(paths, factors, strict=True)]
        return self.posed(root, pictures, shrunk=False)

    def load(self, capture: Capture | None = None) -> Scene:
        return replace(super().load(capture), exposure=None)


def relative_brightness(records: list[Path], raws: list[Path]) -> list[float]:
    """Factors that give pictures of different exposures the colours of the longest one: ``max(e) / e``.

    ``e`` is the shutter time x ISO, by each picture's EXIF data as JSON, or without these files what each picture says
    itself. A field has one colour for each point, whatever the shutter did. The longest is the reference, as in
    RawNeRF: what it clips is clipped in all. Where a picture has no exposure, all factors are 1.
    DataError: some have JSON, not all.
    """
    missing = [record for record in records if not record.exists()]
    if missing and len(missing) < len(records):
        raise DataError(missing[0], "no such file", "EXIF data for each raw picture, or for none")
    exposures = [exposure_of(raw_exif(raw)) for raw in raws] if missing else [exposure(record) for record in records]
    return [1.0] * len(raws) if None in exposures else [max(exposures) / each for each in exposures]


def exposure(path: Path) -> float:
    """Shutter time in seconds x ISO / 100 out of ``exiftool -json``'s output: a list of one object, or the object.

    Without ISO it is taken for 100. Raises a DataError for other values and without a shutter time.
    """
    exif = read_record(path)
    expected = "the shutter time in seconds, a number or a text such as 1/30"
    seconds, _, parts = str(exif.values.get("ShutterSpeed")).partition("/")
    try:
        time = float(seconds) / float(parts or 1)
    except (ValueError, ZeroDivisionError) as error:
        raise exif.fault("ShutterSpeed", expected) from error
    if not 1e-6 <= time <= 1e4:
        raise exif.fault("ShutterSpeed", expected)
    iso = exif.number("ISO", lambda v: 1 <= v <= 1e7, "the sensitivity, a number >= 1") if "ISO" in exif else 100.0
    return time * iso / 100.0
