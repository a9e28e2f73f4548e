"""``ctm cameras``: a dark corner of three walls, whose cameras are known, and everything that is refused."""

import errno
import re
import runpy
import shutil
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from ctm_scenes.trajectory import forward_facing
from forked import Command
from PIL import Image
from PIL.ExifTags import IFD, Base
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from ctm_plugin import cli
from ctm_plugin.appearance.measured_gains import UNEVEN, gains_by_points
from ctm_plugin.cameras import command
from ctm_plugin.cameras.colmap import FILM_DIAGONAL, focal_length
from ctm_plugin.cameras.lenses import with_focal_length
from ctm_plugin.cameras.photographs import home_of, list_photographs
from ctm_plugin.cameras.trust import Trusted
from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.colmap import ColmapConfig
from ctm_plugin.data.readers.colmap_model import mark_as_shown
from ctm_plugin.data.readers.picture import Header, Lens
from ctm_plugin.errors import DataError

COMPARE = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "cameras.py"))
SIZE, ANGLE, COUNT, LIGHT = (176, 132), 0.8, 9, 0.03
FOCAL = 0.5 * SIZE[0] / np.tan(0.5 * ANGLE)
POSES = forward_facing(COUNT, (4.0, 3.6, 3.0), (0.4, 0.4, 0.6), (2.2, 1.6), seed=1)
NAMES = [f"corner {number + 1}.png" for number in range(COUNT)]
TURNED = NAMES[3]
NAMES[7:] = [f"more/{name}" for name in NAMES[7:]]
COLMAP = pytest.mark.skipif(
    find_spec("pycolmap") is None, reason="pycolmap is not installed: pip install -e '.[colmap]'"
)


def corner(pose: np.ndarray, walls: np.ndarray, size: tuple[int, int] = SIZE, focal: float = FOCAL) -> np.ndarray:
    """``[H, W]`` light of three walls that meet in the origin, ``[3, n, n]``, each painted four units wide."""
    x, y = ((np.arange(side) + 0.5 - side / 2) / focal for side in size)
    x, y = np.meshgrid(x, y)
    ray = np.stack([x, -y, -np.ones_like(x)], axis=-1) @ pose[:3, :3].T
    away = np.where(ray < 0, -pose[:3, 3] / np.minimum(ray, -1e-9), np.inf)
    hit = pose[:3, 3] + away.min(axis=-1, keepdims=True) * ray
    parts = [
        map_coordinates(wall, np.moveaxis(np.delete(hit, axis, -1), -1, 0) * len(wall) / 4, order=1, mode="grid-wrap")
        for axis, wall in enumerate(walls)
    ]
    return np.choose(away.argmin(axis=-1), parts)


def painted() -> np.ndarray:
    """Three walls ``[3, 256, 256]`` with details of several sizes."""
    chance = np.random.default_rng(0)
    walls = sum(gaussian_filter(chance.normal(size=(3, 256, 256)), (0, s, s), mode="wrap") * s for s in (1.5, 4, 10))
    return np.clip(0.4 + 0.6 * walls, 0, 1)


def photograph(light: np.ndarray) -> np.ndarray:
    """``[H, W, 3]`` codes of 8 bits."""
    return (linear_to_srgb(torch.from_numpy(light)) * 255).round().byte()[..., None].expand(-1, -1, 3).numpy()


@pytest.fixture(scope="module")
def dark(tmp_path_factory) -> Path:
    """Photographs under 3 % of the light, 8 bits, names with spaces, two in a folder; one of a camera upside down."""
    root = tmp_path_factory.mktemp("capture") / "corner"
    (root / "images" / "more").mkdir(parents=True)
    walls = painted()
    for name, pose in zip(NAMES, POSES, strict=True):
        picture, exif = photograph(corner(pose, walls) * LIGHT), Image.Exif()
        if name == TURNED:
            picture, exif[Base.Orientation] = picture[::-1, ::-1], 3
        Image.fromarray(np.ascontiguousarray(picture)).save(root / "images" / name, exif=exif)
    return root


def run(told: Path, *arguments: object) -> subprocess.CompletedProcess:
    """In a process of its own, so that no other test meets pycolmap's libraries."""
    process = Command("cameras", *map(str, arguments), told=told)
    said = process.communicate(timeout=300)
    return subprocess.CompletedProcess(arguments, process.returncode, *said)


