"""What the HTML page shows of runs: pictures beside the photograph, and any two of them."""

import numpy as np

from ctm_plugin.report.labels import find_runs
from ctm_plugin.report.page import first_seeds, scene_entry, windows_of


def test_a_single_run_beside_the_photograph(made):
    (run,) = find_runs([made("ctm=off", views=True)]).runs
    page = scene_entry(run.scene, [run])
    assert page["names"] == {0: "photograph", 1: "backbone=dvgo ctm=off 30.00 dB"}
    assert page["sides"] == (0, 1)
    assert {each["title"]: (list(each["layers"]), each["sides"]) for each in page["sliders"]} == {
        "lit": ([0, 1], [0, 1]), "dark": ([1], [1]), "latent": ([1], [1]), "depth": ([1], [1]),
    }  # fmt: skip
    assert page["photograph"] == page["sliders"][0]["layers"][0]
    assert [list(each["windows"]) for each in page["sliders"]] == [["0 1"], [], [], []]


def test_any_number_of_runs_under_one_slider(made):
    for arguments in (["ctm=on"], ["ctm=off", "seed=1"], ["ctm=off"], ["ctm=off", "loss.weight=9"]):
        folder = made(*arguments, views=True)
    made("ctm=off", "color_space=lab", dataset="room", protocol="room")
    found = first_seeds(find_runs([folder.parent]).runs)
    assert {scene: len(runs) for scene, runs in found.items()} == {"room": 1, "still_life": 3}
    page = scene_entry("still_life", found["still_life"])
    assert list(page["names"].values()) == [
        "photograph",
        "ctm=off 30.00 dB",
        "ctm=off loss.weight=9 30.00 dB",
        "ctm=on 30.00 dB",
    ]
    assert page["sides"] == (1, 3)  # what is told apart by CTM alone
    assert scene_entry("room", found["room"])["sliders"] == []


def test_it_opens_on_plain_rgb_and_the_recommendation(made):
    for arguments in (["ctm=quick"], ["ctm=auto"], ["ctm=off", "color_space=lab"], ["ctm=off"]):
        folder = made(*arguments, views=True)
    (runs,) = first_seeds(find_runs([folder.parent]).runs).values()
    page = scene_entry("still_life", runs)
    assert [page["names"][side] for side in page["sides"]] == ["ctm=off 30.00 dB", "ctm=auto 30.00 dB"]
    assert all(each["sides"] == list(page["sides"]) for each in page["sliders"])


def test_any_two_pictures_have_a_window_of_their_own():
    """A quarter of a side; left, top, width, height. None between sizes."""
    pictures = {number: np.zeros((16, 24, 3), np.uint8) for number in range(3)}
    pictures[1][0:4, 0:6] = 90
    pictures[2][12:16, 18:24] = 90
    pictures[3] = np.zeros((8, 8, 3), np.uint8)
    found = windows_of(pictures)
    assert (found["0 1"], found["0 2"]) == ([0, 0, 6, 4], [18, 12, 6, 4])
    assert set(found) == {"0 1", "0 2", "1 2"}
