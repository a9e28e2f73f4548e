"""Width and budget out of real steps and minutes."""

import time

import pytest
import torch

from ctm_plugin.runs.assemble import assemble
from ctm_plugin.workflows import plan as module
from ctm_plugin.workflows.plan import BUDGET_STEPS, COLUMNS, MAX_COLUMNS, REFERENCE, Plan, Timed, plan, timed_steps

PHOTOS = (3000, 4000)


@pytest.mark.parametrize("slower", [0.3, 1.0, 4.0])
def test_more_minutes_give_larger_pictures_and_more_steps(slower):
    timed = Timed(slower * REFERENCE.seconds, REFERENCE.pixels)
    plans = [plan(PHOTOS, minutes, timed) for minutes in (0.05, 0.3, 1.0, 3.0, 10.0, 60.0, 600.0)]
    widths = {budget: [each.width for each in plans if each.budget == budget] for budget in BUDGET_STEPS}
    assert all(each == sorted(each) for each in widths.values())
    assert plans[0][:2] == (COLUMNS["quick"], "quick")
    assert "minutes=0.01 is too short here: it takes about" in plan(PHOTOS, 0.01, timed).told
    assert plans[-1][:2] == (MAX_COLUMNS, "standard")
    assert plan((300, 400), 600.0, timed) == Plan(400, "standard")  # never larger than the photographs


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("minutes", [1.5, 6.0, 12.0])
def test_what_is_chosen_takes_so_many_minutes(minutes, threads):
    found = plan(PHOTOS, minutes, REFERENCE, threads)
    assert COLUMNS[found.budget] < found.width < MAX_COLUMNS
    assert module._minutes(PHOTOS, found.width, found.budget, REFERENCE, threads) == pytest.approx(minutes, rel=0.02)
    wider, more = (part.partition("=")[2] for part in found.told.split(": ")[1].split())
    budget = "standard" if int(wider) >= COLUMNS["standard"] else "quick"
    takes = module._minutes(PHOTOS, int(wider), budget, REFERENCE, threads)
    assert takes <= int(more) < takes + 1


def test_a_width_that_is_given_stays():
    assert plan((750, 1000), 60.0, REFERENCE, given=True) == Plan(1000, "standard")
    assert plan((750, 1000), 0.1, REFERENCE, given=True).width == 1000
    assert plan((1200, 1600), 10.0, None) == Plan(MAX_COLUMNS, "standard")  # a GPU


def test_a_step_is_timed_by_what_it_computes_itself(compose, monkeypatch):
    """Other programs change nothing: time that passes while it rests does not count."""
    parts = assemble(compose("backbone=splat", "ctm=off"))
    step = parts.backbone.training_step

    def rests(*arguments):
        time.sleep(0.1)
        return step(*arguments)

    monkeypatch.setattr(parts.backbone, "training_step", rests)
    before = torch.get_num_threads()
    found = timed_steps(parts)
    assert 0 < found.seconds < 0.1
    assert found.pixels == 144
    assert torch.get_num_threads() == before