@pytest.fixture(scope="module")
def found(dark, tmp_path_factory) -> subprocess.CompletedProcess:
    before = {path: path.read_bytes() for path in (dark / "images").rglob("*.png")}
    (dark / "images" / "notes.txt").write_text("not a picture")
    done = run(tmp_path_factory.mktemp("told") / "found", dark, "threads=1")
    (dark / "images" / "notes.txt").unlink()
    assert {path: path.read_bytes() for path in (dark / "images").rglob("*.png")} == before
    return done


@COLMAP
def test_the_cameras_are_those_that_took_the_pictures(dark, found):
    assert found.returncode == 0, found.stderr
    poses, focal = COMPARE["read"](dark)
    names = [Path(name).stem for name in NAMES]
    assert sorted(poses) == sorted(names)
    centre, turn, _ = COMPARE["errors"](np.stack([poses[name] for name in names]), POSES[:, :3])
    assert centre.max() < 0.01
    assert turn.max() < 0.5
    assert focal == pytest.approx(FOCAL, rel=0.02)


@COLMAP
def test_what_is_told(dark, found):
    assert re.search(rf"pictures +{COUNT} of {COUNT} *\n", found.stdout)
    assert re.search(r"points +\d+; a mean picture sees \d+ that two others see *\n", found.stdout)
    assert re.search(r"reprojection error +0\.\d\d pixels", found.stdout)
    assert f"written to {dark / 'sparse/0'}\n" in found.stdout
    assert found.stdout.endswith(f"next: ctm photos {dark}\n")
    assert "other files left out: 1, as 'notes.txt'" in found.stderr


@pytest.mark.slow
@COLMAP
@pytest.mark.usefixtures("found")
def test_stopped_the_same_command_goes_on_to_the_same_cameras(dark, tmp_path):
    """Stopped when all is matched: details and matches are there, and nothing is left of them in the end."""
    shutil.copytree(dark / "images", tmp_path / "images")
    stop = "import sys; from ctm_plugin import cli; from ctm_plugin.cameras.colmap import Workshop\n"
    stop += "def stopped(*_): raise KeyboardInterrupt\nWorkshop.reconstruct = stopped; sys.exit(cli.main(sys.argv[1:]))"
    command_line = ["cameras", str(tmp_path), "threads=1"]
    done = subprocess.run([sys.executable, "-c", stop, *command_line], capture_output=True, text=True)
    assert done.returncode == 130
    assert done.stderr.endswith(f"\nstopped; what was done is kept; go on with: ctm {' '.join(command_line)}\n")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".ctm_cameras", "images"]
    done = run(tmp_path / "told", tmp_path, "threads=1")
    assert f"details: {COUNT} of {COUNT}, {COUNT} of them before, " in done.stderr
    assert not (tmp_path / ".ctm_cameras").exists()
    for name in ("cameras.bin", "images.bin"):
        assert (tmp_path / "sparse/0" / name).read_bytes() == (dark / "sparse/0" / name).read_bytes()


@COLMAP
@pytest.mark.usefixtures("found")
def test_the_folder_is_read_afterwards(dark):
    scene = ColmapConfig(root=dark).load()
    assert len(scene.train) + len(scene.test) == COUNT
    assert scene.train.images.float().mean() < 60  # as taken, not the bright copies
    assert 0 < scene.near < scene.far
    stored = iio.imread(dark / "images" / TURNED, plugin="pillow")
    np.testing.assert_array_equal(scene.train.images[scene.train.names.index("corner 4")], stored[::-1, ::-1])


@COLMAP
def test_sigterm_ends_without_a_stack():
    code = "import signal; from ctm_plugin.cameras.colmap import require_pycolmap; require_pycolmap()\n"
    done = subprocess.run([sys.executable, "-c", f"{code}signal.raise_signal(signal.SIGTERM)"], capture_output=True)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGTERM, b"", b"")


def gains_of(root: Path) -> dict[str, float]:
    scene = ColmapConfig(root=root).load()
    return dict(zip(scene.train.names, gains_by_points(scene).tolist(), strict=True))


