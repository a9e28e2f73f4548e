from types import SimpleNamespace

import pytest
import torch

from ctm_plugin.gpu.room import times_a_chunk


@pytest.mark.parametrize(("gibibytes", "times"), [(4, 1), (8, 1), (24, 3), (80, 10), (141, 16)])
def test_larger_cards_take_more_at_once(gibibytes, times, monkeypatch):
    found = SimpleNamespace(total_memory=gibibytes << 30)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: found)
    assert times_a_chunk(torch.device("cuda")) == times
    assert times_a_chunk(torch.device("cpu")) == 1
