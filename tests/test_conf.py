"""Every choice composes into settings that its dataclasses take, with the paper's values, each default written once."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from ctm_plugin import cli
from ctm_plugin.color.settings import LossWeights
from ctm_plugin.compose import choices as choices_of
from ctm_plugin.compose.checks import checked, choice_settings, kind_of
from ctm_plugin.compose.command_line import GROUPS, conf_dir
from ctm_plugin.compose.command_line import compose as program_compose
from ctm_plugin.runs.assemble import color_transform
from ctm_plugin.settings.listing import choices
from ctm_plugin.settings.registry import BACKBONES, DATASETS, REGISTRIES

OPTIONS = [(group, choice) for group in GROUPS for choice in choices(conf_dir(), group)]


def plain(settings: Any) -> dict[str, Any]:
    """A dataclass as YAML would hold it."""
    return OmegaConf.to_container(OmegaConf.create(asdict(settings)))


def builds(config: dict[str, Any]) -> None:
    """As before a run, short of reading data."""
    node = config["dataset"]
    checked(config | {"dataset": node | ({"root": "somewhere"} if node.get("root") == "???" else {})})
    color_transform(config, 0)


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_option_composes_and_builds(composed, group, option):
    config = composed(f"+{group}={option}")
    builds(config)
    key = {"ctm": "preset", "trainer": "budget", "loss": "kind"}.get(group, "name")
    if group not in ("experiment", "callbacks"):
        auto = {"loss=auto": "mse", "trainer=auto": "quick"}  # what it comes to here
        assert config[group][key] == auto.get(f"{group}={option}", option)


@pytest.mark.parametrize("backbone", [name for group, name in OPTIONS if group == "backbone"])
@pytest.mark.parametrize("budget", [name for group, name in OPTIONS if group == "trainer"])
def test_every_budget_of_every_backbone(composed, backbone, budget):
    config = composed(f"+backbone={backbone}", f"trainer={budget}")
    builds(config)
    paper = composed(f"backbone={backbone}", "trainer=paper")["backbone"]
    assert config["backbone"].keys() == paper.keys()
    assert (config["backbone"] == paper) == (budget == "paper")


def test_budgets_are_of_backbones_and_trainers_that_exist():
    names = {
        f"{backbone}_{trainer}"
        for g, backbone in OPTIONS
        for h, trainer in OPTIONS
        if (g, h) == ("backbone", "trainer")
    }
    assert {path.stem for path in (conf_dir() / "budget").glob("*.yaml")} <= names


def test_without_arguments_the_main_job_on_the_dark_still_life(composed):
    config = composed()
    assert (config["backbone"]["name"], config["ctm"]["preset"]) == ("dvgo", "auto")
    assert (config["dataset"]["name"], config["dataset"]["light"]) == ("still_life", "dark")
    assert (config["color_space"]["name"], config["loss"]["kind"]) == ("rgb", "mse")
    assert (config["trainer"]["budget"], config["seed"], config["resume"]) == ("quick", 0, None)


NAMED = [(group, name) for group in ("backbone", "dataset", "logger", "appearance") for name in REGISTRIES[group].ours]


@pytest.mark.parametrize(("group", "name"), NAMED)
def test_a_choice_has_every_key_with_the_dataclass_default(composed, group, name):
    node = composed(f"{group}={name}", "trainer=paper", "ctm=on")[group]
    kind = kind_of(group, name)
    given = {key: value for key, value in node.items() if key in ("root", "geometry")}
    assert choice_settings(node) == plain(kind(**given))


@pytest.mark.parametrize(
    ("arguments", "backbone"),
    [
        (["dataset=colmap"], "splat"),
        (["dataset=transforms"], "splat"),
        (["+dataset=colmap", "dataset.root=x"], "splat"),
        (["+experiment=lom"], "splat"),
        (["dataset=llff"], "dvgo"),
        (["dataset=transforms", "+backbone=dvgo"], "dvgo"),
        (["+backbone=ngp", "dataset=colmap"], "ngp"),
        (["+experiment=lom", "backbone=dvgo"], "dvgo"),
        (["+experiment=rawnerf_nerf"], "nerf"),
        (["backbone=barf2d"], "barf2d"),
        ([], "dvgo"),
    ],
)
def test_a_capture_without_a_backbone_takes_its_own(arguments, backbone):
    assert program_compose(*arguments)["backbone"]["name"] == backbone


def test_a_sweep_over_captures_takes_it_once():
    chosen = choices_of.with_usual_backbone
    assert chosen(["-m", "dataset=colmap,transforms"]) == ["-m", "dataset=colmap,transforms", "backbone=splat"]
    assert chosen(["-m", "dataset=colmap,llff"]) == ["-m", "dataset=colmap,llff"]
    assert chosen(["dataset=none_such"]) == ["dataset=none_such"]


def flat(node: Any, prefix: str = "") -> dict[str, Any]:
    """Values by dotted name, without a choice's own names and Hydra's defaults."""
    found = {}
    for key, value in node.items():
        if key not in ("name", "preset", "kind", "budget", "defaults"):
            found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


FILES = [
    (group, path.stem)
    for group in ("ctm", "trainer", "loss", "budget", "ctm_for")
    for path in sorted((conf_dir() / group).glob("*.yaml"))
]


@pytest.mark.parametrize(("group", "name"), FILES)
def test_no_file_repeats_a_default(composed, group, name):
    """What a file says differs from the dataclass, or from the file that it stands on."""
    path = conf_dir() / group / f"{name}.yaml"
    file = OmegaConf.to_container(OmegaConf.load(path))
    said = flat(file)
    if group == "ctm_for":
        backbone, _, ctm = name.partition("_")
        parts = {"ctm": composed(f"ctm={ctm}")["ctm"], "backbone": choices_of.node("backbone", backbone)}
        default = flat(parts.get(package(path), parts))
    elif group == "budget":
        default = flat(choices_of.node("backbone", name.partition("_")[0]))
        for base in file.get("defaults", []):
            if base != "_self_":
                stands_on = path.with_name(f"{base.partition('@')[0]}.yaml")
                default |= flat(OmegaConf.to_container(OmegaConf.load(stands_on)))
    else:
        default = flat(choices_of.node(group, name if name == "auto" else group))
    assert [key for key, value in said.items() if default[key] == value] == []


def package(path: Path) -> str:
    """What part of the configuration a file says that it is."""
    return path.read_text(encoding="utf-8").splitlines()[0].removeprefix("# @package ")


@pytest.mark.parametrize("name", sorted({*DATASETS.ours, *BACKBONES.ours}))
def test_names_with_a_dataclass_have_no_file(name):
    assert not list(conf_dir().rglob(f"{name}.yaml"))


def test_values_of_the_paper(composed):
    ctm = composed("ctm=on")["ctm"]
    assert (ctm["k"], ctm["P"], ctm["width"], ctm["depth"], ctm["frequency"]) == (3, 4, 64, 1, "pi")
    assert ctm["weights"] == {"enc": 1, "dec": 1, "img": 10000, "rand": 10, "latent": 100}
    assert (ctm["lr"], ctm["betas"], ctm["pretrain_steps"], ctm["reduction"]) == (5e-4, [0.9, 0.999], 0, "sum")
    dvgo = composed("trainer=paper")["backbone"]
    assert (dvgo["coarse_steps"], dvgo["steps"], dvgo["steps_alone"]) == (5000, 20000, 30000)
    assert (dvgo["coarse_voxels"], dvgo["voxels"], dvgo["grow"]) == (100**3, 160**3, [1000, 2000, 3000, 4000])
    assert (dvgo["rays"], dvgo["features"]) == (8192, 12)
    assert (dvgo["lr_grid"], dvgo["lr_mlp"], dvgo["lr_decay_steps"], dvgo["step_size"]) == (0.1, 1e-3, 20000, 0.5)
    assert (dvgo["coarse_entropy"], dvgo["occupancy_first"]) == (0.01, 500)


def test_values_of_the_paper_for_planar_alignment(composed):
    config = composed("+backbone=barf2d", "+ctm=on", "trainer=paper")
    assert config["dataset"]["name"] == "planar"
    assert config["ctm"]["weights"] == {"enc": 1, "dec": 0.1, "img": 100, "rand": 0, "latent": 0}
    assert (config["ctm"]["lr"], config["backbone"]["lr"], config["backbone"]["lr_warp"]) == (5e-3, 1e-3, 1e-3)
    assert (config["backbone"]["steps"], config["backbone"]["pixels"]) == (5000, None)


def test_a_data_set_of_ones_own_goes_before_the_backbones(composed):
    config = composed("backbone=barf2d", "dataset=planar", "dataset.image=mine.png")
    assert (config["dataset"]["name"], config["dataset"]["image"]) == ("planar", "mine.png")
    assert composed("backbone=barf2d", "dataset=white_room")["dataset"]["name"] == "white_room"


@pytest.mark.parametrize("name", [path.stem for path in (conf_dir() / "ctm_for").glob("*.yaml")])
def test_what_ctm_needs_is_of_backbones_that_exist(composed, name):
    backbone, _, ctm = name.partition("_")
    assert ("backbone", backbone) in OPTIONS
    assert ("ctm", ctm) in OPTIONS
    settings = composed(f"backbone={backbone}", f"ctm={ctm}")
    builds(settings)
    part = package(conf_dir() / "ctm_for" / f"{name}.yaml")
    found = composed(f"backbone={backbone}", f"ctm={ctm}", "trainer=paper")
    without = {"ctm": composed(f"ctm={ctm}"), "backbone": composed(f"backbone={backbone}", "ctm=off", "trainer=paper")}
    for name in without if part == "_global_" else [part]:
        assert found[name] != without[name][name]


PAPER = {
    "synthetic_nerf": ("blender", {"nerf": "white", "dvgo": "white"}),
    "synthetic_nerf_dark": ("blender", {"nerf": "random", "dvgo": "random"}),
    "rawnerf": ("rawnerf", {"nerf": "random", "dvgo": "random"}),
    "low_texture_blender": ("llff", {"nerf": "black", "dvgo": "black"}),
}
"""Data set and backgrounds of each set of the paper."""


@pytest.mark.parametrize("backbone", ["nerf", "dvgo"])
@pytest.mark.parametrize("data", PAPER)
def test_experiments_of_the_paper(composed, data, backbone):
    config = composed(f"+experiment={data}_{backbone}", "dataset.root=x")
    builds(config)
    layout, backgrounds = PAPER[data]
    assert (config["dataset"]["name"], config["dataset"]["background"]) == (layout, backgrounds[backbone])
    assert (config["ctm"]["preset"], config["trainer"]["budget"]) == ("on", "paper")
    forward = layout != "blender"
    assert config["dataset"]["geometry"] == config["backbone"]["geometry"] == ("forward" if forward else "bounded")
    if forward:
        assert config["dataset"]["test_every"] == 8
    field = config["backbone"]
    if backbone == "nerf":
        sizes = ("steps", "rays", "coarse_samples", "fine_samples")
        assert [field[size] for size in sizes] == [100000, 1024, 64, 128]
        assert (field["width"], field["depth"], field["lr"]) == (256, 8, 5e-4)
        assert field["lr_decay_steps"] == (250000 if forward else 500000)
        assert (field["crop_steps"], field["density_noise"]) == ((0, 1.0) if forward else (500, 0.0))
        return
    assert field["steps_alone"] == 30000
    assert (field["restart"], field["shift_drop"]) == (True, 1.0)
    if forward:
        assert (field["planes"], field["voxels"], field["features"]) == (128, 256**3, 9)
        assert (field["rays"], field["grow"], field["threshold"]) == (4096, [2000, 4000, 6000, 8000], 1e-3)
        assert (field["tv_density"], field["tv_features"], field["tv_dense_steps"]) == (1e-5, 1e-6, 10000)
        assert (field["distortion"], field["step_size"]) == (0.01, 0.5)
    else:
        # Fine stage alone in the dark (Appendix A).
        assert field["coarse"] is (data == "synthetic_nerf")
        assert (field["coarse_steps"], field["steps"], field["rays"]) == (5000, 20000, 8192)


def test_values_of_the_released_module(composed):
    ctm = composed("ctm=release")["ctm"]
    assert (ctm["frequency"], ctm["reduction"], ctm["random_colors"]) == ("unit", "mean", 2**14)
    assert ctm["weights"] == plain(LossWeights()) | {"img": 10, "rand": 10, "latent": 10}
    assert (ctm["lr"], ctm["pretrain_steps"]) == (5e-2, 1000)


def test_off_is_no_boolean(composed):
    for off in ("off", "'off'"):
        assert composed(f"ctm={off}")["ctm"] == {"preset": "off", "name": "none"}


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    """A user's folder with an experiment."""
    folder = tmp_path / "mine"
    (folder / "experiment").mkdir(parents=True)
    (folder / "experiment" / "small.yaml").write_text(
        "# @package _global_\n"
        "defaults:\n"
        "  - override /ctm: release\n"
        "  - override /trainer: smoke\n"
        "  - override /color_space: lab\n"
        "seed: 7\n"
        "backbone:\n"
        "  rays: 32\n"
    )
    return folder


def test_an_experiment_of_the_users(composed, experiment):
    config = composed(f"hydra.searchpath=[file://{experiment}]", "+experiment=small", "ctm.k=4")
    builds(config)
    assert (config["ctm"]["preset"], config["ctm"]["k"], config["color_space"]["name"]) == ("release", 4, "lab")
    assert (config["seed"], config["backbone"]["rays"]) == (7, 32)
    assert config["trainer"]["budget"] == "smoke"
    assert config["backbone"]["steps"] == composed("trainer=smoke")["backbone"]["steps"]  # its budget came along


def test_an_experiment_through_the_command_line(experiment, monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr("ctm_plugin.runs.train.train", lambda config, *_: seen.append(config) or {})
    monkeypatch.chdir(tmp_path)
    assert cli.main(["--config-dir", str(experiment), "+experiment=small", "ctm=off"]) == 0
    assert (seen[0]["ctm"]["preset"], seen[0]["seed"], seen[0]["trainer"]["budget"]) == ("off", 7, "smoke")
