"""The command line: both spellings, sweeps, and how each ends."""

import errno
import os
import select
import subprocess
import sys
import threading
import warnings
from contextlib import nullcontext
from pathlib import Path
from shutil import which

import pytest
import yaml
from faults import scores
from hydra._internal.hydra import Hydra
from hydra.core.global_hydra import GlobalHydra

from ctm_plugin import __version__
from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.cli import main
from ctm_plugin.errors import ConfigError, Interrupted
from ctm_plugin.files import replacing
from ctm_plugin.runs.rundir import CONFIG, METRICS
from ctm_plugin.settings import registry


def runs(folder: Path) -> list[Path]:
    return sorted(path.parent for path in folder.rglob(METRICS))


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


@pytest.mark.slow
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
    before = dict(os.environ)
    assert main(["backbone=nerve"]) == 1
    assert main([*small, "ctm.k=0"]) == 1
    with pytest.raises(AssertionError, match="training has begun"):
        main([*small])
    assert dict(os.environ) == before
    assert sys.argv == ["pytest", "seed=-5"]
    assert not GlobalHydra.instance().is_initialized()


@pytest.mark.parametrize("more", [(), ("--cfg", "job")])
def test_one_run_is_composed_once(small, untrained, monkeypatch, more):
    """Geometry and budget are found in what was composed."""
    made, own = [], Hydra.compose_config

    def compose_config(*args, **named):
        made.append(named["overrides"])
        return own(*args, **named)

    monkeypatch.setattr(Hydra, "compose_config", compose_config)
    arguments = [each for each in small if not each.startswith("trainer=")]
    with nullcontext() if more else pytest.raises(AssertionError, match="training has begun"):
        assert main([*arguments, *more]) == 0
    assert len(made) == 1


def test_what_hydra_prints(small, capsys):
    assert main(["--cfg", "job", "-p", "backbone", *small[:2], "--resolve"]) == 0
    printed = capsys.readouterr()
    heading, _, text = printed.out.partition("\n")
    assert heading == "# @package backbone"
    assert yaml.safe_load(text)["grow"] == [100, 200, 300]  # of the quick budget, which was found
    assert "trainer=quick: small pictures, and no GPU\n" in printed.err
    assert main(["--cfg", "hydra", "-p", "hydra.run"]) == 0
    assert capsys.readouterr().out.startswith("# @package hydra.run\ndir: runs/${scene:}_")
    assert main(["--cfg", "all", "-p", "hydra.job.name"]) == 0
    assert capsys.readouterr().out == "cli\n"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("ctm ph", ["photos"]),
        ("ctm backbone=n", ["backbone=nerf", "backbone=ngp"]),
        ("ctm -m backbone=splat trainer.mi", ["trainer.minutes="]),
        ("ctm photos FOLDER mi", ["minutes="]),
        ("ctm photos FOLDER dataset.wi", ["dataset.width="]),
        ("ctm render last seed", []),
        ("ctm backbone=nerve trainer.mi", []),
    ],
)
def test_a_shell_completes_verbs_choices_and_keys(line, expected, monkeypatch, capsys):
    monkeypatch.setenv("COMP_LINE", line)
    assert main(["-sc", "query=bash"]) == 0
    assert capsys.readouterr().out.split() == expected


@pytest.mark.skipif(which("bash") is None, reason="no bash")
def test_what_bash_is_told_to_run_completes(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sys, "argv", ["/bin/ctm"])
    assert main(["-sc", "install=bash"]) == 0
    (tmp_path / "ctm").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ctm_plugin "$@"\n')
    (tmp_path / "ctm").chmod(0o755)
    words = 'COMP_LINE="ctm backbone=sp" COMP_POINT=15 COMP_CWORD=1; hydra_bash_completion; echo "${COMPREPLY[@]}"'
    path = {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    script = ["bash", "-c", f"{capsys.readouterr().out}\n{words}"]
    done = subprocess.run(script, env=os.environ | path, capture_output=True, text=True, check=True)
    assert done.stdout == "backbone=splat\n"


@pytest.fixture
def shell(tmp_path, monkeypatch) -> dict[str, str]:
    """The environment of a shell that finds ctm, in a folder with one other folder."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "ctm").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ctm_plugin "$@"\n')
    (tmp_path / "bin" / "ctm").chmod(0o755)
    (tmp_path / "große Halle").mkdir()
    monkeypatch.chdir(tmp_path)
    return os.environ | {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}", "HOME": str(tmp_path), "TERM": "dumb"}


LINES = [("ctm ph", "photos"), ("ctm photos gro", "große Halle/"), ("ctm backbone=spl", "backbone=splat")]


@pytest.mark.skipif(which("fish") is None, reason="no fish")
@pytest.mark.parametrize(("line", "expected"), LINES)
def test_what_fish_is_told_to_run_completes(shell, monkeypatch, capsys, line, expected):
    monkeypatch.setattr(sys, "argv", ["/bin/ctm"])
    assert main(["-sc", "install=fish"]) == 0
    script = f"{capsys.readouterr().out}; complete -C '{line}'"
    done = subprocess.run(["fish", "-c", script], env=shell, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[0] == expected


@pytest.mark.skipif(which("zsh") is None, reason="no zsh")
@pytest.mark.parametrize(("line", "expected"), LINES)
def test_what_zsh_is_told_to_run_completes(shell, capsys, line, expected):
    """On a terminal, as zsh completes nowhere else; it shows the rest of the word, after a bell."""
    assert main(["-sc", "install=zsh"]) == 0
    Path("script").write_text(capsys.readouterr().out)
    ours, its = os.openpty()
    with subprocess.Popen(["zsh", "-f", "-i"], env=shell, stdin=its, stdout=its, stderr=its) as zsh:
        os.close(its)
        shown, typed, wanted = "", 'PS1=; source script; echo be""gun\n', "begun"
        while True:
            os.write(ours, typed.encode())
            while wanted not in shown.replace("\a", "").replace("\\", ""):
                assert select.select([ours], [], [], 60)[0], shown
                shown += os.read(ours, 4096).decode()
            if wanted == expected:
                break
            shown, typed, wanted = "", f"{line}\t", expected
        zsh.kill()


def test_a_shell_that_is_not_completed_in(capsys):
    assert main(["-sc", "install=tcsh"]) == main(["-sc"]) == 2
    told = capsys.readouterr().err
    assert "found install=tcsh after -sc, expected install=SHELL" in told
    assert "found nothing after -sc" in told


def test_choices_in_a_folder_that_is_not_there(refused):
    assert "--config-dir: found 'nowhere', expected a folder with choices" in refused("-cd", "nowhere")


def test_several_values_beside_choices_of_a_folder(tmp_path, refused):
    assert "seed: found '0,1', expected one value" in refused("-cd", tmp_path, "seed=0,1")


def test_arguments_come_from_the_command_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["ctm", "+backbone=nerve"])
    assert main() == 1
    assert "backbone: found 'nerve'" in capsys.readouterr().err


# Ends


@pytest.mark.slow
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


@pytest.mark.slow
def test_ctrl_c_ends_a_sweep(small, monkeypatch, capsys):
    begun = []

    def train(config, run, *_):
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


def test_a_setting_without_effect_is_named(small, monkeypatch):
    monkeypatch.setattr("ctm_plugin.runs.train.train", lambda *_: {})
    with pytest.warns(UserWarning, match="^backbone.steps=60 has no effect with backbone.coarse=false$"):
        assert main([*small, "backbone.steps=60"]) == 0
