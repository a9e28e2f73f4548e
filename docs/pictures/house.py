"""The house in one picture, out of the code: rooms on their floors, an arrow for each room that another one imports.

``python docs/pictures/house.py`` writes ``docs/pictures/house.svg`` and prints the counts. A room is a file or a folder
of the package, its floor that of the list in ``docs/architecture.md``.
"""

from __future__ import annotations

import ast
import re
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "ctm_plugin"
PAGE = ROOT / "docs" / "architecture.md"
PICTURE = ROOT / "docs" / "pictures" / "house.svg"
SPINE = ("cli", "runs", "callbacks", "backbones", "show", "metrics", "color", "rays", "cpu")
WIDTH, FLOOR, ROOM, GAP = 1000, 74, 34, 16


def floors(page: str) -> dict[str, int]:
    """Each room's floor in a page's numbered list, from the ground up.

    Raises:
        ValueError: the list's numbers do not run from 1 up, or a room stands on two floors.
    """
    listed = re.findall(r"^(\d+)\. (`.*`)$", page, re.MULTILINE)
    if [int(number) for number, _ in listed] != list(range(1, len(listed) + 1)):
        raise ValueError(f"floors {[number for number, _ in listed]}, expected 1, 2, 3, ...")
    stand = [(room, int(number)) for number, names in listed for room in re.findall(r"`(\w+)`", names)]
    if len(dict(stand)) != len(stand):
        raise ValueError("a room stands on two floors")
    return dict(stand)


def room_of(path: Path, package: Path) -> str:
    return path.relative_to(package).parts[0].removesuffix(".py")


def rooms(package: Path) -> dict[str, int]:
    """The rooms of a package and their lines."""
    found: dict[str, int] = {}
    for path in sorted(package.rglob("*.py")):
        room = room_of(path, package)
        found[room] = found.get(room, 0) + len(path.read_text(encoding="utf-8").splitlines())
    return found


def imported(path: Path, package: Path) -> set[str]:
    """The rooms of a package that a file imports, at its head or anywhere in it.

    Raises:
        ValueError: a relative import; here they are written in full.
    """
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            if node.level:
                raise ValueError(f"{path}: a relative import")
            names += [f"{node.module}.{each.name}" for each in node.names]
        elif isinstance(node, ast.Import):
            names += [each.name for each in node.names]
    first = ["".join(name.split(".")[1:2]) for name in names if name.split(".")[0] == package.name]
    known = {each.name.removesuffix(".py") for each in package.iterdir()}
    return {part if part in known else "__init__" for part in first}


def arrows(package: Path) -> dict[tuple[str, str], list[Path]]:
    """Who imports whom, and in which files."""
    found: dict[tuple[str, str], list[Path]] = {}
    for path in sorted(package.rglob("*.py")):
        for room in sorted(imported(path, package) - {room_of(path, package)}):
            found.setdefault((room_of(path, package), room), []).append(path)
    return found


def counts(package: Path, page: str) -> str:
    """How large the house is, in a sentence."""
    size, stand = rooms(package), floors(page)
    return (
        f"{len(size)} rooms on {max(stand.values())} floors, {len(arrows(package))} arrows, "
        f"{sum(size.values()):,} lines"
    )


def drawing(package: Path, page: str) -> str:
    """The picture, as SVG."""
    stand = floors(page)
    top, place = max(stand.values()), {}
    parts = []
    for floor in range(1, top + 1):
        here = [room for room in stand if stand[room] == floor]
        y = (top - floor) * FLOOR + 20
        widths = {room: 7.2 * len(room) + 40 for room in here}
        x = (WIDTH - sum(widths.values()) - GAP * (len(here) - 1)) / 2
        parts.append(f'<text x="8" y="{y + 22}" class="floor">{floor}</text>')
        for room in here:
            place[room] = (x, y, widths[room])
            x += widths[room] + GAP
    for upper, lower in sorted(arrows(package)):
        (x1, y1, w1), (x2, y2, w2) = place[upper], place[lower]
        kind = "spine" if (upper, lower) in pairwise(SPINE) else "arrow"
        ends = f"{x1 + w1 / 2:.0f} {y1 + ROOM}", f"{x2 + w2 / 2:.0f} {y2}"
        bend = f"{x1 + w1 / 2:.0f} {y1 + ROOM + 26}", f"{x2 + w2 / 2:.0f} {y2 - 26}"
        parts.append(f'<path class="{kind}" d="M {ends[0]} C {bend[0]} {bend[1]} {ends[1]}"/>')
    for room, (x, y, width) in place.items():
        parts.append(f'<rect x="{x:.0f}" y="{y}" width="{width:.0f}" height="{ROOM}" rx="5"/>')
        parts.append(f'<text x="{x + width / 2:.0f}" y="{y + 22}" class="room">{room}</text>')
    style = (
        "text{font:13px sans-serif;fill:#223}.room{text-anchor:middle}.floor{fill:#99a}"
        "rect{fill:#eef2fb;stroke:#5b74b8}path{fill:none;stroke:#8a93ab;stroke-opacity:.45}"
        ".spine{stroke:#c8501e;stroke-width:2.5;stroke-opacity:1}"
    )
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {top * FLOOR + 10}"><style>{style}</style>'
    return "\n".join([head, '<rect width="100%" height="100%" style="fill:#fff;stroke:none"/>', *parts, "</svg>\n"])


def main(picture: Path = PICTURE) -> None:
    """Draw the house into ``picture``, and print its counts."""
    page = PAGE.read_text(encoding="utf-8")
    picture.write_text(drawing(PACKAGE, page), encoding="utf-8")
    print(f"{counts(PACKAGE, page)}; written to {picture}")


if __name__ == "__main__":
    main()
