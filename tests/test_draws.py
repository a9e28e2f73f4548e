"""Random numbers of a step: the same for the same (seed, step), shared out among processes, and random."""

import ast
import hashlib
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import ctm_plugin
from ctm_plugin.draws import Draws, FixedDraws, seeded

ANY = st.integers(-(2**70), 2**70)


def numbers(draws: Draws, rows: int = 6) -> torch.Tensor:
    """Some of each kind, in float64."""
    drawn = [draws.uniform(rows, 3), draws.integers(1000, rows)[:, None], draws.normal(rows, 2), draws.uniform(rows, 1)]
    return torch.cat([part.double() for part in drawn], dim=1)


@given(st.tuples(ANY, ANY), st.tuples(ANY, ANY))
def test_the_seed_and_the_step_decide_all(one, two):
    before = torch.get_rng_state()
    assert torch.equal(numbers(Draws(*one)), numbers(Draws(*one)))
    if one != two:
        assert not torch.isin(Draws(*one).uniform(8, 3), Draws(*two).uniform(8, 3)).all()
    assert torch.equal(torch.get_rng_state(), before)


def test_neighbouring_seeds_and_steps_differ():
    drawn = torch.stack([Draws(seed, step).uniform(1, 1) for seed in range(-9, 20) for step in range(-9, 20)])
    assert len(drawn.unique()) > 0.99 * len(drawn)


def of_package() -> list[tuple[str, str]]:
    """The files that draw, and the names of their streams."""
    package = Path(ctm_plugin.__file__).parent
    trees = {path.relative_to(package).as_posix(): ast.parse(path.read_text()) for path in package.rglob("*.py")}
    calls = [(name, node) for name, tree in trees.items() for node in ast.walk(tree) if isinstance(node, ast.Call)]
    drawing = [(name, node.keywords) for name, node in calls if ast.unparse(node.func) == "Draws"]
    return [(name, "".join(each.value.value for each in given if each.arg == "stream")) for name, given in drawing]


@pytest.mark.slow
def test_no_two_streams_share_numbers():
    names = sorted({stream for _, stream in of_package()})
    assert {"", "colors", "views"} < {*names}
    drawn = [int(Draws(0, step, stream=name).integers(2**62, 1)) for name in names for step in range(-99, 200)]
    assert len({*drawn}) == len(drawn)


def test_batches_and_nothing_else_have_the_stream_without_a_name():
    assert [file for file, stream in of_package() if not stream] == ["backbones/base.py"]
    bits = hashlib.blake2b(b"3/7", digest_size=8).digest()  # as they have always been
    assert Draws(3, 7).generator.initial_seed() == int.from_bytes(bits, "little") >> 1


@pytest.mark.parametrize("world", [2, 3, 5])
@given(st.integers(0, 9), st.integers(0, 50))
def test_processes_share_one_batch(world, step, rows):
    whole = numbers(Draws(0, step), world * rows)
    parts = [numbers(Draws(0, step, rank=rank, world=world), rows) for rank in range(world)]
    assert torch.equal(torch.cat(parts), whole)


def test_uniform_is_uniform():
    drawn = Draws(0, 0).uniform(20000, 2)
    assert (drawn.shape, drawn.dtype) == ((20000, 2), torch.float32)
    assert ((drawn >= 0) & (drawn < 1)).all()
    counts = torch.histc(drawn, 10, 0, 1) / drawn.numel()
    torch.testing.assert_close(counts, torch.full((10,), 0.1), atol=0.006, rtol=0)
    assert torch.corrcoef(drawn.T)[0, 1].abs() < 0.03


def test_normal_is_normal():
    drawn = Draws(0, 0).normal(20000, 2)
    assert (drawn.shape, drawn.dtype) == ((20000, 2), torch.float32)
    torch.testing.assert_close(drawn.mean(0), torch.zeros(2), atol=0.03, rtol=0)
    torch.testing.assert_close(drawn.std(0), torch.ones(2), atol=0.03, rtol=0)
    assert (drawn.abs() < 1).float().mean().item() == pytest.approx(0.6827, abs=0.01)


@pytest.mark.parametrize("high", [1, 7])
def test_integers_cover_their_range(high):
    counts = torch.bincount(Draws(0, 0).integers(high, 700 * high))
    assert len(counts) == high
    assert (counts - 700).abs().max() < 120


def test_one_number_for_all():
    assert torch.equal(FixedDraws(0.375).uniform(5, 2), torch.full((5, 2), 0.375))
    assert torch.equal(FixedDraws(0.375).normal(5, 2), torch.zeros(5, 2))


def test_seeded():
    def drawn(seed: int) -> torch.Tensor:
        with seeded(seed):
            return torch.rand(2)

    before = torch.get_rng_state()
    assert torch.equal(drawn(5), drawn(5))
    assert not torch.equal(drawn(5), drawn(6))
    with pytest.raises(ZeroDivisionError), seeded(5):
        raise ZeroDivisionError(torch.rand(1))
    assert torch.equal(torch.get_rng_state(), before)
