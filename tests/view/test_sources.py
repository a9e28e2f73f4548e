"""What is painted of a run, finished or not, and of a photograph."""

import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from strangers import Payload

from ctm_plugin.cli import main as train
from ctm_plugin.color.light import Light
from ctm_plugin.rays.sampling import intersect_box
from ctm_plugin.runs.load import VIEW_KINDS
from ctm_plugin.runs.rundir import LAST
from ctm_plugin.scene.views import Views
from ctm_plugin.view.camera import BrowserCamera, view_camera
from ctm_plugin.view.painter import Stopped, Viewpoint
from ctm_plugin.view.sources import RAY_CHUNK, PhotographSource, Subject

HEIGHT, WIDTH = 24, 32


@pytest.fixture
def whole(runs):
    return runs["on"]


@pytest.fixture(scope="session")
def every(runs, forward_run, splat_run):
    return {**runs, "forward": forward_run, "splat": splat_run}


def render(subject: Subject, camera: BrowserCamera, height: int, width: int, check=lambda: None, **shot) -> dict:
    return subject.render(Viewpoint(camera, **shot), height, width, check)


def paint(subject: Subject, camera: BrowserCamera, kind: str, longest: int, check=lambda: None, **shot) -> torch.Tensor:
    shot = {"background": (255, 255, 255) if subject.scene.background == "white" else (0, 0, 0)} | shot
    rendered = render(subject, camera, *camera.size(longest), check, **shot)
    return subject.picture(rendered, kind, subject.run.light)


def camera_of(subject: Subject, index: int = 0, **changes) -> BrowserCamera:
    return replace(view_camera(subject.scene.test, index), **changes)


@pytest.mark.parametrize("name", ["on", "forward", "splat"])
@pytest.mark.parametrize("kind", VIEW_KINDS)
def test_at_a_test_view_it_is_what_evaluation_renders(every, name, kind):
    subject = Subject(every[name])
    views = subject.scene.test
    picture = paint(subject, camera_of(subject, 1), kind, max(views.width, views.height))
    expected = subject.run.picture(
        {name: value.cpu() for name, value in subject.run.module.render_view(views, 1).items()}, kind
    )
    torch.testing.assert_close(picture, expected, atol=2e-3, rtol=0)


def test_it_stops_when_told(runs):
    subject, asked = Subject(runs["on"]), []
    camera = camera_of(subject, aspect=1.0)

    def twice() -> None:
        asked.append(True)
        if len(asked) > 2:
            raise Stopped

    with pytest.raises(Stopped):
        paint(subject, camera, "rgb", 128, twice)
    assert len(asked) == 3 < 128 * 128 / RAY_CHUNK


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
    st.sampled_from(VIEW_KINDS),
)
def test_cameras_may_stand_anywhere(anywhere, which, seed, distance, fov, aspect, kind):
    """Also beside and behind a forward-facing scene, where normalised device coordinates do not reach."""
    rng = np.random.default_rng(seed)
    wxyz, place = np.roll(Rotation.random(rng=rng).as_quat(), 1), rng.uniform(-distance, distance, 3)
    camera = BrowserCamera(tuple(wxyz), tuple(place), fov, aspect)
    assert camera.usable()
    picture = paint(anywhere[which], camera, kind, 16)
    assert torch.isfinite(picture).all()
    assert max(picture.shape[:2]) == 16