@pytest.mark.slow
@COLMAP
@pytest.mark.usefixtures("found")
def test_uneven_exposures_are_seen_in_the_points(dark, tmp_path):
    """The same capture with every second picture a third brighter; as it is, exposures are even."""
    assert np.std([*gains_of(dark).values()]) < 0.5 * UNEVEN
    uneven = shutil.copytree(dark, tmp_path / "uneven")
    walls = painted()
    for number, (name, pose) in enumerate(zip(NAMES, POSES, strict=True)):
        if number % 2 and name != TURNED:
            iio.imwrite(uneven / "images" / name, photograph(corner(pose, walls) * LIGHT * 4 / 3))
    bright = {Path(name).stem: number % 2 and name != TURNED for number, name in enumerate(NAMES)}
    found = gains_of(uneven)
    true = np.log(4 / 3) * np.array([bright[name] for name in found])
    np.testing.assert_allclose(np.array([*found.values()]) - np.mean([*found.values()]), true - true.mean(), atol=0.03)


@COLMAP
def test_two_lenses_and_upright_pictures_have_a_camera_each(tmp_path):
    """Pictures of one size through two lenses, which only EXIF tells apart; every third is upright."""
    (tmp_path / "images" / "more").mkdir(parents=True)
    walls, focal = painted(), {}
    for number, (name, pose) in enumerate(zip(NAMES, POSES, strict=True)):
        size, film = SIZE[:: -1 if number % 3 == 2 else 1], (41, 27)[number % 2]
        focal[Path(name).name] = film * np.hypot(*SIZE) / FILM_DIAGONAL
        exif = Image.Exif()
        exif[Base.Orientation] = 1  # Pillow writes none into a PNG that has but the other tag
        exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = film
        picture = photograph(corner(pose, walls, size, focal[Path(name).name]))
        Image.fromarray(picture).save(tmp_path / "images" / name, exif=exif)
    done = run(tmp_path / "told", tmp_path, "threads=1")
    assert done.returncode == 0, done.stderr
    assert len(re.findall(r"focal length +\d+\.\d pixels of (176x132|132x176), in \d pictures", done.stdout)) == 4
    poses, _ = COMPARE["read"](tmp_path)
    centre, turn, _ = COMPARE["errors"](np.stack([poses[Path(name).stem] for name in NAMES]), POSES[:, :3])
    assert centre.max() < 0.01
    assert turn.max() < 1
    with pytest.warns(UserWarning, match="pictures of 2 sizes"):
        scene = ColmapConfig(root=tmp_path).load()
    found = {f"{name}.png": each for name, each in zip(scene.train.names, scene.train.intrinsics[:, 0], strict=True)}
    assert {name: float(each) for name, each in found.items()} == pytest.approx({n: focal[n] for n in found}, rel=0.02)


@pytest.mark.slow
@COLMAP
def test_two_lenses_that_nothing_tells_have_a_camera_each(tmp_path):
    """Pictures of one size without EXIF, every second one zoomed in."""
    (tmp_path / "images" / "more").mkdir(parents=True)
    walls, focal = painted(), (FOCAL, 1.5 * FOCAL)
    for number, (name, pose) in enumerate(zip(NAMES, POSES, strict=True)):
        Image.fromarray(photograph(corner(pose, walls, SIZE, focal[number % 2]))).save(tmp_path / "images" / name)
    done = run(tmp_path / "told", tmp_path, "threads=1")
    assert done.returncode == 0, done.stderr
    assert "2 lenses without EXIF, of " in done.stderr
    lengths = re.findall(r"focal length +(\d+\.\d) pixels of 176x132, in [45] pictures", done.stdout)
    assert sorted(map(float, lengths)) == pytest.approx(focal, rel=0.03)
    poses, _ = COMPARE["read"](tmp_path)
    centre, _, _ = COMPARE["errors"](np.stack([poses[Path(name).stem] for name in NAMES]), POSES[:, :3])
    assert centre.max() < 0.02


@COLMAP
def test_blank_pictures_have_no_cameras_and_what_was_there_stays(tmp_path):
    """Nothing to hold on to, though cameras may be replaced."""
    (tmp_path / "images").mkdir()
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / "cameras.bin").write_bytes(b"before")
    for level, name in enumerate("abc", 7):
        iio.imwrite(tmp_path / "images" / f"{name}.png", np.full((48, 64, 3), level, dtype=np.uint8))
    done = run(tmp_path / "told", tmp_path, "overwrite=true", "brighten=false")
    assert done.returncode == 1
    assert (
        "images: found a place for 0 of 3 pictures (0 details in a mean picture; 0 of 3 pairs match), "
        "expected for 3 at least, 40 such points each: brighten=true; sharper pictures"
    ) in done.stderr
    assert "Traceback" not in done.stderr
    assert [path.name for path in (tmp_path / "sparse").rglob("*")] == ["0", "cameras.bin"]
    assert (tmp_path / "sparse" / "0" / "cameras.bin").read_bytes() == b"before"


