"""Every mistake on the command line as one message before any training."""

import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from ctm_plugin.cli import MAIN_GROUPS, main
from ctm_plugin.settings import registry

MISTAKES = [
    # Names and keys, with those that are known.
    ("+backbone=nerve", "backbone: found 'nerve', expected one of barf2d, dvgo, "),
    ("dataset=lego", "dataset: found 'lego', expected one of blender, colmap, llff, planar, rawnerf, still_life, "),
    ("+ctm=maybe", "ctm: found 'maybe', expected one of auto, off, on, quick, release"),
    ("color_space=cmyk", "color_space: found 'cmyk', expected one of gain, hls, "),
    ("loss=l3", "loss: found 'l3', expected one of auto, l1, mse"),
    ("trainer=fast", "trainer: found 'fast', expected one of auto, check, paper, quick, smoke"),
    ("+experiment=mine", "experiment: found 'mine', expected one of colors, colors_dark, lom, "),
    ("ctm=", "ctm: found '', expected one of auto, off, on, quick, release"),
    ("+backbone=null", "backbone: found 'null', expected one of barf2d, dvgo, "),
    ("ctm=true", "ctm: found 'true', expected one of auto, off, on, quick, release; did you mean on?"),
    ("ctm=1", "; did you mean on?"),
    ("ctm=none", "; did you mean off?"),
    ("logger=off", "; did you mean none?"),
    ("+dataset=1.5", "dataset: found '1.5', expected one of blender, "),
    ("++loss={a:1}", "loss: found '{a:1}', expected one of auto, l1, mse"),
    ("trainer=[quick,smoke]", "trainer: found '[quick,smoke]', expected one of auto, check, paper, "),
    ("backbon=dvgo", "backbon: found an unknown key, expected one of appearance, backbone, callbacks, color_space, "),
    ("foo=1", "foo: found an unknown key, expected one of appearance, backbone, "),
    (
        "budget.minutes=2",
        "budget: found an unknown key, expected one of appearance, backbone, callbacks, color_space, ",
    ),
    ("hydra.foo=1", "hydra.foo: found an unknown key, expected one of callbacks, env, help, "),
    ("trainer.image_every=often", "trainer.image_every: found 'often', expected an integer or null"),
    ("backbone.foo=1", "backbone.foo: found an unknown key, expected one of averaged, coarse, "),
    ("dataset.foo=1", "dataset.foo: found an unknown key, expected one of background, "),
    ("+dataset.noise.foo=1", "dataset.noise.foo: found an unknown key, expected one of read, seed, shot"),
    ("ctm.weights.foo=1", "ctm.weights.foo: found an unknown key, expected one of dec, enc, img, latent, rand"),
    ("+ctm.foo=1", "ctm.foo: found an unknown key, expected one of P, betas, depth, "),
    ("ctm=off +ctm.k=3", "ctm.k: found an unknown key, expected no settings"),
    ("ctm=off ctm.k=3", "ctm.k: found an unknown key, expected one of name, preset"),
    ("+color_space.foo=1", "color_space.foo: found an unknown key, expected no settings"),
    ("+metrics.foo=1", "metrics.foo: found an unknown key, expected one of lpips_net, lpips_weights"),
    ("~loss", "loss: found None, expected settings"),
    ("~seed", "seed: found None, expected a value"),
    ("backbone.name=nerve", "unknown backbone 'nerve'; known: barf2d, dvgo, "),
    ("dataset.name=null", "unknown dataset 'None'; known: blender, colmap, llff, planar, rawnerf, still_life, "),
    ("ctm.name=mtc", "unknown colour transform 'mtc'; known: auto, ctm"),
    # What was meant.
    ("backbone.lr_gird=0.2", "voxels; did you mean backbone.lr_grid?"),
    ("ctm.wieghts.enc=1", "did you mean ctm.weights?"),
    ("ctm.weights.ecn=1", "did you mean ctm.weights.enc?"),
    ("steps=100", "trainer; did you mean backbone.steps?"),
    ("trainer.steps=100", "did you mean backbone.steps?"),
    ("ctm.p=1,2", "did you mean ctm.P?"),
    ("downscale=4", "did you mean dataset.downscale?"),
    ("datset.root=x", "did you mean dataset?"),
    ("+experiment=lom backbone=dvgo backbone.lr_gird=0.2", "did you mean backbone.lr_grid?"),
    # Several values, without a sweep.
    ("seed=0,1", "seed: found '0,1', expected one value; -m before it all makes a run of each, seed=[0,1] is a list"),
    ("seed=range(3)", "seed: found 'range(3)', expected one value; -m before it all makes a run of each"),
    ("ctm=on,off", "ctm: found 'on,off', expected one value; -m before it all makes a run of each"),
    # Values.
    ("ctm.k=0", "ctm.k: found 0, expected an integer >= 1"),
    ("ctm.k=three", "ctm.k: found 'three', expected an integer"),
    ("ctm.lr=1/4", "ctm.lr: found '1/4', expected a number"),
    ("ctm.betas=[0.9,x]", "ctm.betas[1]: found 'x', expected a number"),
    ("backbone.coarse=[1]", "backbone.coarse: found [1], expected true or false or text"),
    ("ctm.weights.rand=nan", "ctm.weights.rand: found nan, expected a number >= 0"),
    ("ctm.weights=3", "ctm.weights: found 3, expected a mapping"),
    ("ctm.betas=[0.9,1]", "ctm.betas: found [0.9, 1.0], expected two numbers in [0, 1)"),
    ("seed=-1", "seed: found -1, expected an integer >= 0"),
    ("seed=true", "seed: found True, expected an integer >= 0"),
    ("dataset.exposure=0", "dataset.exposure: found 0, expected a number in (0, 1]"),
    ("dataset.background=green", "dataset.background: found 'green', expected one of black, white, random_matched, "),
    ("backbone.rays=0", "backbone.rays: found 0, expected an integer >= 1"),
    ("backbone.grow=[3,2]", "backbone.grow: found [3, 2], expected rising step numbers > 0"),
    ("backbone.coarse=perhaps", "backbone.coarse: found 'perhaps', expected one of true, false, auto"),
    ("trainer.precision=8", "trainer.precision: found '8', expected one of auto, 32-true, bf16-mixed, 16-mixed"),
    ("trainer.precision=16-mixed trainer.accelerator=cpu", "trainer.precision: found '16-mixed', expected bf16-mixed"),
    ("trainer.image_every=0", "trainer.image_every: found 0, expected an integer >= 1 or null"),
    # Files.
    ("metrics.lpips_weights=nowhere.npz", "nowhere.npz: found no file, expected weights of LPIPS' network"),
    ("dataset.root=nowhere", "nowhere: found nothing there, expected a folder with transforms_train.json"),
    ("dataset.root=", "dataset.root: found '', expected the folder of a data set"),
    ("dataset.root=empty", "transforms_train.json"),
    ("hydra.run.dir=file/run", "Not a directory: 'file/run'"),
    ("dataset.root=file", "file: found a file, expected a folder with transforms_train.json"),
    ("dataset.root=???", "dataset.root: found nothing, expected a value: folder with transforms_train.json"),
    # The grammar.
    ("backbone.rays==3", "backbone.rays: found '=3', expected a value that can be read ("),
    ("++ctm=on", "force-add of config groups is not supported: '++ctm=on'"),
    ("++resume.x=1", "resume"),
    ("seed=${nowhere}", "nowhere"),
]


