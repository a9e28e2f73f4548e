"""``benchmarks/step.py``, and the steps of ``kernels.py``: they run, and their figures agree with one another."""

import json

import pytest
import torch
from pages import load
from torch.autograd import DeviceType
from torch.autograd.profiler_util import FunctionEvent

from ctm_plugin import door
from ctm_plugin.backbones import dvgo, ngp
from ctm_plugin.errors import CTMError

BRIEF = ("steps=2", "warm_up=4")
DVGO = ("backbone.coarse=false", "backbone.rays=16", "backbone.voxels=32768", "backbone.grow=[]")
PLANAR = ("trainer=smoke", "dataset.height=48", "dataset.width=64", "dataset.patch=24")


@pytest.fixture
def step(monkeypatch):
    """The script, without a process for each measurement, and with little to profile."""
    module = load("benchmarks/step.py")
    monkeypatch.setattr(module, "apart", module._measure)
    monkeypatch.setattr(module, "PROFILED", 2)
    return module


@pytest.mark.slow
@pytest.mark.parametrize(("backbone", "given"), [("dvgo", DVGO), ("barf2d", PLANAR)])
def test_figures_agree_with_one_another(step, backbone, given, ball, tmp_path, capsys):
    data = [] if backbone == "barf2d" else ["dataset=blender", f"dataset.root={ball}"]
    out = tmp_path / "found.json"
    step.main([f"backbones={backbone}", *BRIEF, f"out={out}", *data, *given])
    found = json.loads(out.read_text())[backbone]
    for side in (found["off"], found["on"]):
        assert set(side["parts_ms"]) == set(step.PARTS)
        assert sum(side["parts_ms"].values()) == pytest.approx(side["step_ms"])
        assert side["view_ms"] > 0
        assert 0 < side["product_tflop"] == pytest.approx(side["product_tflops"] * side["step_ms"] / 1e3)
    sides = found["on"]["step_ms"], found["off"]["step_ms"]
    assert found["ratio"] == pytest.approx(sides[0] / sides[1], rel=1e-12)  # of the one turn that two steps are
    told = capsys.readouterr().out
    assert "rays per second" in told
    assert "kernels and copies" not in told
    for side in (found["off"], found["on"]):
        side |= {"device_ms": 2.5, "launches": {"cudaLaunchKernel": 7.0, "cudaMemcpyAsync": 2.0}}
    step.Console().print(step.step_table(found))
    lines = [[cell.strip() for cell in line.split("│")] for line in capsys.readouterr().out.splitlines()]
    assert ["", "kernels and copies", "2.50 ms", "2.50 ms", "1.000", ""] in lines
    assert ["", "launches of a step", "9", "9", "1.000", ""] in lines


def test_a_machine_that_changes_its_speed_leaves_the_ratio_as_it_is(step):
    off = [10.0 * speed for speed in (1.0, 1.0, 3.0, 3.0, 1.0, 1.0, 2.0, 2.0)]
    on = [500.0, *(1.2 * each for each in off[1:])]  # one turn that something else disturbed
    assert step.ratio(on, off) == pytest.approx(1.2)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["backbones=dvgo", "ctm=off"], "a transform to compare with"),
        (["backbones=dvgo", "ctm=on", "ctm.k=4"], "ctm.k"),
        (["steps=few"], "step.steps: found 'few', expected an integer"),
    ],
)
def test_bad_input(step, given, expected):
    with pytest.raises(CTMError, match=expected):
        step.main([*given, *DVGO])


def test_the_time_of_a_gpu_is_that_of_its_kernels():
    """Once: not that of what launched them too, nor of a range with gaps."""

    def event(name, start, end, device=DeviceType.CUDA, **more):
        return FunctionEvent(len(events), name, 0, start, end, device_type=device, **more)

    events: list[FunctionEvent] = []
    for start in (0, 5000):
        host = [
            event("aten::addmm", start, start + 90, DeviceType.CPU, flops=3_000_000),
            event("aten::mul", start, start + 90, DeviceType.CPU, flops=5_000_000),
            event("cudaLaunchKernel", start + 10, start + 20, DeviceType.CPU),
            event("cuLaunchKernelEx", start + 20, start + 30, DeviceType.CPU),
            event("cudaMemcpyAsync", start + 30, start + 40, DeviceType.CPU),
            event("aten::_local_scalar_dense", start + 40, start + 80, DeviceType.CPU),
            event("cudaStreamSynchronize", start + 50, start + 80, DeviceType.CPU),
            event("cudaDeviceSynchronize", start + 90, start + 95, DeviceType.CPU),  # the profiler's own
        ]
        host[0].append_kernel("gemm", 0, 700)
        device = [event(name, start, start + 700) for name in ("gemm", "Memcpy DtoH")]
        events += [*host, *device, event("ctm/field", start, start + 4000, is_user_annotation=True)]
    found = load("benchmarks/launches.py").per_step(events, 2)
    assert found == {
        "launches": {"cudaLaunchKernel": 1, "cuLaunchKernelEx": 1, "cudaMemcpyAsync": 1},
        "waits": {"cudaStreamSynchronize": 1},
        "items": 1,
        "device_ms": pytest.approx(1.4),
        "longest_ms": {"gemm": pytest.approx(0.7), "Memcpy DtoH": pytest.approx(0.7)},
        "product_tflop": pytest.approx(3e-6),
    }


@pytest.mark.parametrize(
    ("backbone", "config"),
    [
        (dvgo.DVGO, dvgo.DVGOConfig(coarse=False, grow=(), rays=8, voxels=512)),
        (ngp.NGP, ngp.NGPConfig(rays=8, samples=16, levels=2, log2_entries=6, finest=32, cells=512)),
    ],
)
def test_steps_with_kernels_and_without_take_turns(backbone, config, monkeypatch):
    subject = load("benchmarks/kernels.py")
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    for name, count in (("WARM_UP", 1), ("STEPS", 3), ("STEP_TURNS", 2)):
        monkeypatch.setattr(subject, name, count)
    step, may, used = subject.training(backbone(config, subject.ball(3, 10))), door.may_launch, []

    def watched():
        used.append(door.may_launch is may)
        step()

    times = subject.steps_in_turns(watched)
    assert used == [True, *[*[True] * 4, *[False] * 4] * 2]
    assert min(times.values()) > 0
    assert subject.profiled(step, torch.device("cpu"), 1)["product_tflop"] > 0
