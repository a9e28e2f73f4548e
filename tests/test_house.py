"""Imports go down: the floors are those of docs/architecture.md, a room is a file or a folder of the package."""

from pathlib import Path

import pytest
from pages import load

house = load("docs/pictures/house.py")
PAGE = house.PAGE.read_text(encoding="utf-8")


def uphill(package: Path, floor: dict[str, int]) -> list[str]:
    """Imports from another room that does not stand on a lower floor."""
    return [
        f"{path.relative_to(package)} imports {lower}"
        for (upper, lower), paths in house.arrows(package).items()
        for path in paths
        if floor[lower] >= floor[upper]
    ]


def test_every_room_has_a_floor():
    assert house.floors(PAGE).keys() == house.rooms(house.PACKAGE).keys()


def test_the_picture_is_that_of_the_code():
    assert house.PICTURE.read_text(encoding="utf-8") == house.drawing(house.PACKAGE, PAGE), (
        "another house: python docs/pictures/house.py"
    )


def test_nothing_runs_uphill():
    """Nor on the level, so that there is no circle either."""
    assert uphill(house.PACKAGE, house.floors(PAGE)) == []


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
    floor = house.floors("1. `__init__`, `cellar`\n2. `hall`\n3. `roof`\n")
    assert uphill(package, floor) == []
    (package / "cellar.py").write_text(line)
    (room,) = {"roof", "hall"} & house.imported(package / "cellar.py", package)
    assert uphill(package, floor) == [f"cellar.py imports {room}"]


def test_a_room_has_one_floor():
    with pytest.raises(ValueError, match="two floors"):
        house.floors("1. `a`, `b`\n2. `b`\n")