def test_behind_a_forward_facing_scene_there_is_nothing(forward_run):
    subject = Subject(forward_run)
    away = BrowserCamera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, 1.0)
    forward = BrowserCamera((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, 1.0)  # half a turn round x
    background = subject.run.module.decode(subject.run.module.transform.encode(torch.zeros(1, 3)))
    for camera, empty in ((away, True), (forward, False)):
        picture = paint(subject, camera, "rgb", 16)
        assert torch.allclose(picture, background.detach().expand(16, 16, 3), atol=1e-5) == empty


@pytest.mark.parametrize("name", ["on", "splat"])
def test_the_background_is_any(every, name):
    subject = Subject(every[name])
    away = BrowserCamera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 30.0), 0.5, 1.0)  # sees nothing
    picture = paint(subject, away, "rgb", 4, background=(255, 0, 51))
    transform = subject.run.module.transform
    expected = transform.decode(transform.encode(torch.tensor([[1.0, 0.0, 0.2]]))).detach()
    torch.testing.assert_close(picture, expected.expand(4, 4, 3), atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", ["on", "forward", "splat"])
def test_a_crop_box_keeps_what_is_in_it(every, name):
    """All where it holds all, nothing where it is beside the scene, and in between what ends inside it."""
    subject = Subject(every[name])
    scene = subject.scene
    camera = camera_of(subject)
    height, width = camera.size(12)
    whole = render(subject, camera, height, width)
    high = 3.0 * scene.far
    same = render(subject, camera, height, width, crop=((-high,) * 3, (high,) * 3))
    torch.testing.assert_close(same["rgb"], whole["rgb"], atol=1e-6, rtol=0)
    away = render(subject, camera, height, width, crop=((high,) * 3, (high + 1,) * 3))
    assert (away["depth"] == scene.far).all()

    # Half the scene, with the eye in it: rays begin where they did, those that end in the other half are left out.
    rays = camera.rays(height, width)
    x = (rays.origins + whole["depth"].flatten()[:, None] * rays.directions)[:, 0].view(height, width)
    side = max(camera.position[0], float(x.median()))
    part = render(subject, camera, height, width, crop=((-high,) * 3, (side, high, high)))
    inside, outside = x < side - 1e-3, x > side + 1e-3
    torch.testing.assert_close(part["depth"][inside], whole["depth"][inside], atol=1e-5, rtol=0)
    assert inside.any()
    assert (part["depth"][outside] == scene.far).all()


@pytest.mark.parametrize("name", ["on", "splat"])
def test_outside_of_a_small_crop_box_is_background(every, name):
    """Before and behind it, too: what is shown lies in it. Rays through a field begin where they enter it."""
    subject = Subject(every[name])
    camera, module, far = camera_of(subject), subject.run.module, subject.scene.far
    rays = camera.rays(12, 12)
    middle = rays.origins[0] + 4.0 * rays.directions[66]
    crop = tuple((middle - 0.5).tolist()), tuple((middle + 0.5).tolist())
    whole, part = (render(subject, camera, 12, 12, background=(255, 0, 51), crop=each) for each in (None, crop))
    enter, leave = (each.view(12, 12) for each in intersect_box(rays, torch.tensor(crop), 0.0, math.inf))
    inside = (part["depth"] >= enter) & (part["depth"] <= leave)
    if name == "splat":
        assert torch.equal(inside, (whole["depth"] >= enter) & (whole["depth"] <= leave))
        torch.testing.assert_close(part["rgb"][inside], whole["rgb"][inside])
    assert 5 < inside.sum() < 139
    behind = module.transform.encode(torch.tensor([[1.0, 0.0, 0.2]]))
    for name, value in {"latent": behind, "rgb": module.decode(behind), "depth": torch.tensor(far)}.items():
        assert torch.allclose(part[name][~inside], value.detach())


def test_a_new_checkpoint_is_taken(compose, tmp_path):
    """A run that goes on, whose grid has grown meanwhile."""
    sizes = ("backbone.coarse=false", "backbone.steps_alone=12", "backbone.grow=[8]", "trainer.checkpoint_every=6")
    folder, early, late = tmp_path / "run", tmp_path / "run/checkpoints/previous.ckpt", tmp_path / "late.ckpt"
    arguments = ["dataset=blender", f"dataset.root={compose()['dataset']['root']}", "trainer=smoke", "ctm=on", *sizes]
    assert train([*arguments, f"hydra.run.dir={folder}"]) == 0
    shutil.copy(folder / LAST, late)
    shutil.copy(early, folder / LAST)
    subject = Subject(folder)
    before = paint(subject, camera_of(subject), "depth", 16)
    assert (subject.run.step, subject.refresh()) == (6, False)
    shutil.copy(late, folder / LAST)
    assert (subject.refresh(), subject.run.step, subject.trouble) == (True, 12, "")
    after = paint(subject, camera_of(subject), "depth", 16)
    assert not torch.equal(before, after)
    assert torch.equal(after, paint(Subject(folder), camera_of(subject), "depth", 16))


def torn(path, checkpoint):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def lacking(path, checkpoint):
    checkpoint["state_dict"].popitem()
    torch.save(checkpoint, path)


def of_another_stage(path, checkpoint):
    """Nor is kept what is set before the rest is refused."""
    checkpoint["dvgo"]["stage"] = "coarse"
    checkpoint["dvgo"]["box"][1] = math.nan
    torch.save(checkpoint, path)


def harmful(path, checkpoint):
    """A pickle with code in it, as any but ``weights_only`` loading would run."""
    torch.save(checkpoint | {"harm": Payload(path.parent / "harm")}, path)


@pytest.mark.parametrize(
    ("damage", "trouble"),
    [
        (torn, "found an unreadable file"),
        (lambda path, _: path.write_bytes(b""), "found an unreadable file"),
        (lambda path, _: path.write_bytes(b"no checkpoint"), "found an unreadable file"),
        (lacking, "weights that do not fit"),
        (of_another_stage, "weights that do not fit"),
        (harmful, "unreadable"),
        (lambda path, _: shutil.copy(path.parents[2] / "off" / LAST, path), "found another configuration (differs in"),
    ],
)
def test_a_checkpoint_that_cannot_be_used_changes_nothing_but_is_told(finished, runs, damage, trouble):
    path, subject = finished / LAST, Subject(finished)
    shutil.copytree(runs["off"], finished.parent / "off", dirs_exist_ok=True)
    before, kept = paint(subject, camera_of(subject), "rgb", 12), path.read_bytes()
    checkpoint = torch.load(path, weights_only=True)
    checkpoint["global_step"] = 61
    for value in checkpoint["state_dict"].values():
        if value.is_floating_point():
            value.add_(1)
    damage(path, checkpoint)
    assert subject.refresh()
    assert trouble in subject.trouble
    assert (subject.run.step, subject.refresh(), subject.run.module.training) == (60, False, False)
    assert torch.equal(paint(subject, camera_of(subject), "rgb", 12), before)
    assert not (path.parent / "harm").exists()
    path.unlink()
    assert not subject.refresh()
    path.write_bytes(kept)
    assert (subject.refresh(), subject.trouble) == (True, "")
    assert torch.equal(paint(subject, camera_of(subject), "rgb", 12), before)


def photograph(distortion: torch.Tensor | None = None) -> PhotographSource:
    """A picture that is smooth: x in red, y in green."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    image = torch.stack([x / WIDTH, y / HEIGHT, torch.full_like(x, 0.5)], dim=-1)[None]
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    c2w = torch.from_numpy(np.column_stack([turn, [1.0, 2.0, 3.0]])).float()[None]
    lens = torch.tensor([[30.0, 30.0, WIDTH / 2, HEIGHT / 2]])
    return PhotographSource("a view", Views(image, c2w, lens, ("a view",), distortion=distortion), 0, torch.zeros(1, 3))


def seen(of: PhotographSource, camera: BrowserCamera, height: int = HEIGHT, width: int = WIDTH) -> torch.Tensor:
    return of.render(Viewpoint(camera), height, width, lambda: None)["rgb"]


def test_from_its_own_camera_it_is_itself():
    of = photograph()
    picture = seen(of, of.camera)
    torch.testing.assert_close(picture, of.views.images[0], atol=1e-4, rtol=0)


def test_a_wider_window_has_black_beside_it():
    of = photograph()
    camera = of.camera
    picture = seen(of, replace(camera, aspect=2 * camera.aspect), HEIGHT, 2 * WIDTH)
    torch.testing.assert_close(picture[:, WIDTH // 2 : -WIDTH // 2], of.views.images[0], atol=1e-4, rtol=0)
    assert not picture[:, : WIDTH // 2 - 1].any()


def test_it_turns_with_the_camera():
    """Turned to the right by a pixel's angle, the middle shows what was a pixel to the right of it."""
    of = photograph()
    camera = of.camera
    c2w = of.views.c2w[0].double().numpy()
    turn = Rotation.from_rotvec(-np.arctan(1 / 30) * c2w[:, 1]).as_matrix()
    turned = BrowserCamera.of(np.column_stack([turn @ c2w[:, :3], c2w[:, 3]]), camera.fov, camera.aspect)
    middle = seen(of, turned)[HEIGHT // 2, WIDTH // 2 - 1]
    torch.testing.assert_close(middle, of.views.images[0, HEIGHT // 2, WIDTH // 2], atol=2e-3, rtol=0)


def test_from_elsewhere_it_stays_as_taken():
    of = photograph()
    camera = of.camera
    away = replace(camera, position=(9.0, 9.0, 9.0), wxyz=(1.0, 0.0, 0.0, 0.0))
    assert of.seen_from(camera)
    assert not of.seen_from(away)
    torch.testing.assert_close(seen(of, away), of.views.images[0], atol=1e-4, rtol=0)


def test_what_lies_behind_is_black():
    of = photograph()
    camera = of.camera
    back = (Rotation.from_quat(np.roll(camera.wxyz, -1)) * Rotation.from_rotvec([0, np.pi, 0])).as_quat()
    assert not seen(of, replace(camera, wxyz=tuple(np.roll(back, 1)))).any()


def test_lenses_are_undone():
    """A straight pinhole's pixel shows what the lens imaged there: ``r' = r (1 + k1 r^2)``."""
    k1 = 0.2
    of = photograph(torch.tensor([[k1, 0.0, 0.0, 0.0, 0.0]]))
    picture = seen(of, of.camera)
    u = (torch.arange(WIDTH) + 0.5 - WIDTH / 2) / 30
    v = 0.5 / 30  # half a pixel below the axis
    expected = (30 * u * (1 + k1 * (u**2 + v**2)) + WIDTH / 2) / WIDTH
    inside = (expected > 1 / WIDTH) & (expected < 1 - 1 / WIDTH)
    torch.testing.assert_close(picture[HEIGHT // 2, inside, 0], expected[inside], atol=1e-4, rtol=0)


@pytest.mark.parametrize(("kind", "lifted"), [("rgb", False), ("lit", True), ("latent", True), ("depth", True)])
def test_it_is_lifted_unless_the_run_is_not(kind, lifted):
    of = photograph()
    rendered = of.render(Viewpoint(of.camera), 6, 8, lambda: None)
    picture = of.picture(rendered, kind, Light(3.0, 1.2))
    assert torch.equal(picture, Light(3.0, 1.2).apply(rendered["rgb"]) if lifted else rendered["rgb"])
