"""Weights & Biases itself, into files, where it is installed."""

import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from ctm_plugin.runs.train import resume, train

SMALL = ("backbone.coarse=false", "backbone.steps_alone=4", "backbone.grow=[]", "ctm=off", "trainer.log_every=2")
PICTURES = ("trainer.image_every=2",)


@pytest.fixture
def run(tmp_path, monkeypatch) -> Path:
    """Where a sweep's run goes; nothing of this machine's own settings is asked."""
    for name in ("WANDB_DIR", "WANDB_MODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / "multirun.yaml").touch()
    return tmp_path / "sweep" / "0"


def contents(data: bytes) -> Iterator[bytes]:
    """The records of W&B's file: LevelDB's log format, after a header of 7 bytes."""
    position, whole = 7, b""
    while position + 7 <= len(data):
        left = 32768 - position % 32768  # of a block, in which no record's header is split
        if left < 7:
            position += left
            continue
        length, kind = struct.unpack_from("<HB", data, position + 4)
        whole += data[position + 7 : position + 7 + length]
        position += 7 + length
        if kind in (1, 4):  # a whole one, or its last part
            yield whole
            whole = b""


def test_wandb_offline(compose, run):
    pytest.importorskip("wandb", reason="not installed: pip install -e '.[wandb]'")
    from wandb.proto.wandb_internal_pb2 import Record

    result = train(compose(*SMALL, *PICTURES, "logger=wandb"), run)
    known = (run / "wandb.txt").read_text()
    (folder,) = (run.parent / "wandb").glob("offline-run-*")
    assert len(list(folder.rglob("files/media/images/test/render_*.png"))) == 3
    records = [Record.FromString(content) for content in contents(next(folder.glob("*.wandb")).read_bytes())]
    (began,) = (each.run for each in records if each.HasField("run"))
    assert (began.project, began.run_group, began.display_name) == ("ctm_plugin", "sweep", "0")
    logged = [{item.nested_key[0] if item.nested_key else item.key: item.value_json for item in each.history.item}
              for each in records if each.HasField("history")]  # fmt: skip
    assert sum("loss/total" in each for each in logged) == 2
    assert [float(each["final/psnr"]) for each in logged if "final/psnr" in each] == [pytest.approx(result["psnr"])]
    assert began.run_id == known
    resume(run)
    assert (run / "wandb.txt").read_text() == known
