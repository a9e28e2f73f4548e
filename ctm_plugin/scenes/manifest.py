"""What a finished rendering says about itself: a README with its settings, and a hash of every file."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from ctm_plugin.files import write_text

README, HASHES = "README.md", "SHA256SUMS"


def write_manifest(out: Path) -> None:
    """Write ``SHA256SUMS`` (``sha256sum -c`` checks it) and ``README.md`` into a rendering's folder."""
    files = sorted(
        path
        for path in out.rglob("*")
        if path.is_file() and path.name not in (README, HASHES) and not path.name.startswith(".")
    )
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(out).as_posix()}\n" for path in files]
    sums = "".join(lines)
    write_text(out / HASHES, sums)
    settings = json.loads((out / "settings.json").read_text())
    rows = "".join(f"| {key} | {value} |\n" for key, value in settings.items())
    write_text(
        out / README,
        f"# {settings['scene']}\n\n"
        "Rendered with Blender's Cycles by `python -m ctm_plugin scenes`. Pictures: 8-bit sRGB of linear "
        "radiance cut at 1, without tone mapping. Depth: distance along the ray in scene units.\n\n"
        f"| setting | |\n|---|---|\n{rows}\n"
        f"{len(files)} files; sha256 of `{HASHES}`: `{hashlib.sha256(sums.encode()).hexdigest()}`\n",
    )
