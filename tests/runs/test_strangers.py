"""Run directories and files from strangers: nothing in them runs, and nothing outside them is read or written."""

import json
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from mutations import LAUGHS, Payload, put

from ctm_plugin import __version__, cli
from ctm_plugin.errors import CheckpointError, CTMError, DataError
from ctm_plugin.metrics.lpips import feature_network
from ctm_plugin.metrics.lpips_weights import MOST, load_lpips
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.load import restore
from ctm_plugin.runs.rundir import CONFIG, LAST, METRICS, check_tensors, load_config, save_config
from ctm_plugin.runs.safe_read import check_folder, read_yaml
from ctm_plugin.runs.train import resume, train


@pytest.fixture
def config(compose):
    return compose("backbone.steps_alone=2", "backbone.coarse=false", "backbone.grow=[]", "ctm=off")


@pytest.fixture
def stranger(config, tmp_path) -> Path:
    """A run that was begun and has no checkpoint."""
    save_config(tmp_path / "stranger", config)
    return tmp_path / "stranger"


@pytest.fixture(scope="module")
def whole(compose, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("whole") / "run"
    train(compose("backbone.steps_alone=2", "backbone.coarse=false", "backbone.grow=[]", "ctm=off"), run)
    return run


@pytest.fixture
def secret(tmp_path) -> Path:
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "key.txt").write_text("the secret")
    return tmp_path / "secret"


def refused(run: Path, *said: str) -> None:
    """Resumed, scored or rendered, a run ends in the same error."""
    for do in (lambda: resume(run), lambda: load_config(run)):
        with pytest.raises(CTMError) as error:
            do()
        for each in said:
            assert each in str(error.value)
    for verb in ("evaluate", "render"):
        assert cli.main([verb, str(run)]) == 1


@pytest.mark.parametrize("group", ["dataset", "backbone", "ctm", "color_space", "loss"])
@pytest.mark.parametrize(
    "name", ["os.system", "os:system", "ctm_plugin.data.blender:BlenderConfig", "../../x", "__class__"]
)
def test_a_name_is_looked_up_and_nothing_else(stranger, group, name):
    put(stranger / CONFIG, f"{group}.{'kind' if group == 'loss' else 'name'}", name)
    with pytest.raises(CTMError) as error:
        resume(stranger)
    assert name in str(error.value)


@pytest.mark.parametrize("group", ["dataset", "backbone", "loss", "trainer", "metrics"])
def test_a_target_is_an_unknown_key(stranger, tmp_path, group):
    put(stranger / CONFIG, f"{group}._target_", "os.system")
    put(stranger / CONFIG, f"{group}._args_", [f"touch {tmp_path / 'touched'}"])
    with pytest.raises(CTMError, match=rf"{group}\._(target|args)_"):
        resume(stranger)
    assert not (tmp_path / "touched").exists()


@pytest.mark.parametrize("text", ["${oc.env:HOME}", "${oc.decode:'[1]'}", "${by_geometry:1,2}", "a${seed}", "${seed"])
@pytest.mark.parametrize("key", ["dataset.root", "backbone.grow", "seed", "trainer.budget"])
def test_interpolations_are_refused(stranger, text, key):
    put(stranger / CONFIG, key, [[text]] if key.endswith("grow") else text)
    refused(stranger, f"{CONFIG}: found an interpolation at {key}")


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.system ['touch touched']", "a: !!python/name:os.system", "a: !!python/module:os",
        "a: !!timestamp x", "a: !!bool x", "a: !!int ''", "a: !!set {b}", "a: !unknown b", "a: 2001-99-99",
        "a: &a [*a]", LAUGHS, "[" * 2000, "{a: " * 2000, "[" * 200_000 + "]" * 200_000,
        "\n".join(" " * depth + "a:" for depth in range(2000)), "a: " + "1" * 5000, "a: *b", "a: \x00",
    ],
)  # fmt: skip
def test_yaml_beyond_plain_values(stranger, tmp_path, monkeypatch, text):
    """Tags make objects (or crash YAML's own parser), aliases make gigabytes of a few lines, or circles."""
    monkeypatch.chdir(tmp_path)
    (stranger / CONFIG).write_text(text)
    refused(stranger, f"{CONFIG}: found no readable YAML")
    (stranger / METRICS).write_text("{}")
    assert cli.main(["report", str(stranger)]) == 1
    assert not (tmp_path / "touched").exists()