@pytest.mark.parametrize(("arguments", "message"), MISTAKES, ids=[arguments for arguments, _ in MISTAKES])
def test_mistakes_are_told_before_training(small, untrained, capsys, arguments, message):
    Path("file").write_text("")
    Path("empty").mkdir()
    keys = ["ctm=quick"] * (arguments.lstrip("+").startswith("ctm.") and "ctm.name" not in arguments)
    assert main([*small, *keys, *arguments.split()]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    told = captured.err.partition("error: ")[2]
    assert message in told
    assert "Traceback" not in captured.err
    left = [path for path in Path().rglob("*") if path.is_file()]
    assert left == [Path("file")]  # no run was begun
    assert not list(Path("runs").glob("*/*"))


def test_a_gpu_that_is_not_there(small, untrained, refused):
    assert "error: trainer: " in refused(*small, "trainer.accelerator=gpu", "trainer.devices=64")
    assert not list(Path("runs").glob("*/*"))


def test_a_scene_of_another_kind_names_the_backbone_for_it(small, untrained, capsys):
    with pytest.warns(UserWarning, match=r"scaled from 600x400 and cut to 480x360"):
        assert main(["dataset=planar", "trainer=smoke"]) == 1
    told = "dataset: found 'planar', expected a data set that backbone=dvgo can train on (a Scene)"
    assert capsys.readouterr().err == f"error: {told}; this one is for backbone=barf2d\n"


def test_a_plugin_that_cannot_be_imported_stops_only_those_who_want_it(small, untrained, monkeypatch, capsys, refused):
    entry = EntryPoint("broken", "no_such_module:Field", "ctm_plugin.backbones")
    monkeypatch.setattr(registry, "entry_points", lambda group: [entry] if group == entry.group else [])
    with pytest.raises(AssertionError, match="training has begun"):
        main([*small])
    capsys.readouterr()
    assert "backbone 'broken' (no_such_module:Field) cannot be imported" in refused("+backbone=broken", *small[:3])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--dataset.root=x", "found '--dataset.root=x', expected dataset.root=x"),
        ("ctm=off -x", "found '-x', expected x=VALUE"),
        ("dataset.root = x", "found 'dataset.root =', expected key=value, without spaces round the ="),
        ("dataset.root= x", "found 'dataset.root= x', expected key=value, without spaces round the ="),
        ("ctm=off dataset.root =x", "found 'dataset.root =x', expected key=value, without spaces round the ="),
        ("ctm=off seed", "found 'seed', expected key=value"),
        ("-m ctm=off,on --cfg job", "found -m with --cfg, expected one of these"),
        ("train nowhere", "found 'nowhere', expected key=value"),
        ("folder", "did you mean ctm photos folder or ctm train folder?"),
        ("photos my folder", "found my folder, expected FOLDER; did you mean 'my folder'?"),
        ("trian", "did you mean train?"),
    ],
)
def test_what_is_no_key_and_value(tmp_path, untrained, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    Path("folder").mkdir()
    Path("my folder").mkdir()
    assert main(arguments.split()) == 2
    assert message in capsys.readouterr().err


def test_typos_and_help_are_told_before_torch_is_imported(tmp_path):
    lines = {
        "backbone.lr_gird=1": "backbone.lr_grid",
        "dataset=stil_life": "still_life",
        "rendr RUN": "render",
        "export RUN wat=mesh": "what",
        "list bakbone": "backbone",
        "demo backbone.lr_gird=1": "backbone.lr_grid",
    }
    code = "import sys; from ctm_plugin.cli import main\n"
    others = ["--help", "export --help", "list", "list backbone=dvgo"]
    code += f"for line in {[*lines, *others]}: main(line.split())\nprint('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert [line.partition("did you mean ")[2] for line in done.stderr.splitlines()] == [
        f"{m}?" for m in lines.values()
    ]
    assert done.stdout.splitlines()[-1] == "False"
    assert all(f"\n{group}=" in done.stdout for group in MAIN_GROUPS)


def test_a_long_message_of_hydra_s_is_cut(capsys):
    assert main(["~seed=" + 30_000 * "x"]) != 0
    assert len(capsys.readouterr().err) < 3000
