"""The command line: both spellings, sweeps, and every mistake as one message before any training."""

import errno
import json
import os
import shutil
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import lightning as L
import pytest
import yaml
from hydra.core.global_hydra import GlobalHydra
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin import __version__
from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.cli import main
from ctm_plugin.errors import ConfigError, Interrupted
from ctm_plugin.files import replacing
from ctm_plugin.runs.choices import GROUPS, normalise
from ctm_plugin.runs.compose import conf_dir
from ctm_plugin.runs.rundir import CONFIG, METRICS
from ctm_plugin.settings import registry
from ctm_plugin.settings.listing import choices

TIMES = ("train_seconds", "rays_per_second", "peak_memory_mb")
SMALL = ("trainer=smoke", "backbone.coarse=false", "backbone.steps_alone=3", "backbone.grow=[2]")


@pytest.fixture
def small(ball, tmp_path, monkeypatch) -> tuple[str, ...]:
    """Arguments of a run of a fraction of a second, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return ("dataset=blender", f"dataset.root={ball}", *SMALL)


@pytest.fixture
def untrained(monkeypatch) -> None:
    """Training is an error."""

    def fit(*args, **kwargs):
        raise AssertionError("training has begun")

    monkeypatch.setattr(L.Trainer, "fit", fit)


def scores(run: Path) -> dict:
    return {key: value for key, value in json.loads((run / METRICS).read_text()).items() if key not in TIMES}


def runs(folder: Path) -> list[Path]:
    return sorted(path.parent for path in folder.rglob(METRICS))


# normalise


WORDS = st.sampled_from([*GROUPS, "seed", "hydra", "x"])
ARGUMENTS = st.one_of(
    st.text(max_size=12),
    st.builds(
        "".join, st.tuples(st.sampled_from(["", "+", "++", "~"]), WORDS, st.sampled_from(["", ".k"]), st.just("=v"))
    ),
)


@given(st.lists(ARGUMENTS))
def test_normalise_changes_group_choices_alone(arguments):
    after = normalise(arguments)
    assert len(after) == len(arguments)
    for one, other in zip(arguments, after, strict=True):
        chosen = one.partition("=")[0]
        is_choice = "=" in one and chosen[:1] == "+" and chosen[1:] in GROUPS
        assert other == (one[1:] if is_choice else one)
    assert normalise(after) == after


# Runs


def test_the_command_to_the_letter_and_without_plus(small, capsys):
    assert main(["+backbone=dvgo", "+ctm=on", *small]) == 0
    assert main([*small, "backbone=dvgo", "ctm=on"]) == 0
    first, second = runs(Path("runs"))
    assert scores(first) == scores(second)
    assert (scores(first)["backbone"], scores(first)["ctm"]) == ("dvgo", "on")
    assert [first.name, second.name] == ["ball_dvgo_on", "ball_dvgo_on_2"]
    printed = capsys.readouterr().out
    assert printed.count("written to") == 2
    assert f"written to {first.resolve()}" in printed.replace("\n", "")


def test_a_sweep_with_plus(small):
    """Its flag stands at the end here, in front elsewhere."""
    sweep = ["+backbone=dvgo", "+ctm=on,off", "seed=0,1", "hydra.sweep.dir=all"]
    assert main([*small, *sweep, "-m"]) == 0
    names = [f"{job}_blender_dvgo_ctm-{ctm}_seed{seed}" for job, (ctm, seed) in enumerate(SWEEP)]
    assert [run.name for run in runs(Path("all"))] == names
    for run, (ctm, seed) in zip(runs(Path("all")), SWEEP, strict=True):
        assert (scores(run)["ctm"], scores(run)["seed"]) == (ctm, seed)
        assert yaml.safe_load((run / CONFIG).read_text())["ctm"]["preset"] == ctm
    assert len({scores(run)["psnr"] for run in runs(Path("all"))}) == 4


SWEEP = [("on", 0), ("on", 1), ("off", 0), ("off", 1)]


def test_jobs_of_a_sweep_are_the_single_runs(small):
    """Nothing of one job leaks into the next."""
    assert main(["-m", *small, "+ctm=off,on", "hydra.sweep.dir=all"]) == 0
    assert main([*small, "+ctm=on", "hydra.run.dir=one"]) == 0
    assert scores(runs(Path("all"))[1]) == scores(Path("one"))


def test_a_plugin_is_a_choice_with_its_defaults(small, monkeypatch):
    monkeypatch.setitem(registry.BACKBONES.added, "mine", DVGO)
    fast = [argument for argument in small if not argument.startswith("backbone.")]
    sizes = ["backbone.coarse=false", "backbone.steps_alone=2", "backbone.grow=[]", "backbone.voxels=512"]
    assert main([*fast, "+backbone=mine", "+ctm=on", *sizes, "backbone.rays=16", "hydra.run.dir=run"]) == 0
    assert scores(Path("run"))["backbone"] == "mine"
    assert yaml.safe_load(Path("run", CONFIG).read_text())["backbone"]["features"] == 12


def test_nothing_of_the_process_is_changed(small, untrained, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["pytest", "seed=-5"])
    for full in ("0", None):
        monkeypatch.setenv("HYDRA_FULL_ERROR", full) if full else monkeypatch.delenv("HYDRA_FULL_ERROR")
        before = dict(os.environ)
        assert main(["backbone=nerve"]) == 1
        assert main([*small, "ctm.k=0"]) == 1
        with pytest.raises(AssertionError, match="training has begun"):
            main([*small])
        assert dict(os.environ) == before
        assert sys.argv == ["pytest", "seed=-5"]
        assert not GlobalHydra.instance().is_initialized()


def test_arguments_come_from_the_command_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["ctm", "+backbone=nerve"])
    assert main() == 1
    assert "backbone: found 'nerve'" in capsys.readouterr().err


# Mistakes

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
    (
        "backbon=dvgo",
        "backbon: found 'an unknown key', expected one of appearance, backbone, callbacks, color_space, ctm, ",
    ),
    ("foo=1", "foo: found 'an unknown key', expected one of appearance, backbone, "),
    ("backbone.foo=1", "backbone.foo: found 'an unknown key', expected one of averaged, coarse, "),
    ("dataset.foo=1", "dataset.foo: found 'an unknown key', expected one of background, "),
    ("+dataset.noise.foo=1", "dataset.noise.foo: found 'an unknown key', expected one of read, seed, shot"),
    ("ctm.weights.foo=1", "ctm.weights.foo: found 'an unknown key', expected one of dec, enc, img, latent, rand"),
    ("+ctm.foo=1", "ctm.foo: found 'an unknown key', expected one of P, betas, depth, "),
    ("ctm=off +ctm.k=3", "ctm.k: found 'an unknown key', expected no settings"),
    ("ctm=off ctm.k=3", "ctm.k: found 'an unknown key', expected one of name, preset"),
    ("+color_space.foo=1", "color_space.foo: found 'an unknown key', expected no settings"),
    ("+metrics.foo=1", "metrics.foo: found 'an unknown key', expected one of lpips_net, lpips_weights"),
    ("~loss", "loss: found None, expected settings"),
    ("~seed", "seed: found None, expected a value"),
    ("backbone.name=nerve", "unknown backbone 'nerve'; known: barf2d, dvgo, "),
    ("dataset.name=null", "unknown dataset 'None'; known: blender, colmap, llff, planar, rawnerf, still_life, "),
    ("ctm.name=mtc", "unknown colour transform 'mtc'; known: auto, ctm"),
    # What was meant.
    ("backbone.lr_gird=0.2", "voxels; did you mean backbone.lr_grid?"),
    ("ctm.wieghts.enc=1", "did you mean ctm.weights?"),
    ("ctm.weights.ecn=1", "did you mean ctm.weights.enc?"),
    ("callbacks.film.frmaes=3", "did you mean callbacks.film.frames?"),
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
    (
        "dataset.background=green",
        "dataset.background: found 'green', expected one of black, white, random_matched, random",
    ),
    ("backbone.rays=0", "backbone.rays: found 0, expected an integer >= 1"),
    ("backbone.grow=[3,2]", "backbone.grow: found [3, 2], expected rising step numbers > 0"),
    ("backbone.coarse=perhaps", "backbone.coarse: found 'perhaps', expected one of true, false, auto"),
    ("trainer.precision=8", "trainer.precision: found '8', expected one of auto, 32-true, bf16-mixed, 16-mixed"),
    (
        "trainer.precision=16-mixed trainer.accelerator=cpu",
        "trainer.precision: found '16-mixed', expected bf16-mixed or",
    ),
    ("trainer.image_every=0", "trainer.image_every: found 0, expected an integer >= 1 or null"),
    # Files.
    ("metrics.lpips_weights=nowhere.npz", "nowhere.npz: found no file, expected weights of LPIPS' network"),
    ("dataset.root=nowhere", "nowhere: found nothing there, expected a folder with transforms_train.json"),
    ("dataset.root=", "dataset.root: found '', expected the folder of a data set"),
    ("dataset.root=empty", "transforms_train.json"),
    ("hydra.run.dir=file/run", "Not a directory: 'file/run'"),
    ("dataset.root=file", "file: found a file, expected a folder with transforms_train.json"),
    ("dataset.root=???", "dataset.root: found 'nothing', expected a value"),
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


def test_a_gpu_that_is_not_there(small, untrained, capsys):
    assert main([*small, "trainer.accelerator=gpu", "trainer.devices=64"]) == 1
    assert "error: trainer: " in capsys.readouterr().err
    assert not list(Path("runs").glob("*/*"))


def test_dataset_root_is_needed(tmp_path, untrained, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["dataset=blender", "trainer=smoke"]) == 1
    expected = "expected a value: folder with transforms_train.json"
    assert capsys.readouterr().err.startswith(f"error: dataset.root: found 'nothing', {expected}")


def test_a_scene_of_another_kind_names_the_backbone_for_it(small, untrained, capsys):
    with pytest.warns(UserWarning, match=r"scaled from 600x400 and cut to 480x360"):
        assert main(["dataset=planar", "trainer=smoke"]) == 1
    told = "dataset: found 'planar', expected a data set that backbone=dvgo can train on (a Scene)"
    assert capsys.readouterr().err == f"error: {told}; this one is for backbone=barf2d\n"


def test_every_failed_job_of_a_sweep_is_told_and_the_others_run(small, capsys):
    assert main(["-m", *small, "seed=0,-1", "ctm=on", "ctm.k=3,0", "hydra.sweep.dir=all"]) == 1
    error = capsys.readouterr().err
    told = [line for line in error.splitlines() if line.startswith("error in job ")]
    assert len(told) == 3
    assert told[0].startswith("error in job 1 (dataset=blender ")
    assert told[0].endswith("seed=0 ctm=on ctm.k=0): ctm.k: found 0, expected an integer >= 1")
    assert told[1].endswith("seed=-1 ctm=on ctm.k=3): seed: found -1, expected an integer >= 0")
    assert told[2].endswith("seed=-1 ctm=on ctm.k=0): seed: found -1, expected an integer >= 0")
    assert error.splitlines()[-1].startswith("error: all: 3 of 4 runs failed; the same command with sweep.resume=true")
    assert "Traceback" not in error
    assert [run.name for run in runs(Path("all"))] == ["0_blender_dvgo_ctm-on_seed0"]


def test_ctrl_c_ends_a_sweep(small, monkeypatch, capsys):
    begun = []

    def train(config, run, tell):
        begun.append(run)
        raise Interrupted("after step 3", run)

    monkeypatch.setattr("ctm_plugin.runs.train.train", train)
    assert main(["-m", *small, "seed=0,1,2", "hydra.sweep.dir=all"]) == 130
    assert len(begun) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("stopped after step 3; go on with: python -m ctm_plugin")


def test_ctrl_c_before_training(small, monkeypatch, capsys):
    def load(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("ctm_plugin.runs.assemble.load_scene", load)
    assert main([*small]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "stopped"


def test_an_error_of_ours_keeps_its_traceback(small, monkeypatch):
    def render(*args):
        raise RuntimeError("a bug")

    monkeypatch.setattr(DVGO, "render", render)
    with pytest.raises(RuntimeError, match="a bug"):
        main([*small, "ctm=off"])


def test_a_plugin_that_cannot_be_imported_stops_only_those_who_want_it(small, untrained, monkeypatch, capsys):
    from importlib.metadata import EntryPoint

    entry = EntryPoint("broken", "no_such_module:Field", "ctm_plugin.backbones")
    monkeypatch.setattr(registry, "entry_points", lambda group: [entry] if group == entry.group else [])
    with pytest.raises(AssertionError, match="training has begun"):
        main([*small])
    capsys.readouterr()
    assert main(["+backbone=broken", *small[:3]]) == 1
    assert "backbone 'broken' (no_such_module:Field) cannot be imported" in capsys.readouterr().err


# Forms


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--dataset.root=x", "found '--dataset.root=x', expected dataset.root=x"),
        ("ctm=off -x", "found '-x', expected x=VALUE"),
        ("dataset.root = x", "found 'dataset.root =', expected key=value, without spaces round the ="),
        ("dataset.root= x", "found 'dataset.root= x', expected key=value, without spaces round the ="),
        ("ctm=off dataset.root =x", "found 'dataset.root =x', expected key=value, without spaces round the ="),
        ("ctm=off seed", "found 'seed', expected key=value"),
        ("train nowhere", "found 'nowhere', expected key=value"),
        ("folder", "did you mean ctm train folder?"),
        ("trian", "did you mean train?"),
    ],
)
def test_what_is_no_key_and_value(tmp_path, untrained, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    Path("folder").mkdir()
    assert main(arguments.split()) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["train", "{}"], ["dataset.root={}"]])
def test_a_folder_alone_chooses_its_data_set(ball, capsys, arguments):
    """Flags may stand anywhere."""
    assert main([*(each.format(ball) for each in arguments), "--cfg", "job", "trainer=smoke"]) == 0
    captured = capsys.readouterr()
    assert captured.err.startswith("dataset=blender, which reads that folder\ndataset.geometry=bounded: ")
    config = yaml.safe_load(captured.out)
    assert config["dataset"]["geometry"] == "bounded"  # what is decided is printed too
    assert (config["dataset"]["name"], config["dataset"]["root"]) == ("blender", str(ball))


def test_a_folder_that_no_data_set_reads(tmp_path, capsys):
    assert main([f"dataset.root={tmp_path / 'nowhere'}"]) == 1
    assert "nowhere: found nothing there, expected a folder that one of dataset=" in capsys.readouterr().err
    (tmp_path / "text").touch()
    assert main([f"dataset.root={tmp_path}"]) == 1
    assert f"{tmp_path}: found no cameras, expected a folder that one of dataset=" in capsys.readouterr().err


def test_names_that_hydra_would_not_read(ball, tmp_path, monkeypatch, capsys):
    """A run, a sweep over two folders, and the command that goes on with the sweep."""
    monkeypatch.chdir(tmp_path)
    for name in ("cap (1)", "20240501"):
        shutil.copytree(ball, name)
    assert main(["dataset=blender", "dataset.root=cap (1)", *SMALL, "hydra.run.dir=Lauf, 1"]) == 0
    assert scores(Path("Lauf, 1"))["dataset"] == "cap (1)"
    assert main(["dataset.root=20240501", *SMALL]) == 0
    assert Path("runs/20240501_dvgo_auto", METRICS).is_file()
    sweep = ["-m", "dataset.root=cap (1),20240501", *SMALL, "hydra.sweep.dir=alle (2)"]
    assert main(sweep) == 0
    assert [scores(run)["dataset"] for run in runs(Path("alle (2)"))] == ["cap (1)", "20240501"]
    capsys.readouterr()
    assert main([*sweep, "seed=3"]) == 1
    assert "found the runs of an earlier sweep" in capsys.readouterr().err


# Processes


@pytest.mark.parametrize(("argument", "code"), [("+ctm=maybe", 1), ("--version", 0)])
def test_exit_codes_of_the_process(tmp_path, argument, code):
    command = [sys.executable, "-m", "ctm_plugin", argument]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert done.stdout == (f"ctm_plugin {__version__}\n" if code == 0 else "")


def test_a_full_disk_names_the_file_and_the_way_out(small, untrained, monkeypatch, capsys):
    """The system names no file where a disk is full."""

    def full(*args):
        with replacing(Path("picture.png")):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("ctm_plugin.runs.train.train", full)
    assert main([*small]) == 1
    told = "picture.png: found no room on the disk (No space left on device), expected some: make it, then try again; "
    assert capsys.readouterr().err.endswith(f"error: {told}a run goes on by resume=RUN_DIR\n")


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES])
def test_a_read_only_folder(small, untrained, monkeypatch, capsys, number):
    def mkdir(path, *args):
        raise OSError(number, os.strerror(number), path)

    monkeypatch.setattr(os, "mkdir", mkdir)
    assert main([*small, "hydra.run.dir=shut/run"]) == 1
    error = capsys.readouterr().err
    assert error.startswith(
        f"error: shut/run: found no permission ({os.strerror(number)}), expected a place to start in "
    )
    assert error.endswith(": hydra.run.dir=FOLDER moves a run, out=PATH a verb's files\n")
    assert error.count("\n") == 1


def test_warnings_are_a_line_without_code(small, untrained, monkeypatch):
    told = []

    def train(*args):
        cat = UserWarning("the cat is on the table")
        told.extend(warnings.formatwarning(cat, UserWarning, "file.py", 3, "code") for _ in range(2))
        raise ConfigError("x", 1, "y")

    monkeypatch.setattr("ctm_plugin.runs.train.train", train)
    before = warnings.formatwarning, threading.excepthook
    assert main([*small]) == 1
    assert (warnings.formatwarning, threading.excepthook) == before
    assert told == ["warning: the cat is on the table\n", ""]  # once


def test_typos_and_help_are_told_before_torch_is_imported(tmp_path):
    lines = {
        "backbone.lr_gird=1": "backbone.lr_grid",
        "dataset=stil_life": "still_life",
        "rendr RUN": "render",
        "export RUN wat=mesh": "export.what",
        "list bakbone": "backbone",
        "demo backbone.lr_gird=1": "backbone.lr_grid",
    }
    code = "import sys; from ctm_plugin.cli import main\n"
    code += f"for line in [*{list(lines)}, '--help']: main(line.split())\nprint('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert [line.partition("did you mean ")[2] for line in done.stderr.splitlines()] == [
        f"{m}?" for m in lines.values()
    ]
    assert done.stdout.splitlines()[-1] == "False"
    assert all(f"\n{group} " in done.stdout for group in GROUPS)


@pytest.mark.parametrize("arguments", [["list"], ["--help"], ["backbone=dvgo", "-h"]])
def test_every_choice_has_a_line(arguments, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    assert main(arguments) == 0
    shown = [line.strip() for line in capsys.readouterr().out.splitlines()]
    for group in GROUPS:
        names = choices(conf_dir(), group)
        assert names.keys() >= {path.stem for path in (conf_dir() / group).glob("*.yaml")}
        for name, line in names.items():
            assert len(line.split()) > 1
            assert any(name in row.split()[:2] and row.endswith(line) for row in shown), (name, line)
    assert any("resume=RUN_DIR" in line for line in shown) == (arguments != ["list"])


def test_keys_of_groups_are_listed(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert (
        main(["list", "dataset=llff", "dataset.geometry=forward", "backbone=nerf", "trainer=paper", "ctm=quick"]) == 0
    )
    shown = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "dataset.root ??? folder with poses_bounds.npy and images" in shown
    assert any(line.startswith("dataset.test_every 8 every so many views") for line in shown)
    assert "backbone.lr_decay_steps 250000 steps in which the learning rate falls to a tenth" in shown  # forward-facing
    assert any(line.startswith("trainer.image_every 5000 steps between pictures of a test view") for line in shown)
    assert any(line.startswith("ctm.pretrain_steps 1500 ") for line in shown)  # ctm=quick
    assert main(["list", "foo"]) == 1
    assert "foo: found 'an unknown key', expected one of appearance, backbone, " in capsys.readouterr().err


def test_choices_of_other_packages_are_listed(monkeypatch):
    from importlib.metadata import EntryPoint

    entry = EntryPoint("tiny", "somewhere:Tiny", "ctm_plugin.backbones")
    monkeypatch.setattr(registry, "entry_points", lambda group: [entry] if group == entry.group else [])
    assert choices(conf_dir(), "backbone")["tiny"] == "from another package"


def test_a_long_message_of_hydra_s_is_cut(capsys):
    assert main(["~seed=" + 30_000 * "x"]) != 0
    assert len(capsys.readouterr().err) < 3000
