"""RawNeRF's scenes: LLFF's layout with ``raw/*.dng`` and their EXIF data, shot by hand in the dark."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ctm_plugin.data.capture import Capture
from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.data.photographs import find_pictures
from ctm_plugin.data.readers.folders import fold, folded, inside
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.data.readers.layouts import open_layout
from ctm_plugin.data.readers.raw import raw_decoder
from ctm_plugin.data.readers.records import Record, read_json
from ctm_plugin.data.settings import RawNeRFSettings
from ctm_plugin.errors import DataError
from ctm_plugin.scene.views import Scene


class RawNeRFConfig(RawNeRFSettings, LLFFConfig):
    layout = "rawnerf"

    def capture(self) -> Capture:
        """Read one of RawNeRF's scenes.

        DNGs are developed with the camera's white balance, to sRGB, without automatic brightness, in more than 8 bits.
        Where shutter time or ISO differ, shorter exposures are brightened to the level of the longest. The JSON file
        with each DNG's EXIF data gives both; without these files pictures stay as shot.

        The developed pictures in ``images_<downscale>`` or ``images`` are taken where there are any; else the DNGs in
        ``raw`` are developed, every time anew and in memory: a second or two for each of 12 megapixels.

        The scene's exposure is not known.
        """
        root = open_layout(Path(self.root) / (self.scene or ""), self.layout, self.links)
        developed = self.factor or any((root / name).is_dir() for name in ("images", f"images_{self.whole_factor}"))
        if developed or not (root / "raw").is_dir():
            pictures = find_pictures(root, self.whole_factor, self.factor)
            return self.posed(root, [read_picture(path) for path in pictures.listing(root)], pictures.shrunk)
        names = sorted(path.name for path in (root / "raw").iterdir() if path.suffix.lower() == ".dng")
        if not names:
            raise DataError(root / "raw", "no raw pictures", "files ending in .dng")
        paths = [inside(root, f"raw/{name}") for name in names]
        beside = folded(root / "raw")
        exif = [beside.get(fold(f"{path.stem}.json"), path.with_suffix(".json")) for path in paths]
        decode = raw_decoder(relative_brightness(paths, exif))
        return self.posed(root, [read_picture(path, decode) for path in paths], shrunk=False)

    def load(self) -> Scene:
        return replace(super().load(), exposure=None)


def relative_brightness(paths: list[Path], records: list[Path]) -> dict[Path, float]:
    """Factors that give pictures of different exposures the colours of the longest one: ``max(e) / e``.

    ``e`` is the shutter time x ISO.

    A field has one colour for each point, whatever the shutter did. The longest is the measure, as in RawNeRF: what it
    clips is clipped in all. Without EXIF files pictures stay as they were shot.

    Args:
        paths: the DNGs.
        records: their EXIF data as JSON, which may be missing.

    Raises:
        DataError: some EXIF files are missing, or one does not tell the shutter time.
    """
    missing = [record for record in records if not record.exists()]
    if len(missing) == len(records):
        return dict.fromkeys(paths, 1.0)
    if missing:
        raise DataError(missing[0], "no such file", "EXIF data for each DNG, or for none")
    exposures = [exposure(record) for record in records]
    return {path: max(exposures) / exposure for path, exposure in zip(paths, exposures, strict=True)}


def exposure(path: Path) -> float:
    """Shutter time in seconds x ISO / 100 out of ``exiftool -json``'s output: a list of one object, or the object.

    Raises:
        DataError: it holds something else.
    """
    content = read_json(path)
    if isinstance(content, list) and len(content) == 1:
        content = content[0]
    if not isinstance(content, dict):
        raise DataError(path, f"a JSON {type(content).__name__}", "exiftool's output for one picture")
    exif = Record(content, path)
    expected = "the shutter time in seconds, a number or a text such as 1/30"
    seconds, _, parts = str(content.get("ShutterSpeed")).partition("/")
    try:
        time = float(seconds) / float(parts or 1)
    except (ValueError, ZeroDivisionError) as error:
        raise exif.fault("ShutterSpeed", expected) from error
    if not 1e-6 <= time <= 1e4:
        raise exif.fault("ShutterSpeed", expected)
    iso = exif.number("ISO", lambda v: 1 <= v <= 1e7, "the sensitivity, a number >= 1") if "ISO" in exif else 100.0
    return time * iso / 100.0
