"""What is painted of a run, finished or not."""

import copy
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import Payload
from scipy.spatial.transform import Rotation

from ctm_plugin.cli import main as train
from ctm_plugin.rays.sampling import intersect_box
from ctm_plugin.runs.load import KINDS
from ctm_plugin.runs.rundir import LAST
from ctm_plugin.scene.views import Views
from ctm_plugin.view.camera import Camera, view_camera
from ctm_plugin.view.live_run import CHUNK, Subject
from ctm_plugin.view.look import Shot


@pytest.fixture
def whole(runs):
    return runs["on"]


def yes() -> bool:
    return True


def camera_of(views: Views, index: int = 0, aspect: float | None = None) -> Camera:
    camera = view_camera(views, index)
    return replace(camera, aspect=aspect or camera.aspect)


def paint(subject: Subject, camera: Camera, kind: str, longest: int, go_on=yes, **shot):
    shot = {"background": (255, 255, 255) if subject.scene.background == "white" else (0, 0, 0)} | shot
    rendered = subject.render(Shot(camera, **shot), *camera.size(longest), go_on)
    return rendered and subject.picture(rendered, kind, subject.run.factor)


@pytest.fixture(scope="session")
def every(runs, forward_run, splat_run):
    return {**runs, "forward": forward_run, "splat": splat_run}


@pytest.mark.parametrize("name", ["on", "forward", "splat"])
@pytest.mark.parametrize("kind", KINDS)
def test_at_a_test_view_it_is_what_evaluation_renders(every, name, kind):
    subject = Subject(every[name])
    views = subject.scene.test
    picture = paint(subject, camera_of(views, 1), kind, max(views.width, views.height), yes)
    expected = subject.run.picture(
        {name: value.cpu() for name, value in subject.run.module.render_view(views, 1).items()}, kind
    )
    torch.testing.assert_close(picture, expected, atol=2e-3, rtol=0)


def test_any_size_and_window(runs):
    subject = Subject(runs["on"])
    assert paint(subject, camera_of(subject.scene.test, aspect=2.0), "depth", 64, yes).shape == (32, 64, 3)
    assert paint(subject, camera_of(subject.scene.test, aspect=0.25), "rgb", 16, yes).shape == (16, 4, 3)


def test_it_stops_when_told(runs):
    subject, asked = Subject(runs["on"]), []
    camera = camera_of(subject.scene.test, aspect=1.0)

    def twice() -> bool:
        asked.append(True)
        return len(asked) <= 2

    assert paint(subject, camera, "rgb", 128, twice) is None
    assert len(asked) == 3 < 128 * 128 / CHUNK


@pytest.fixture(scope="module")
def anywhere(every):
    return [Subject(every[name]) for name in ("on", "forward", "splat")]


@settings(max_examples=30)
@given(
    st.integers(0, 2),
    st.integers(0, 10**6),
    st.sampled_from([0.0, 1.0, 30.0, 1e6]),
    st.floats(0.01, 3.1),
    st.floats(0.1, 10.0),
    st.sampled_from(KINDS),
)
def test_cameras_may_stand_anywhere(anywhere, which, seed, distance, fov, aspect, kind):
    """Also beside and behind a forward-facing scene, where normalised device coordinates do not reach."""
    rng = np.random.default_rng(seed)
    wxyz, place = np.roll(Rotation.random(rng=rng).as_quat(), 1), rng.uniform(-distance, distance, 3)
    camera = Camera(tuple(wxyz), tuple(place), fov, aspect)
    assert camera.usable()
    picture = paint(anywhere[which], camera, kind, 16, yes)
    assert torch.isfinite(picture).all()
    assert max(picture.shape[:2]) == 16


