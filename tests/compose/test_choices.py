"""Choices as they are typed: with a plus or without, and of a folder alone."""

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.cli import main
from ctm_plugin.compose.choices import GROUPS, normalise

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


@pytest.mark.parametrize("arguments", [["train", "{}"], ["dataset.root={}"], ["dataset.root='{}'"]])
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
