"""What is painted of a run, finished or not."""

import copy
import math
import shutil

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import Payload
from scipy.spatial.transform import Rotation

from ctm_plugin.cli import main as train
from ctm_plugin.runs.load import KINDS, load_run
from ctm_plugin.runs.rundir import LAST
from ctm_plugin.scene.views import Views
from ctm_plugin.view.camera import OPENGL, Camera
from ctm_plugin.view.live_run import CHUNK, Subject


@pytest.fixture
def whole(runs):
    return runs["on"]


def yes() -> bool:
    return True


def camera_of(views: Views, index: int = 0, aspect: float | None = None) -> Camera:
    """The camera of a view whose axis goes through its middle."""
    c2w, (_, fy, _, _) = views.c2w[index].double().numpy(), views.intrinsics[index].tolist()
    wxyz = np.roll(Rotation.from_matrix(c2w[:, :3] * OPENGL).as_quat(), 1)
    fov = 2 * math.atan(views.height / (2 * fy))
    return Camera(tuple(wxyz), tuple(c2w[:, 3]), fov, aspect or views.width / views.height)


@pytest.mark.parametrize("name", ["on", "forward"])
@pytest.mark.parametrize("kind", KINDS)
def test_at_a_test_view_it_is_what_evaluation_renders(runs, forward_run, name, kind):
    subject = Subject({**runs, "forward": forward_run}[name])
    views = subject.scene.test
    picture = subject.paint(camera_of(views, 1), kind, max(views.width, views.height), yes)
    expected = subject.run.picture(
        {name: value.cpu() for name, value in subject.run.module.render_view(views, 1).items()}, kind
    )
    torch.testing.assert_close(picture, expected, atol=2e-3, rtol=0)


def test_kinds_differ(runs):
    subject = Subject(runs["on"])
    camera = camera_of(subject.scene.test)
    pictures = [subject.paint(camera, kind, 12, yes) for kind in KINDS]
    assert len({picture.numpy().tobytes() for picture in pictures}) == 4
    rgb, lifted = pictures[0], pictures[1]
    assert lifted.mean() > rgb.mean() + 0.01


def test_any_size_and_window(runs):
    subject = Subject(runs["on"])
    assert subject.paint(camera_of(subject.scene.test, aspect=2.0), "depth", 64, yes).shape == (32, 64, 3)
    assert subject.paint(camera_of(subject.scene.test, aspect=0.25), "rgb", 16, yes).shape == (16, 4, 3)


def test_it_stops_when_told(runs):
    subject, asked = Subject(runs["on"]), []
    camera = camera_of(subject.scene.test, aspect=1.0)

    def twice() -> bool:
        asked.append(True)
        return len(asked) <= 2

    assert subject.paint(camera, "rgb", 128, twice) is None
    assert len(asked) == 3 < 128 * 128 / CHUNK


@pytest.fixture(scope="module")
def anywhere(runs, forward_run):
    return [Subject(runs["on"]), Subject(forward_run)]


@settings(max_examples=30)
@given(
    st.integers(0, 1),
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
    picture = anywhere[which].paint(camera, kind, 16, yes)
    assert torch.isfinite(picture).all()
    assert max(picture.shape[:2]) == 16


def test_behind_a_forward_facing_scene_there_is_nothing(forward_run):
    subject = Subject(forward_run)
    away = Camera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, 1.0)
    forward = Camera((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, 1.0)  # half a turn round x
    background = subject.run.module.decode(subject.run.module.transform.encode(torch.zeros(1, 3)))
    for camera, empty in ((away, True), (forward, False)):
        picture = subject.paint(camera, "rgb", 16, yes)
        assert torch.allclose(picture, background.detach().expand(16, 16, 3), atol=1e-5) == empty


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
    before = subject.paint(camera, "depth", 16, yes)
    assert (subject.run.step, subject.changed()) == (6, False)
    shutil.copy(late, folder / LAST)
    assert subject.changed()
    subject.refresh()
    after = subject.paint(camera, "depth", 16, yes)
    assert (subject.run.step, subject.changed(), subject.trouble) == (12, False, "")
    assert not torch.equal(before, after)
    fresh = Subject(folder)
    assert torch.equal(after, fresh.paint(camera, "depth", 16, yes))


def test_a_torn_checkpoint_changes_nothing_but_is_told(finished):
    subject = Subject(finished)
    camera = camera_of(subject.scene.test)
    before = subject.paint(camera, "rgb", 12, yes)
    path, kept = finished / LAST, (finished / LAST).read_bytes()
    for damaged in (kept[: len(kept) // 2], b"", b"no checkpoint"):
        path.write_bytes(damaged)
        assert subject.changed()
        subject.refresh()
        assert torch.equal(subject.paint(camera, "rgb", 12, yes), before)
        assert f"{path}: found an unreadable file" in subject.trouble
        assert not subject.changed()
    path.unlink()
    subject.refresh()
    assert torch.equal(subject.paint(camera, "rgb", 12, yes), before)
    path.write_bytes(kept)
    subject.refresh()
    assert torch.equal(subject.paint(camera, "rgb", 12, yes), before)
    assert subject.trouble == ""


def test_another_runs_checkpoint_is_told(finished, runs):
    subject = Subject(finished)
    camera = camera_of(subject.scene.test)
    before = subject.paint(camera, "rgb", 12, yes)
    shutil.copy(runs["off"] / LAST, finished / LAST)
    subject.refresh()
    assert torch.equal(subject.paint(camera, "rgb", 12, yes), before)
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
    before = subject.paint(camera, "rgb", 12, yes)
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
    assert torch.equal(subject.paint(camera, "rgb", 12, yes), before)
    torch.save(good, finished / LAST)
    subject.refresh()
    assert subject.trouble == ""
    assert torch.equal(subject.paint(camera, "rgb", 12, yes), before)


def test_nothing_in_a_checkpoint_is_run(finished):
    """A pickle with code in it, as any but ``weights_only`` loading would run."""
    subject = Subject(finished)
    checkpoint = torch.load(finished / LAST, weights_only=True) | {"harm": Payload(finished / "harm")}
    torch.save(checkpoint, finished / LAST)
    subject.refresh()
    assert "unreadable" in subject.trouble
    assert not (finished / "harm").exists()


def test_the_run_is_as_evaluation_loads_it(runs):
    parts, _, checkpoint = load_run(runs["on"])
    subject = Subject(runs["on"])
    assert subject.run.step == checkpoint["global_step"] == 60
    ours, theirs = subject.run.module.state_dict(), parts.backbone.state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