def test_behind_a_forward_facing_scene_there_is_nothing(forward_run):
    subject = Subject(forward_run)
    away = Camera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, 1.0)
    forward = Camera((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, 1.0)  # half a turn round x
    background = subject.run.module.decode(subject.run.module.transform.encode(torch.zeros(1, 3)))
    for camera, empty in ((away, True), (forward, False)):
        picture = paint(subject, camera, "rgb", 16, yes)
        assert torch.allclose(picture, background.detach().expand(16, 16, 3), atol=1e-5) == empty


@pytest.mark.parametrize("name", ["on", "splat"])
def test_the_background_is_any(every, name):
    subject = Subject(every[name])
    away = Camera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 30.0), 0.5, 1.0)  # sees nothing
    picture = paint(subject, away, "rgb", 4, background=(255, 0, 51))
    transform = subject.run.module.transform
    expected = transform.decode(transform.encode(torch.tensor([[1.0, 0.0, 0.2]]))).detach()
    torch.testing.assert_close(picture, expected.expand(4, 4, 3), atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", ["on", "forward", "splat"])
def test_a_crop_box_keeps_what_is_in_it(every, name):
    """All where it holds all, nothing where it is beside the scene, and in between what ends inside it."""
    subject = Subject(every[name])
    scene = subject.scene
    camera = camera_of(scene.test)
    height, width = camera.size(12)
    whole = subject.render(Shot(camera), height, width, yes)
    high = 3.0 * scene.far
    same = subject.render(Shot(camera, crop=((-high,) * 3, (high,) * 3)), height, width, yes)
    torch.testing.assert_close(same["rgb"], whole["rgb"], atol=1e-6, rtol=0)
    away = subject.render(Shot(camera, crop=((high,) * 3, (high + 1,) * 3)), height, width, yes)
    assert (away["depth"] == scene.far).all()

    # Half the scene, with the eye in it: rays begin where they did, those that end in the other half are left out.
    rays = camera.rays(height, width)
    x = (rays.origins + whole["depth"].flatten()[:, None] * rays.directions)[:, 0].view(height, width)
    side = max(camera.position[0], float(x.median()))
    part = subject.render(Shot(camera, crop=((-high,) * 3, (side, high, high))), height, width, yes)
    inside, outside = x < side - 1e-3, x > side + 1e-3
    torch.testing.assert_close(part["depth"][inside], whole["depth"][inside], atol=1e-5, rtol=0)
    assert inside.any()
    assert (part["depth"][outside] == scene.far).all()


def test_a_whole_picture_outside_the_crop_box_is_background(splat_run):
    subject = Subject(splat_run)
    camera = camera_of(subject.scene.test)
    rays, transform = camera.rays(12, 12), subject.run.module.transform
    middle = rays.origins[0] + 4.0 * rays.directions[66]
    crop = tuple((middle - 0.5).tolist()), tuple((middle + 0.5).tolist())
    shot = Shot(camera, background=(255, 0, 51))
    whole, part = (subject.render(each, 12, 12, yes) for each in (shot, shot._replace(crop=crop)))
    enter, leave = intersect_box(rays, torch.tensor(crop), 0.0, math.inf)
    depth = whole["depth"].flatten()
    inside = ((depth >= enter) & (depth <= leave)).view(12, 12)
    assert 5 < inside.sum() < 139
    behind = transform.encode(torch.tensor([[1.0, 0.0, 0.2]]))
    for name, value in {"latent": behind, "rgb": transform.decode(behind), "depth": subject.scene.far}.items():
        torch.testing.assert_close(part[name][inside], whole[name][inside])
        assert torch.allclose(part[name][~inside], torch.as_tensor(value))


def test_rays_begin_where_they_enter_the_crop_box(runs):
    """From outside, what stands before the box is cut away: depths in it are at least its distance."""
    subject = Subject(runs["on"])
    camera = camera_of(subject.scene.test)
    rays = camera.rays(12, 12)
    middle = rays.origins[0] + 4.0 * rays.directions[66]
    crop = tuple((middle - 0.5).tolist()), tuple((middle + 0.5).tolist())
    depth = subject.render(Shot(camera, crop=crop), 12, 12, yes)["depth"].flatten()
    enter, leave = intersect_box(rays, torch.tensor(crop), 0.0, math.inf)
    hit = leave > enter
    assert hit.any()
    assert (depth[~hit] == subject.scene.far).all()
    shown = hit & (depth != subject.scene.far)
    assert ((depth[shown] >= enter[shown]) & (depth[shown] <= leave[shown])).all()


def test_a_new_checkpoint_is_taken(compose, tmp_path):
    """A run that goes on, whose grid has grown meanwhile."""
    sizes = ("backbone.coarse=false", "backbone.steps_alone=12", "backbone.grow=[8]", "trainer.checkpoint_every=6")
    folder, early = tmp_path / "run", tmp_path / "early.ckpt"
    root = compose()["dataset"]["root"]
    arguments = ["dataset=blender", f"dataset.root={root}", "trainer=smoke", "ctm=on", *sizes]
    assert train([*arguments, f"hydra.run.dir={folder}"]) == 0
    late = tmp_path / "late.ckpt"
    shutil.copy(folder / LAST, late)
    shutil.copy(folder / "checkpoints" / "previous.ckpt", early)
    shutil.copy(early, folder / LAST)

    subject = Subject(folder)
    camera = camera_of(subject.scene.test)
    before = paint(subject, camera, "depth", 16, yes)
    assert (subject.run.step, subject.changed()) == (6, False)
    shutil.copy(late, folder / LAST)
    assert subject.changed()
    subject.refresh()
    after = paint(subject, camera, "depth", 16, yes)
    assert (subject.run.step, subject.changed(), subject.trouble) == (12, False, "")
    assert not torch.equal(before, after)
    fresh = Subject(folder)
    assert torch.equal(after, paint(fresh, camera, "depth", 16, yes))


def test_a_torn_checkpoint_changes_nothing_but_is_told(finished):
    subject = Subject(finished)
    camera = camera_of(subject.scene.test)
    before = paint(subject, camera, "rgb", 12, yes)
    path, kept = finished / LAST, (finished / LAST).read_bytes()
    for damaged in (kept[: len(kept) // 2], b"", b"no checkpoint"):
        path.write_bytes(damaged)
        assert subject.changed()
        subject.refresh()
        assert torch.equal(paint(subject, camera, "rgb", 12, yes), before)
        assert f"{path}: found an unreadable file" in subject.trouble
        assert not subject.changed()
    path.unlink()
    subject.refresh()
    assert torch.equal(paint(subject, camera, "rgb", 12, yes), before)
    path.write_bytes(kept)
    subject.refresh()
    assert torch.equal(paint(subject, camera, "rgb", 12, yes), before)
    assert subject.trouble == ""


def test_another_runs_checkpoint_is_told(finished, runs):
    subject = Subject(finished)
    camera = camera_of(subject.scene.test)
    before = paint(subject, camera, "rgb", 12, yes)
    shutil.copy(runs["off"] / LAST, finished / LAST)
    subject.refresh()
    assert torch.equal(paint(subject, camera, "rgb", 12, yes), before)
    assert "found another configuration (differs in ctm" in subject.trouble


def lacking(checkpoint):
    checkpoint["state_dict"].popitem()


def of_another_stage(checkpoint):
    checkpoint["dvgo"]["stage"] = "coarse"
    checkpoint["dvgo"]["box"][1] = math.nan


@pytest.mark.parametrize("damage", [lacking, of_another_stage])
def test_weights_that_do_not_fit_change_nothing_but_are_told(finished, damage):
    """Nor those among them that would fit, nor what is set before the rest is refused."""
    subject = Subject(finished)
    camera = camera_of(subject.scene.test)
    before = paint(subject, camera, "rgb", 12, yes)
    checkpoint = torch.load(finished / LAST, weights_only=True)
    good = copy.deepcopy(checkpoint)
    checkpoint["global_step"] = 61
    for value in checkpoint["state_dict"].values():
        if value.is_floating_point():
            value.add_(1)
    damage(checkpoint)
    torch.save(checkpoint, finished / LAST)
    subject.refresh()
    assert "weights that do not fit" in subject.trouble
    assert (subject.run.step, subject.changed(), subject.run.module.training) == (60, False, False)
    assert torch.equal(paint(subject, camera, "rgb", 12, yes), before)
    torch.save(good, finished / LAST)
    subject.refresh()
    assert subject.trouble == ""
    assert torch.equal(paint(subject, camera, "rgb", 12, yes), before)


def test_nothing_in_a_checkpoint_is_run(finished):
    """A pickle with code in it, as any but ``weights_only`` loading would run."""
    subject = Subject(finished)
    checkpoint = torch.load(finished / LAST, weights_only=True) | {"harm": Payload(finished / "harm")}
    torch.save(checkpoint, finished / LAST)
    subject.refresh()
    assert "unreadable" in subject.trouble
    assert not (finished / "harm").exists()
