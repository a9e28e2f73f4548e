"""The page of a run: what it holds, that it fits, and what a browser shows of it."""

import base64
import re
import shutil
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from browser import opened, seen, until
from PIL import Image

from ctm_plugin.cli import main
from ctm_plugin.export import page as pages
from ctm_plugin.export.page import write_page
from ctm_plugin.export.video import write_video
from ctm_plugin.metrics.evaluate import Scoring
from ctm_plugin.runs.load import load_posed


@pytest.fixture(scope="module")
def run(trained) -> Path:
    """A dark scene in splats, 64 pixels wide."""
    data = ("dataset=still_life", "dataset.light=dark", "dataset.downscale=2", "ctm=auto", "dataset.skip=3")
    sizes = ("backbone=splat", "backbone.steps=50", "backbone.reset_every=0", "trainer=smoke", "logger=none")
    return trained("paged_splats", *data, *sizes, "trainer.image_every=null")


@pytest.fixture
def own(run, tmp_path, monkeypatch) -> Path:
    """One to write into, with a name that would be markup."""
    monkeypatch.setattr(pages, "COLOR_STEPS", 10)
    monkeypatch.setattr(pages, "MAX_VIEWS", 4)
    return Path(shutil.copytree(run, tmp_path / "<b>run"))


def text_of(run: Path) -> str:
    return (run / "index.html").read_text(encoding="utf-8")


def pictures(page: str) -> int:
    return page.count("data:image/webp")


def test_from_the_command_line(own, capsys, refused):
    assert main(["export", str(own), "what=page"]) == 0
    told, page = capsys.readouterr().out, text_of(own)
    assert f"written to {own / 'index.html'}" in told
    assert f"the page has no film, as the run has none: ctm render '{own}'" in told
    assert f"the page shows {pages.MAX_VIEWS} of {len(load_posed(own).module.scene.test)} test views" in told
    assert pictures(page) == 3 * pages.MAX_VIEWS + 1  # lit, dark and brightened; and one behind the button
    assert "VISER_EMBED_DATA" in page
    assert "<b>run" not in page
    assert "overwrite=true" in refused("export", own, "what=page")
    assert main(["export", str(own), "what=page", f"out={own / 'other'}"]) == 0
    assert (own / "other/index.html").is_file()


@pytest.mark.parametrize(("film", "kind"), [("a.gif", "image/webp"), ("a.mp4", "video/mp4")])
def test_a_film_that_fits(tmp_path, capsys, monkeypatch, film, kind):
    """Fewer pixels where it has too many bytes; as it is, or a WebP of a GIF, where it has not."""
    noise = list(np.random.default_rng(0).integers(0, 255, (6, 64, 64, 3), np.uint8))
    write_video(tmp_path / film, noise, fps=10)
    whole = base64.b64decode(pages.film_url(tmp_path / film).removeprefix(f"data:{kind};base64,"))
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(pages, "MAX_FILM_BYTES", int(0.7 * len(whole)))
    (tmp_path / "b").write_bytes(base64.b64decode(pages.film_url(tmp_path / film).partition(",")[2]))
    small = iio.imread(tmp_path / "b", extension="." + kind[6:], index=None if kind == "video/mp4" else ...)
    assert len(small) == 6
    assert small.shape[1] == small.shape[2] < 64
    assert "the page's film is " in capsys.readouterr().out


def test_all_is_made_smaller_until_it_fits(own, capsys, monkeypatch):
    posed = load_posed(own)
    (own / "video").mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (6, 64, 64, 3), np.uint8)
    write_video(own / "video/a.gif", list(noise), fps=10)
    monkeypatch.setattr(pages, "MAX_FILM_BYTES", 15_000)
    monkeypatch.setattr(pages, "MAX_PICTURE_BYTES", 3_000)
    monkeypatch.setattr(pages, "LIMIT", pages.VIEWER_BYTES + 60_000)
    write_page(own / "index.html", own, posed, posed.light)
    told, page = capsys.readouterr().out, text_of(own)
    assert "the page shows 4 of " in told
    assert re.search(r"the page's pictures are \d+ pixels wide, of 64: it is to have less than ", told)
    assert re.search(r"the page's film is \d+ pixels wide, of 64 in ", told)
    assert re.search(r"the page's walk has [\d,]+ of [\d,]+ spots", told)
    assert len(page.encode()) < pages.LIMIT
    assert pictures(page) == 3 * 4 + 1 + 1


def test_without_viser_and_without_splats(own, capsys, monkeypatch):
    monkeypatch.setattr(pages, "find_spec", lambda name: None)
    posed = load_posed(own)
    write_page(own / "index.html", own, posed, posed.light)
    assert pages.WITHOUT_VIEWER in capsys.readouterr().out
    assert "pip install -e" in text_of(own)
    assert "VISER" not in text_of(own)


def test_of_another_backbone(forward_page):
    assert "This scene is of dvgo, not of splats, so there is none to walk through." in forward_page


