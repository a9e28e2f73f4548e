"""What ``ctm list`` and the help say of groups, choices and keys."""

import re
from importlib.metadata import EntryPoint

from ctm_plugin.cli import main
from ctm_plugin.compose.choices import GROUPS
from ctm_plugin.compose.command_line import conf_dir
from ctm_plugin.settings import registry
from ctm_plugin.settings.listing import choices, plain
from ctm_plugin.settings.registry import REGISTRIES


def test_every_choice_has_a_line(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    assert main(["list"]) == 0
    shown = [line.strip() for line in capsys.readouterr().out.splitlines()]
    for group in GROUPS:
        names = choices(conf_dir(), group)
        assert names.keys() >= {path.stem for path in (conf_dir() / group).glob("*.yaml")}
        for name, line in names.items():
            assert len(line.split()) > 1
            assert any(name in row.split()[:2] and row.endswith(line) for row in shown), (name, line)


def test_the_help_fits_a_window_and_names_what_people_choose_from(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "90")
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) <= 30
    for group in ("dataset", "backbone", "ctm", "trainer"):
        (line,) = [line for line in shown if line.startswith(f"{group}=")]
        assert {*line.partition("=")[2].replace(",", "").split()} == {*choices(conf_dir(), group)}


def test_keys_of_groups_are_listed(capsys, refused, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    chosen = ["dataset=llff", "dataset.geometry=forward", "backbone=nerf", "trainer=paper", "ctm=quick"]
    assert main(["list", *chosen]) == 0
    shown = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "dataset.root ??? folder with poses_bounds.npy and images" in shown
    assert any(line.startswith("dataset.test_every 8 every so many views") for line in shown)
    assert "backbone.lr_decay_steps 250000 steps in which the learning rate falls to a tenth" in shown  # forward-facing
    assert any(line.startswith("trainer.image_every 5000 steps between pictures of a test view") for line in shown)
    assert any(line.startswith("ctm.pretrain_steps 1500 ") for line in shown)  # ctm=quick
    assert "foo: found an unknown key, expected one of appearance, backbone, " in refused("list", "foo")


def test_what_a_choice_says_is_for_people(capsys):
    marks, said = re.compile(r"^(Args|Attributes|Returns|Raises):|:\w+:`|``", re.M), []
    for group in ("backbone=dvgo", "ctm=on"):
        assert main(["list", group]) == 0
        said.append(capsys.readouterr().out)
    assert said[0].startswith("DVGO: voxel grids")
    said += [plain(each.docstring(name)) for each in REGISTRIES.values() for name in each.ours]
    assert not [text for text in said if marks.search(text)]


def test_choices_of_other_packages_are_listed(monkeypatch):
    entry = EntryPoint("tiny", "somewhere:Tiny", "ctm_plugin.backbones")
    monkeypatch.setattr(registry, "entry_points", lambda group: [entry] if group == entry.group else [])
    assert choices(conf_dir(), "backbone")["tiny"] == "from another package"