def test_keys_that_are_no_text(stranger):
    put(stranger / CONFIG, "backbone.grow", {1: 2})
    refused(stranger, f"{CONFIG}: found a key that is no text in backbone.grow")


def test_what_runs_are_saved_with_is_plain(config, tmp_path):
    odd = {
        "text": ["on", "1e-3", "2001-01-01", "~", "*a", "&b", "!c", "é\n"],
        "number": [1e-5, 10**20, -0.0, 1e300, None],
    }
    for number, saved in enumerate((config, {**config, "metrics": odd})):
        save_config(tmp_path / str(number), saved)
        expected = {"version": __version__, **json.loads(json.dumps(saved))}
        assert read_yaml(tmp_path / str(number) / CONFIG) == expected


# Files that unpickle.


def payload_files(folder: Path, payload: Payload) -> dict[str, Path]:
    features = {f"features.{name}": value for name, value in feature_network("alex").state_dict().items()}
    torch.save(payload, folder / "bare.pth")
    torch.save(features | {"features.0.weight": payload}, folder / "inside.pth")
    torch.save(features | {"features.0.weight": payload}, folder / "old.pth", _use_new_zipfile_serialization=False)
    arrays = {name: value.numpy() for name, value in features.items()}
    arrays["features.0.weight"] = np.array([payload], dtype=object)
    np.savez(folder / "a.npz", **arrays)
    return {path.name: path for path in folder.iterdir() if path.is_file()}


@pytest.mark.parametrize("name", ["bare.pth", "inside.pth", "old.pth", "a.npz"])
def test_code_in_weights_of_lpips_does_not_run(tmp_path, name):
    path = payload_files(tmp_path, Payload(tmp_path / "touched"))[name]
    with pytest.raises(DataError, match=f"{name}: found an unreadable file"):
        load_lpips(path, "alex")
    assert not (tmp_path / "touched").exists()
    if name == "a.npz":
        np.load(path, allow_pickle=True)["features.0.weight"]
    else:
        torch.load(path, weights_only=False)
    assert (tmp_path / "touched").exists()  # it would have


@pytest.mark.parametrize("name", ["w.npz", "w.pth"])
def test_weights_that_are_small_only_when_packed(tmp_path, name):
    with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("features.0.weight.npy", b"x")
        archive.infolist()[0].file_size = MOST + 1
    with pytest.raises(DataError, match=rf"{name}: found an unreadable file \(BadZipFile\)"):
        load_lpips(tmp_path / name, "alex")


def test_a_checkpoint_that_is_small_only_when_packed(finished):
    with zipfile.ZipFile(finished / LAST) as old, zipfile.ZipFile(finished / "new", "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name) + bytes(100_000))
    os.replace(finished / "new", finished / LAST)
    with pytest.raises(CheckpointError, match=r"last.ckpt: found an unreadable file \(BadZipFile\)"):
        resume(finished)


@pytest.mark.parametrize("tensor", [torch.zeros(1).expand(2**40), torch.sparse_coo_tensor([[0]], [1.0], (2**40,))])
def test_a_tensor_that_claims_more_than_is_stored(finished, tensor):
    saved = torch.load(finished / LAST, weights_only=True)
    saved["optimizer_states"][0]["mlp"]["state"][0]["exp_avg"] = tensor
    torch.save(saved, finished / LAST)
    with pytest.raises(CheckpointError, match=r"last.ckpt: found a tensor \[1099511627776\] that is not stored whole"):
        resume(finished)


def test_a_checkpoint_with_a_circle_in_it():
    circle = [torch.zeros(2)]
    circle.append({"a": circle})
    check_tensors(circle, Path("x"))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("shape", [100_000] * 3, "a table of shape"),
        ("shape", [-1, -1, 8], "a table of shape"),
        ("shape", "abc", "weights that do not fit"),
        ("stage", "final", "stage 'final'"),
        ("grown", 10**9, "grown 1000000000 times"),
        ("box", torch.full((2, 3), float("nan")), "a box"),
        ("box", torch.zeros(2, 3), "a box"),
        ("box", "x", "weights that do not fit"),
    ],
)  # fmt: skip
def test_a_field_larger_than_its_file(finished, key, value, message):
    saved = torch.load(finished / LAST, weights_only=True)
    saved["dvgo"][key] = value
    torch.save(saved, finished / LAST)
    with pytest.raises(CheckpointError, match=r"last.ckpt: found weights that do not fit") as error:
        resume(finished)
    assert message in str(error.value)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda saved: saved.pop("optimizer_states"),
        lambda saved: saved.update(optimizer_states=[{}]),
        lambda saved: saved.update(loops=3),
        lambda saved: saved["optimizer_states"][0]["mlp"]["state"][0].update(exp_avg=torch.zeros(3)),
    ],
)
def test_a_state_that_cannot_be_restored(finished, spoil):
    saved = torch.load(finished / LAST, weights_only=True)
    spoil(saved)
    torch.save(saved, finished / LAST)
    with pytest.raises(CheckpointError, match=r"last.ckpt: found a state that cannot be restored"):
        resume(finished)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda saved: saved.update(callbacks={"Stopwatch": {}}),
        lambda saved: saved.update(callbacks=[]),
        lambda saved: saved.update(state_dict=[]),
        lambda saved: saved.update(batches_seen="3"),
        lambda saved: saved.pop("global_step"),
    ],
)
def test_a_checkpoint_of_another_kind(finished, spoil, capsys):
    saved = torch.load(finished / LAST, weights_only=True)
    spoil(saved)
    torch.save(saved, finished / LAST)
    assert cli.main(["evaluate", str(finished)]) == 1
    assert "last.ckpt: found a file of another kind, expected a checkpoint of ctm_plugin" in capsys.readouterr().err