def test_of_places_without_photographs(own, monkeypatch):
    posed = load_posed(own)
    monkeypatch.setattr(pages, "find_spec", lambda name: None)
    monkeypatch.setattr(posed.module, "target", lambda view: None)
    write_page(own / "index.html", own, posed, posed.light)
    assert "From other places" in text_of(own)
    assert "Before and after" not in text_of(own)
    assert 'class="stage compare"' not in text_of(own)
    assert pictures(text_of(own)) == pages.MAX_VIEWS


@pytest.fixture(scope="module")
def forward_page(hall, trained, tmp_path_factory) -> str:
    sizes = ("trainer=smoke", "backbone=dvgo", "backbone.steps_alone=3", "backbone.grow=[]", "logger=none")
    run = trained("paged_voxels", "dataset=llff", f"dataset.root={hall}", *sizes)
    out = tmp_path_factory.mktemp("page")
    assert main(["export", str(run), "what=page", f"out={out}"]) == 0
    return (out / "index.html").read_text(encoding="utf-8")


def test_a_lit_scene_is_compared_with_its_photographs_alone(forward_page):
    assert "in the dark" not in forward_page
    assert "brightened" not in forward_page


def test_facts(own):
    posed = load_posed(own)
    told = pages.facts(posed, posed.light, {"detail": None})
    train, test = len(posed.module.scene.train), len(posed.module.scene.test)
    assert told[0].startswith(f"The program used {train} photographs. {test} more were kept aside")
    assert "times as bright" in told[1]
    assert "colours" in told[2]
    assert not any("detail" in each for each in told)
    assert "10% of the smallest detail" in pages.facts(posed, posed.light, {"detail": 0.1})[3]
    assert "something went wrong" in pages.facts(posed, posed.light, {"detail": 0.1})[3]
    assert "wrong" not in pages.facts(posed, posed.light, {"detail": 0.6})[3]


def test_pictures_of_several_sizes_are_shown_without_what_fills_the_canvas(own, monkeypatch):
    posed = load_posed(own)
    scene = posed.module.scene
    sizes = torch.tensor([[64, 40], [30, 64], [30, 64]]).repeat(len(scene.test), 1)[: len(scene.test)]
    monkeypatch.setattr(posed.module, "scene", replace(scene, test=replace(scene.test, sizes=sizes)))
    shots, size = pages.shots_of(posed.module, posed.light)
    assert size == (40, 64)
    assert {each.size for each in shots} == {(40, 64), (64, 30)}
    for each in shots:
        for address in (each.lit, each.taken, each.photo):
            assert Image.open(BytesIO(base64.b64decode(address.partition(",")[2]))).size == each.size
    write_page(own / "index.html", own, posed, posed.light)
    assert 'class="stage compare" style="--ratio: 64 / 30"' in text_of(own)
    posed.module.scores(own / "again", Scoring())
    names = scene.test.names[:2]
    assert [Image.open(own / f"again/photo/{name}.png").size for name in names] == [(40, 64), (64, 30)]


@pytest.mark.slow
def test_in_a_browser(own):
    """It opens as a file, asks nobody for anything, the line moves, and there is a scene to walk through."""
    posed = load_posed(own)
    write_page(own / "index.html", own, posed, posed.light)
    size = {"width": 700, "height": 700}
    address = (own / "index.html").as_uri()
    with opened(address, lambda url: not url.startswith((address, "data:", "blob:", "about:")), viewport=size) as page:
        slider, left = page.locator(".compare input").first, page.locator(".compare .left").first
        before = left.evaluate("of => getComputedStyle(of).clipPath")
        slider.fill("20")
        assert left.evaluate("of => getComputedStyle(of).clipPath") != before
        page.get_by_role("button", name="photograph, brightened").click()
        assert page.locator(".of-left").first.text_content() == "photograph, brightened"
        assert [page.locator(".compare .left").nth(n).is_visible() for n in (0, 1)] == [False, True]
        stage = page.locator("#walk")
        page.set_viewport_size({"width": 700, "height": 300})
        assert stage.bounding_box()["height"] <= 300  # all of it fits a window
        page.set_viewport_size(size)
        stage.scroll_into_view_if_needed()
        page.get_by_role("button", name="Look around").click()
        box = stage.bounding_box()
        inside = {name: box[name] for name in ("x", "y")} | {"width": box["width"], "height": box["height"]}
        inside["y"] += 0.5 * box["height"]
        inside["height"] *= 0.4  # below the notice that browsers without a GPU are given
        page.locator("iframe").wait_for()
        until(lambda: seen(page, inside).std() > 10, "the scene", seconds=60)
        shown = seen(page, inside)

        def dragged() -> bool:
            page.mouse.move(inside["x"] + 200, inside["y"] + 50)
            page.mouse.down()
            page.mouse.move(inside["x"] + 260, inside["y"] + 50, steps=4)
            page.mouse.up()
            return np.abs(seen(page, inside) - shown).mean() > 5

        until(dragged, "another picture when it is dragged", seconds=60)
        page.get_by_role("button", name="Close").click()
        assert page.locator("iframe").count() == 0
        assert page.told == []
