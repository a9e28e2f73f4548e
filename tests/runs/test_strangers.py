"""Run directories and files from strangers: nothing in them runs."""

import json
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from strangers import Payload, put

from ctm_plugin import __version__, cli
from ctm_plugin.errors import CheckpointError, CTMError, DataError
from ctm_plugin.metrics.lpips import feature_network
from ctm_plugin.metrics.lpips_weights import MAX_BYTES, load_lpips
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.load import restore
from ctm_plugin.runs.rundir import CONFIG, LAST, load_config, read_yaml, save_config
from ctm_plugin.runs.train import resume


@pytest.fixture(scope="module")
def config(compose):
    return compose("backbone.steps_alone=2", "backbone.coarse=false", "backbone.grow=[]", "ctm=off")


@pytest.fixture
def stranger(config, tmp_path) -> Path:
    """A run that was begun and has no checkpoint."""
    save_config(tmp_path / "stranger", config)
    return tmp_path / "stranger"


@pytest.mark.parametrize("group", ["dataset", "backbone", "ctm", "color_space", "loss"])
def test_a_name_is_looked_up_and_nothing_else(stranger, tmp_path, group):
    key = f"{group}.{'kind' if group == 'loss' else 'name'}"
    for name in ("os.system", "ctm_plugin.data.blender:BlenderConfig", "../../x", "__class__"):
        put(stranger / CONFIG, key, name)
        with pytest.raises(CTMError, match=name):
            resume(stranger)
    put(stranger / CONFIG, f"{group}._target_", "os.system")
    with pytest.raises(CTMError):
        resume(stranger)


@pytest.mark.parametrize("text", ["${oc.env:HOME}", "${by_geometry:1,2}", "${seed"])
@pytest.mark.parametrize("key", ["dataset.root", "backbone.grow", "seed"])
def test_interpolations_are_refused(stranger, text, key):
    put(stranger / CONFIG, key, [[text]] if key.endswith("grow") else text)
    with pytest.raises(CheckpointError, match=f"{CONFIG}: found an interpolation at {key}"):
        load_config(stranger)


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.system ['touch touched']", "a: !!python/name:os.system", "a: !!bool x",
        "a: !!int ''", "a: !unknown b", "a: 2001-99-99", "a: &a [*a]", "a: [", "a: *b", "a: \x00", "\xff",
        "a: " + "1" * 5000,
    ],
)  # fmt: skip
def test_yaml_beyond_plain_values(stranger, tmp_path, monkeypatch, text):
    """Tags make objects, or crash YAML's own parser."""
    monkeypatch.chdir(tmp_path)
    (stranger / CONFIG).write_bytes(text.encode("latin-1"))
    with pytest.raises(CheckpointError, match=f"{CONFIG}: found no readable YAML"):
        load_config(stranger)
    assert not (tmp_path / "touched").exists()


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "nothing, expected a mapping"),
        ("[1, 2]", "a list, expected a mapping"),
        (f"version: {__version__}\nseed: 0", "nothing for dataset"),
        ("a: {1: 2}", "a key that is no text in a"),
    ],
)
def test_plain_values_of_another_kind(stranger, text, found):
    (stranger / CONFIG).write_text(text)
    for verb in ("evaluate", "render"):
        assert cli.main([verb, str(stranger)]) == 1
    with pytest.raises(CheckpointError, match=f"{CONFIG}: found {found}"):
        resume(stranger)


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


def payload_files(folder: Path, payload: Payload) -> None:
    features = {f"features.{name}": value for name, value in feature_network("alex").state_dict().items()}
    torch.save(features | {"features.0.weight": payload}, folder / "inside.pth")
    torch.save(features | {"features.0.weight": payload}, folder / "old.pth", _use_new_zipfile_serialization=False)
    arrays = {name: value.numpy() for name, value in features.items()}
    arrays["features.0.weight"] = np.array([payload], dtype=object)
    np.savez(folder / "a.npz", **arrays)