# Without COLMAP


@pytest.mark.parametrize(("observations", "few"), [(99, True), (100, False)])
def test_places_that_few_points_hold_are_told(tmp_path, capsys, observations, few):
    numbers = {"num_points3D": lambda: 9, "compute_mean_reprojection_error": lambda: 0.5, "reg_image_ids": list}
    command.tell(tmp_path, [], Trusted(SimpleNamespace(**numbers), 1, 0, observations), 1.0)
    assert (", few: places may be off by some percent" in capsys.readouterr().out) == few


@pytest.fixture
def three(tmp_path) -> Path:
    (tmp_path / "images").mkdir()
    for level, name in enumerate("abc"):
        iio.imwrite(tmp_path / "images" / f"{name}.png", np.full((6, 8, 3), level, dtype=np.uint8))
    return tmp_path


def test_without_the_extra_it_says_what_to_install(three, monkeypatch, refused):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert "finding cameras needs pycolmap: pip install -e '.[colmap]'" in refused("cameras", three)
    assert [path.name for path in three.iterdir()] == ["images"]


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("pictures=low", "found images, expected photographs in low; for others, ctm cameras FOLDER pictures=NAME"),
        ("pictures=../low", "pictures: found '../low', expected the name of a folder"),
        ("lens=FISHEYE", "lens: found 'FISHEYE', expected one of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, "),
        ("threads=0", "threads: found 0, expected a number >= 1, or -1 for all"),
        ("threads=-2", "threads: found -2"),
        ("size=8", "size: found 8, expected an integer >= 64"),
        ("seed=-1", "seed: found -1"),
        ("brighten=maybe", "brighten: found 'maybe'"),
    ],
)
def test_settings_that_cannot_be_used(three, refused, setting, told):
    assert told in refused("cameras", three, setting)


def test_folders_that_cannot_be_used(three, refused):
    assert "nowhere: found nothing there, expected a folder with photographs or clips" in refused("cameras", "nowhere")
    (three / "images" / "c.png").rename(three / "images" / "c.bmp")
    assert "images: found 2 pictures, expected at least 3 ending in .png" in refused("cameras", three)


@pytest.mark.parametrize(
    ("names", "count", "hint"),
    [
        (("a.jpg", "b.jpg"), 2, ".avif\n"),
        (("a.BMP", "b.BMP", "c.BMP"), 0, "(mogrify -format png '{}'/*.BMP)\n"),
        (("a.jpg", "b.jpg", "c.BMP"), 2, "(mogrify -format png '{}'/*.BMP)\n"),
    ],
)
def test_loose_photographs_that_are_too_few(tmp_path, refused, names, count, hint):
    """They are counted where they lie, and the command turns those of another kind there."""
    root = tmp_path / "my capture"
    root.mkdir()
    for name in names:
        (root / name).write_bytes(b"x")
    error = refused("cameras", root)
    assert f"my capture: found {count} pictures, expected at least 3 ending in .png" in error
    assert error.endswith(hint.format(root))


@pytest.mark.parametrize("alike", [True, False])
def test_black_photographs(tmp_path, refused, alike):
    """Copies of one another, and not; one has a grey level of 8 bits."""
    for number in range(4):
        picture = np.zeros((64, 80 if alike else 80 + number, 3), dtype=np.uint8)
        picture[:number] = not alike
        iio.imwrite(tmp_path / f"{number}.png", picture)
    assert f"{tmp_path}: found 4 black pictures, expected photographs with some light\n" in refused("cameras", tmp_path)


