"""Replays on the CPU: what a graph would do, record and compute again in the same place, done there by hand."""

import copy

import pytest
import torch

from ctm_plugin.color.ctm import CTM
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.settings import CTMConfig, LossWeights
from ctm_plugin.draws import Draws
from ctm_plugin.gpu import replay


@pytest.fixture
def recordings(monkeypatch):
    """How often was recorded."""
    count = []

    def record(compute):
        count.append(None)
        found = [each.clone() for each in compute()]

        def again():
            for place, each in zip(found, compute(), strict=True):
                place.copy_(each)

        return compute(), again, found

    monkeypatch.setattr(replay, "may_record", lambda _: True)
    monkeypatch.setattr(replay, "record", record)
    return count


def step(ctm, number, rays=6, photometric=None):
    """Loss, target and gradients of a step whose rendering has a gradient of its own."""
    draws = Draws(0, number)
    rgb, logit = draws.uniform(rays, 3), draws.uniform(rays, 3).requires_grad_()
    terms, target = ctm.losses([logit.sigmoid(), logit.tanh()], rgb, photometric or Photometric(), draws.uniform)
    ctm.zero_grad()
    (2 * sum(terms.values())).backward()
    return [*terms.values(), target, logit.grad, *(each.grad for each in ctm.parameters())]


def test_steps_are_what_they_are_one_operator_at_a_time(recordings, monkeypatch):
    torch.manual_seed(0)
    ctm = CTM()
    replayed = [[each.clone() for each in step(ctm, number)] for number in range(4)]
    assert len(recordings) == 1
    monkeypatch.setattr(replay, "may_record", lambda _: False)
    for number, found in enumerate(replayed):
        torch.testing.assert_close(found, step(ctm, number))


def test_what_was_found_stays(recordings):
    torch.manual_seed(0)
    ctm = CTM()
    step(ctm, 0)
    first = step(ctm, 1)
    kept = [each.clone() for each in first]
    step(ctm, 2)
    for each, copied in zip(first[: -len([*ctm.parameters()])], kept, strict=False):
        torch.testing.assert_close(each, copied, rtol=0, atol=0)


def test_other_shapes_parameters_and_losses_are_recorded_anew(recordings):
    ctm = CTM()
    for number, rays in enumerate([6, 6, 5, 6]):
        step(ctm, number, rays)
    assert len(recordings) == 3
    step(ctm, 4, photometric=Photometric(weight=2.0))
    assert len(recordings) == 4
    moved = copy.deepcopy(ctm)
    step(moved, 5)
    assert len(recordings) == 5


def test_shapes_that_never_stay(recordings):
    ctm = CTM()
    for rays in range(4, 20):
        step(ctm, 0, rays)
    assert len(recordings) == replay.RECORDINGS


def test_without_gradients_and_without_terms(recordings):
    ctm = CTM()
    draws = Draws(0, 0)
    with torch.no_grad():
        ctm.losses([draws.uniform(6, 3)], draws.uniform(6, 3), Photometric(), draws.uniform)
    nothing = CTM(CTMConfig(weights=LossWeights(enc=0.0, dec=0.0, img=0.0, rand=0.0, latent=0.0)))
    assert nothing.losses([draws.uniform(6, 3)], draws.uniform(6, 3), Photometric(), draws.uniform).terms == {}
    assert recordings == []


def broken(compute):
    raise RuntimeError("no graphs here")


def wrong(compute):
    found = [2 * each for each in compute()]
    return compute(), lambda: None, found


@pytest.mark.parametrize(("record", "told"), [(broken, "no graphs here"), (wrong, "something else")])
def test_refused(record, told, recordings, monkeypatch):
    torch.manual_seed(0)
    ctm = CTM()
    monkeypatch.setattr(replay, "record", record)
    with pytest.warns(UserWarning, match=f"not replayed.*{told}"):
        found = step(ctm, 0)
    again = step(ctm, 0)
    torch.testing.assert_close(found, again)
    assert ctm.replay.recorded is None