def test_code_in_weights_of_lpips_does_not_run(tmp_path):
    payload_files(tmp_path, Payload(tmp_path / "touched"))
    for name in ("inside.pth", "old.pth", "a.npz"):
        with pytest.raises(DataError, match=f"{name}: found an unreadable file"):
            load_lpips(tmp_path / name, "alex")
    assert not (tmp_path / "touched").exists()
    torch.load(tmp_path / "inside.pth", weights_only=False)
    assert (tmp_path / "touched").exists()  # it would have


@pytest.mark.parametrize("name", ["w.npz", "w.pth"])
def test_weights_that_are_small_only_when_packed(tmp_path, name):
    with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("features.0.weight.npy", b"x")
        archive.infolist()[0].file_size = MAX_BYTES + 1
    with pytest.raises(DataError, match=rf"{name}: found an unreadable file \(BadZipFile\)"):
        load_lpips(tmp_path / name, "alex")


def test_a_checkpoint_that_is_small_only_when_packed(finished):
    with zipfile.ZipFile(finished / LAST) as old, zipfile.ZipFile(finished / "new", "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name) + bytes(100_000))
    os.replace(finished / "new", finished / LAST)
    with pytest.raises(CheckpointError, match=r"last.ckpt: found an unreadable file \(BadZipFile\)"):
        resume(finished)


def adam(saved: dict) -> dict:
    return saved["optimizer_states"][0]["mlp"]["state"][0]


COLOR = "field.color.layers.0.weight"
ANOTHER, UNFIT = "a file of another kind, expected a checkpoint of ctm_plugin", r"weights that do not fit \(.*"
STATE = "a state that cannot be restored"


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (lambda s: s.clear(), ANOTHER),
        (lambda s: s.update(callbacks={"Stopwatch": {}}), ANOTHER),
        (lambda s: s.update(callbacks=[]), ANOTHER),
        (lambda s: s.update(state_dict=[]), ANOTHER),
        (lambda s: s.update(batches_seen="3"), ANOTHER),
        (lambda s: s.pop("global_step"), ANOTHER),
        (lambda s: s["state_dict"][COLOR].fill_(torch.nan), f"{UNFIT}infinity in {COLOR}"),
        (lambda s: s["state_dict"].update({COLOR: torch.zeros(1)}), UNFIT + COLOR),
        (lambda s: s.pop("optimizer_states"), STATE),
        (lambda s: s.update(optimizer_states=[{}]), STATE),
        (lambda s: s.update(loops=3), STATE),
        (lambda s: adam(s).update(exp_avg=torch.zeros(3)), STATE),
        (lambda s: s.update(loops=Payload("touched")), "an unreadable file"),
    ],
)  # fmt: skip
def test_a_checkpoint_of_something_else(finished, monkeypatch, spoil, found):
    monkeypatch.chdir(finished)
    saved = torch.load(finished / LAST, weights_only=True)
    spoil(saved)
    torch.save(saved, finished / LAST)
    with pytest.raises(CheckpointError, match=f"last.ckpt: found {found}"):
        resume(finished)
    assert not Path("touched").exists()  # code of the last one


def test_what_the_machine_refuses_is_no_fault_of_the_checkpoint(finished, monkeypatch):
    def refuse(self, trainer):
        raise torch.OutOfMemoryError("none left")

    monkeypatch.setattr("lightning.pytorch.strategies.SingleDeviceStrategy.setup", refuse)
    with pytest.raises(torch.OutOfMemoryError, match="none left"):
        resume(finished)


def test_a_plug_in_may_keep_what_is_infinite_in_a_buffer(config):
    """What may be saved may be read back: parameters alone have to be finite."""
    parts = assemble(config)
    parts.backbone.register_buffer("best", torch.tensor(float("inf")))
    checkpoint = {"state_dict": parts.backbone.state_dict()}
    parts.backbone.on_save_checkpoint(checkpoint)
    restore(parts, checkpoint, Path("last.ckpt"))