def test_a_folder_that_cannot_be_written_to(three, monkeypatch, refused):
    """Cameras are put beside the photographs, and no key moves them."""

    def shut(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(command, "replacing_folder", shut)
    error = refused("cameras", three)
    assert "found a folder that cannot be written to (Permission denied), expected a copy of it: " in error
    assert "hydra" not in error


def test_how_pictures_get_into_the_folder(tmp_path, refused):
    """Loose ones are taken where they lie, others out of folders; frames of a clip that can be read."""
    root = tmp_path / "my capture"
    root.mkdir()
    for level, name in enumerate(("a.png", "b.png", "c.JPG")):
        iio.imwrite(root / name, np.full((6, 8, 3), level, dtype=np.uint8))
    assert list_photographs(root, "images") == [root / "a.png", root / "b.png", root / "c.JPG"]
    (root / "images" / "cam0").mkdir(parents=True)
    for name in ("a.png", "b.png", "c.JPG"):
        (root / name).rename(root / "images" / "cam0" / name)
    (root / "masks").mkdir()
    iio.imwrite(root / "masks" / "a.png", np.zeros((6, 8), dtype=np.uint8))
    assert [path.name for path in list_photographs(root, "images")] == ["a.png", "b.png", "c.JPG"]
    (root / "images").rename(root / "phone")
    assert home_of(root, "images") == root / "phone"
    assert [path.name for path in list_photographs(root, "images")] == ["a.png", "b.png", "c.JPG"]
    (root / "clip.MP4").write_bytes(b"x")
    assert "clip.MP4: found a clip that cannot be read" in refused("cameras", root / "clip.MP4")


def test_photographs_that_were_added_are_told(three, refused):
    """Those that were there and found no place are not meant."""
    (three / "sparse" / "0").mkdir(parents=True)
    (three / "sparse" / "0" / "images.bin").write_bytes(b"before")
    mark_as_shown(three / "sparse" / "0", ["a.png", "b.png"])
    assert "that are there already, and 1 photographs that were added since, expected none, or" in refused(
        "cameras", three
    )


@pytest.mark.parametrize("name", ["sparse/0/images.bin", "sparse/cameras.bin"])
def test_cameras_that_are_there_are_kept(three, refused, name):
    (three / name).parent.mkdir(parents=True)
    (three / name).write_bytes(b"before")
    error = refused("cameras", three)
    assert "found cameras that are there already, expected none, or overwrite=true to replace them" in error
    assert (three / name).read_bytes() == b"before"


def test_what_was_done_before_an_interrupt_is_for_the_same_search(three, monkeypatch, capsys):
    """And nothing else stays; when it fails, not even that."""
    begun = []

    def stopped(*given: object) -> None:
        assert any((three / "sparse").iterdir())
        begun.append((given[-1] / "details").exists())
        (given[-1] / "details").touch()
        raise KeyboardInterrupt if len(begun) < 4 else DataError(three, "nothing", "something")

    monkeypatch.setattr(command, "require_pycolmap", lambda: None)
    monkeypatch.setattr(command, "find_cameras", stopped)
    for more in ([], ["threads=1"], ["size=100"]):
        assert cli.main(["cameras", str(three), *more]) == 130
        told = f"stopped; what was done is kept; go on with: ctm cameras {' '.join([str(three), *more])}\n"
        assert capsys.readouterr().err == told
        assert sorted(path.name for path in three.iterdir()) == [".ctm_cameras", "images"]
    iio.imwrite(three / "images" / "c.png", np.full((6, 8, 3), 99, dtype=np.uint8))
    assert cli.main(["cameras", str(three), "size=100"]) == 1
    assert begun == [False, True, False, False]
    assert [path.name for path in three.iterdir()] == ["images"]


@pytest.mark.parametrize(("said", "focal"), [(None, 1.2 * 40), (26, 26 * 50 / 43.27)])
def test_the_first_focal_length_is_that_of_the_file(said, focal):
    """A picture of 40x30 has a diagonal of 50 pixels, one of 36x24 mm of 43.27 mm."""
    header = Header(30, 40, alpha=False, lens=Lens(film=said))
    assert focal_length(header) == (pytest.approx(focal), said is not None)
    assert with_focal_length(header, None) is header
    assert focal_length(with_focal_length(header, 33.0)) == (pytest.approx(33.0), True)


def test_the_comparison_knows_similarities():
    """Cameras moved, turned and scaled as a whole are the same; one that is turned by itself is off by that."""
    turn = Rotation.random(random_state=0).as_matrix()
    moved = turn @ POSES[:, :3]
    moved[..., 3] = 3 * moved[..., 3] + np.random.default_rng(0).normal(size=3)
    assert max(each.max() for each in COMPARE["errors"](moved, POSES[:, :3])) < 1e-5
    moved[4, :, :3] = moved[4, :, :3] @ Rotation.from_rotvec([0, 0, 0.1]).as_matrix()
    assert COMPARE["errors"](moved, POSES[:, :3])[1][4] == pytest.approx(np.degrees(0.1))