def test_weights_that_are_no_numbers(finished):
    saved = torch.load(finished / LAST, weights_only=True)
    saved["state_dict"]["mlp.layers.0.weight"][0, 0] = torch.nan
    torch.save(saved, finished / LAST)
    with pytest.raises(CheckpointError, match=r"last.ckpt: found .* \(NaN or infinity in mlp.layers.0.weight\)"):
        resume(finished)


# Out of the run.


@pytest.mark.parametrize(
    "name", [LAST, "checkpoints", "tensorboard", "lit", "lit/r_0.png", METRICS, CONFIG, "error.txt"]
)
def test_links_out_of_a_run_are_not_followed(finished, secret, name):
    path = finished / name
    if path.exists():
        path.rename(secret / path.name)
    path.symlink_to(secret / path.name)
    before = {each: each.read_bytes() for each in secret.rglob("*") if each.is_file()}
    expected = rf"{name}: found a link to {secret / path.name}, expected nothing that leads out of the run"
    with pytest.raises(CheckpointError, match=expected):
        resume(finished)
    assert cli.main(["report", str(finished), f"out={finished.parent / 'report.md'}"]) == 1
    assert not (finished.parent / "report.md").exists()
    assert {each: each.read_bytes() for each in secret.rglob("*") if each.is_file()} == before


def test_links_inside_a_run_and_circles(finished):
    (finished / "again").symlink_to("test")
    check_folder(finished)
    (finished / "round").symlink_to("round")
    with pytest.raises(CheckpointError, match="round: found a link to round"):
        check_folder(finished)


@pytest.mark.parametrize("name", [METRICS, "lit/pipe.png", "tensorboard/events.out.tfevents.1"])
def test_a_pipe_in_a_run(finished, name):
    (finished / name).unlink(missing_ok=True)
    os.mkfifo(finished / name)
    with pytest.raises(CheckpointError, match=f"{name}: found something that is not a file"):
        resume(finished)
    assert cli.main(["report", str(finished)]) == 1


def test_what_the_machine_refuses_is_no_fault_of_the_checkpoint(finished, monkeypatch):
    def refuse(self, trainer):
        raise torch.OutOfMemoryError("none left")

    monkeypatch.setattr("lightning.pytorch.strategies.SingleDeviceStrategy.setup", refuse)
    with pytest.raises(torch.OutOfMemoryError, match="none left"):
        resume(finished)


def test_a_plug_in_may_keep_what_is_infinite_in_a_buffer(config):
    """What may be saved may be read back: parameters alone have to be finite."""
    parts = assemble(config)
    parts.backbone.transform = parts.attach.transform
    parts.backbone.register_buffer("best", torch.tensor(float("inf")))
    checkpoint = {"state_dict": parts.backbone.state_dict()}
    parts.backbone.on_save_checkpoint(checkpoint)
    restore(parts, checkpoint, Path("last.ckpt"))
