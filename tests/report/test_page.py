"""What the HTML page shows of runs: pictures beside the photograph, and their curves."""

import numpy as np
import pytest
from torch.utils.tensorboard import SummaryWriter

from ctm_plugin.report.labels import find_runs
from ctm_plugin.report.page import Curve, curves, curves_of, first_seeds, scene_entry, windows_of


def log(folder, **curves: list[float]) -> None:
    """Write curves with a point every two steps, of which each takes a minute."""
    with SummaryWriter(folder / "tensorboard") as writer:
        for index in range(max(map(len, curves.values()))):
            writer.add_scalar("speed/ms_per_step", 60_000, 2 * index)
        for tag, values in curves.items():
            for index, value in enumerate(values):
                writer.add_scalar(tag.replace("_", "/", 1), value, 2 * index)


def test_curves_over_steps_and_time(tmp_path):
    log(tmp_path, psnr_test_view=[20.0], psnr_rgb=[1.0, 2.0, 3.0], loss_total=[1.0, 2.0])
    assert curves_of(tmp_path) == {"psnr/rgb": Curve([0, 2, 4], [0.0, 2.0, 4.0], [1.0, 2.0, 3.0])}


@pytest.mark.parametrize(
    ("points", "title"),
    [
        ([(3, 3), (3, 9)], "PSNR of a test view, dB"),
        ([(3, 3), (2, 9)], "PSNR of the training pixels, dB"),  # two points are no course
        ([(2, 1), (2, 9)], "PSNR of a test view, dB"),
    ],
)
def test_all_runs_are_drawn_by_the_curve_that_all_have(tmp_path, monkeypatch, points, title):
    drawn = []
    monkeypatch.setattr("ctm_plugin.report.page.Figure.savefig", lambda figure, *_, **__: drawn.append(figure))
    for name, (views, pixels) in zip("ab", points, strict=True):
        log(tmp_path / name, psnr_test_view=[20.0] * views, psnr_rgb=[10.0] * pixels)
    assert curves({name: tmp_path / name for name in "ab"} | {"none": tmp_path}).startswith("data:image/png")
    over_steps, over_time = drawn[0].axes
    assert over_steps.get_ylabel() == title
    assert len(over_steps.lines) == len(over_time.lines) == 2


def test_no_curves(tmp_path):
    assert curves_of(tmp_path) == {}
    assert curves({"a": tmp_path}) is None


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
