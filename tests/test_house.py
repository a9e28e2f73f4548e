"""Imports go down: the floors are those of docs/architecture.md, a room is a file or a folder of the package."""

import ast
import re
from pathlib import Path

import pytest

import ctm_plugin

PACKAGE = Path(ctm_plugin.__file__).parent
PAGE = Path(__file__).parents[1] / "docs" / "architecture.md"


def floors(page: str) -> dict[str, int]:
    """Each room's floor in a page's numbered list."""
    listed = re.findall(r"^(\d+)\. (`.*`)$", page, re.MULTILINE)
    assert [int(number) for number, _ in listed] == list(range(1, len(listed) + 1))
    rooms = [(room, int(number)) for number, names in listed for room in re.findall(r"`(\w+)`", names)]
    assert len(dict(rooms)) == len(rooms), "a room stands on two floors"
    return dict(rooms)


def room_of(path: Path, package: Path) -> str:
    return path.relative_to(package).parts[0].removesuffix(".py")


def rooms(package: Path) -> set[str]:
    return {room_of(path, package) for path in package.rglob("*.py")}


def imported(path: Path, package: Path) -> set[str]:
    """The rooms of a package that a file imports, at its head or anywhere in it."""
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: imports are written in full here"
            names += [f"{node.module}.{each.name}" for each in node.names]
        elif isinstance(node, ast.Import):
            names += [each.name for each in node.names]
    first = [name.split(".")[1:2] for name in names if name.split(".")[0] == package.name]
    known = rooms(package)
    return {"".join(part) if "".join(part) in known else "__init__" for part in first}


def uphill(package: Path, floor: dict[str, int]) -> list[str]:
    """Imports from another room that does not stand on a lower floor."""
    return [
        f"{path.relative_to(package)} imports {room}"
        for path in sorted(package.rglob("*.py"))
        for room in sorted(imported(path, package) - {room_of(path, package)})
        if floor[room] >= floor[room_of(path, package)]
    ]


def test_every_room_has_a_floor():
    assert floors(PAGE.read_text(encoding="utf-8")).keys() == rooms(PACKAGE)


def test_nothing_runs_uphill():
    """Nor on the level, so that there is no circle either."""
    assert uphill(PACKAGE, floors(PAGE.read_text(encoding="utf-8"))) == []


@pytest.mark.parametrize(
    "line",
    [
        "from house.roof.tiles import tile",
        "from house import roof",
        "import house.roof",
        "def f():\n    import house.roof",
        "if TYPE_CHECKING:\n    from house.roof import tile",
        "from house.hall import door",
    ],
)
def test_what_runs_uphill_is_found(tmp_path, line):
    package = tmp_path / "house"
    for name in ("__init__", "cellar", "hall/door", "roof/tiles"):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / f"{name}.py").write_text("from house.cellar import wine\nfrom house import __version__\n")
    for name in ("__init__", "cellar"):
        (package / f"{name}.py").write_text("")
    floor = floors("1. `__init__`, `cellar`\n2. `hall`\n3. `roof`\n")
    assert uphill(package, floor) == []
    (package / "cellar.py").write_text(line)
    (room,) = {"roof", "hall"} & imported(package / "cellar.py", package)
    assert uphill(package, floor) == [f"cellar.py imports {room}"]


def test_a_room_has_one_floor():
    with pytest.raises(AssertionError, match="two floors"):
        floors("1. `a`, `b`\n2. `b`\n")
