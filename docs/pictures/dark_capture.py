"""The row of pictures in README.md: ``python docs/pictures/dark_capture.py RUN_DIR CAPTURE VIEW OTHER``.

RUN_DIR is a run of ``ctm +experiment=lom``, CAPTURE its capture with ``low/`` and ``high/``, VIEW and OTHER two of its
test views, such as ``1`` and ``17``.
"""

import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

WIDTH, HEIGHT, GAP, LABEL = 300, 225, 3, 20
OUT = Path(__file__).with_name("dark_capture.jpg")


def main(run: Path, capture: Path, view: str, other: str) -> None:
    def captured(kind: str) -> Path:
        return next((capture / kind).glob(f"{view}.*"))

    pictures = {
        "photograph": captured("low"),
        "the same, brightened": run / "photo" / f"{view}.png",
        "lit view": run / "lit" / f"{view}.png",
        "another viewpoint, lit": run / "lit" / f"{other}.png",
        "in normal light (not trained on)": captured("high"),
    }
    row = Image.new("RGB", (len(pictures) * (WIDTH + GAP) - GAP, HEIGHT + LABEL), "white")
    font = ImageFont.load_default(13)
    for index, (label, path) in enumerate(pictures.items()):
        left = index * (WIDTH + GAP)
        row.paste(Image.open(path).convert("RGB").resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS), (left, LABEL))
        ImageDraw.Draw(row).text((left + 4, 2), label, fill="black", font=font)
    row.save(OUT, quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], sys.argv[4])
