"""What is refused by names alone, and what is left to Hydra."""

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from ctm_plugin.errors import ConfigError
from ctm_plugin.runs.compose import GROUPS, conf_dir
from ctm_plugin.settings import registry
from ctm_plugin.settings.typos import check_typos


def check(line: str) -> None:
    check_typos(OverridesParser.create().parse_overrides(line.split()), conf_dir(), GROUPS)


@pytest.mark.parametrize(
    "line",
    [
        "backbone=dvgo ctm=quick ctm.weights.enc=1 ctm.pretrain_steps=3 dataset.noise.read=0.1 seed=3",
        "backbone=dvgo,nerf backbone.width=3 backbone.voxels=4",  # each of one of them, as Hydra says
        "backbone='nerf','dvgo' ctm='off','on'",
        "backbone=glob(*) backbone.width=3",
        "backbone=${oc.env:FIELD} backbone.foo=1",
        "ctm=auto ctm.fills=0.3 ctm.lr=0.1",
        "ctm=off ctm.k=3",
        "+experiment=lom dataset.root=x dataset.scene=y",
        "backbone=barf2d dataset.image=x",  # whose data set is another
        "backbone.lr_grid.deeper=1",
        "trainer.devices=2 metrics.lpips_net=alex loss.weight=3 resume=null",
        "callbacks.film=null callbacks.film.frames=3 +callbacks.mine={a:1}",
        "budget=dvgo_smoke hydra.run.dir=x hydra/launcher=joblib ~loss dataset@here=blender",
    ],
)
def test_what_may_be_passes(line):
    check(line)


def test_what_another_package_brings_is_left_alone(monkeypatch):
    with pytest.raises(ConfigError, match="expected one of barf2d, dvgo, nerf"):
        check("backbone=mine")
    monkeypatch.setitem(registry.BACKBONES.added, "mine", object)
    check("backbone=mine backbone.foo=1")
    check("backbone=dvgo,mine backbone.foo=1")
    with pytest.raises(ConfigError, match="unknown key"):
        check("backbone=dvgo backbone.foo=1")
    with pytest.raises(ConfigError, match=r"expected one of barf2d, dvgo, mine, nerf, .*; did you mean mine\?"):
        check("backbone=mien")


def test_every_experiment_and_choice_passes():
    for group in GROUPS:
        for path in (conf_dir() / group).glob("*.yaml"):
            check(f"{group}={path.stem}")
