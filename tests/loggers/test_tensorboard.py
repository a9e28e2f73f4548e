"""What TensorBoard knows of runs beside their curves: its own code reads the events back."""

import json
import re
from pathlib import Path

import pytest
from callbacks.toy import small_ctm
from tensorboard.backend.event_processing import plugin_event_multiplexer
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.custom_scalar.custom_scalars_plugin import CustomScalarsPlugin
from tensorboard.plugins.hparams import api_pb2
from tensorboard.plugins.hparams.backend_context import Context
from tensorboard.plugins.hparams.list_session_groups import Handler

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.loggers.services import TensorBoard, layout
from ctm_plugin.runs.rundir import METRICS
from ctm_plugin.runs.train import hyperparameters, resume, train

SMALL = ("backbone.coarse=false", "backbone.steps_alone=4", "backbone.grow=[]", "trainer.log_every=2")


@pytest.fixture(scope="module")
def runs(compose, tmp_path_factory) -> Path:
    """Two runs of DVGO, without CTM and with it, which weighs more."""
    folder = tmp_path_factory.mktemp("runs")
    for ctm, weight in (("off", 1), ("on", 2)):
        train(compose(*SMALL, f"ctm={ctm}", f"loss.weight={weight}", "dataset.exposure=0.1"), folder / ctm)
    return folder


def loaded(folder: Path) -> TBContext:
    """As the server sees a folder of runs."""
    multiplexer = plugin_event_multiplexer.EventMultiplexer().AddRunsFromDirectory(str(folder))
    multiplexer.Reload()
    return TBContext(data_provider=MultiplexerDataProvider(multiplexer, str(folder)), logdir=str(folder))


def table(folder: Path) -> tuple[api_pb2.Experiment, dict[str, api_pb2.SessionGroup]]:
    """Columns and rows of the table of hyperparameters."""
    context = Context(loaded(folder))
    tags = context.hparams_metadata(RequestContext(), "")
    experiment = context.experiment_from_metadata(RequestContext(), "", True, tags, [])
    request = api_pb2.ListSessionGroupsRequest(
        allowed_statuses=[api_pb2.STATUS_SUCCESS], slice_size=10, include_metrics=True,
        col_params=[api_pb2.ColParams(metric=api_pb2.MetricName(tag="final/psnr"), order=api_pb2.ORDER_DESC)],
    )  # fmt: skip
    return experiment, Handler(RequestContext(), context, "", request).run().session_groups


def plain(values) -> dict[str, float | str]:
    return {name: getattr(value, value.WhichOneof("kind")) for name, value in values.items()}


def test_the_layout_of_several_runs_is_that_of_one(runs):
    layouts = [CustomScalarsPlugin(loaded(each)).layout_impl(RequestContext(), "") for each in (runs / "on", runs)]
    assert layouts[0] == layouts[1]
    found = json.loads(layouts[0])["category"]
    assert [category["title"] for category in found] == list(layout())
    for category in found:
        charts = {chart["title"]: ["Multiline", chart["multiline"]["tag"]] for chart in category["chart"]}
        assert charts == layout()[category["title"]]


def test_every_curve_has_one_chart(runs):
    read = EventMultiplexer({ctm: str(runs / ctm / "tensorboard") for ctm in ("off", "on")}).Reload().Runs()
    off, on = (set(read[ctm]["scalars"]) for ctm in ("off", "on"))
    expressions = [expression for charts in layout().values() for _, (expression,) in charts.values()]
    for tag in off | on:
        assert sum(re.match(each, tag) is not None for each in expressions) == 1, tag
    assert off - on == {"loss/color"}
    assert on - off == {"lr/ctm", *(f"loss/{term}" for term in ("enc", "dec", "img", "rand", "latent"))}


def test_settings_with_final_scores(runs):
    experiment, rows = table(runs)
    differing = {info.name for info in experiment.hparam_infos if info.differs}
    fixed = {f"ctm.{key}" for key in ("P", "lr", "weights.enc", "weights.dec", "weights.img", "weights.rand")}
    assert differing == {"ctm", "ctm.weights.latent", "loss.weight", *fixed}
    assert {info.name.tag.partition("/")[0] for info in experiment.metric_infos} == {"final"}  # no curves
    assert len(rows) == 2
    found = [plain(row.hparams) for row in rows]
    metrics = {ctm: json.loads((runs / ctm / METRICS).read_text()) for ctm in ("off", "on")}
    assert metrics[found[0]["ctm"]]["psnr"] >= metrics[found[1]["ctm"]]["psnr"]  # sorted by it
    for settings, row in zip(found, rows, strict=True):
        assert row.name == f"{settings['ctm']}/tensorboard/final"
        scores = {value.name.tag.removeprefix("final/"): value.value for value in row.metric_values}
        expected = {k: v for k, v in metrics[settings["ctm"]].items() if isinstance(v, float)}
        assert scores == pytest.approx(expected)
        assert {"psnr", "ssim", "depth_mae", "train_seconds"} <= scores.keys()
        common = {"dataset": "ball", "backbone": "dvgo", "seed": 0, "steps": 4, "color_space": "rgb", "loss": "mse"}
        assert {key: settings[key] for key in common} == common
        assert settings["exposure"] == pytest.approx(0.1)
        assert settings["backbone.lr_mlp"] == 0.001
    off, on = sorted(found, key=lambda settings: settings["ctm"])
    assert (off["loss.weight"], on["loss.weight"]) == (1.0, 2.0)
    assert {key for key in on if key.startswith("ctm.weights")} <= off.keys() < on.keys()  # a place on every axis
    assert "ctm.pretrain_steps" in on  # as a plug-in's own keys are
    keys = ("ctm.k", "ctm.P", "ctm.lr", "ctm.weights.enc", "ctm.weights.img")
    assert [off[key] for key in keys] == [3, 0, 0, 0, 0]
    assert [on[key] for key in keys] == [3, 4, 0.0005, 1, 10000]


def test_scored_again_the_new_scores_stand_in_the_place_of_the_old(compose, tmp_path):
    run = tmp_path / "run"
    result = train(compose(*SMALL, "ctm=off"), run)
    resume(run)
    TensorBoard(TensorBoard.Config(), run, 4).log_scores({"ctm": "off"}, result | {"psnr": 12.5})
    events = EventMultiplexer({"run": str(run / "tensorboard")}).Reload()
    row = EventMultiplexer({"row": str(run / "tensorboard" / "final")}).Reload()
    assert [event.value for event in row.Scalars("row", "final/psnr")] == [12.5]
    assert [event.step for event in events.Scalars("run", "loss/total")] == [2, 4]


def test_plug_ins_without_our_keys():
    config = {"backbone": {"name": "tiny", "wide": True, "sizes": [1]}, "dataset": {"name": "d"}, "seed": 1}
    config |= {"ctm": {"name": "another", "weights": [1, 2], "P": [3]}, "loss": {}, "color_space": {"name": "rgb"},
               "appearance": {"name": "none"}}  # fmt: skip
    result = {"dataset": "d", "backbone": "tiny", "ctm": "another", "color_space": "rgb", "steps": 3,
              "appearance": "none"}  # fmt: skip
    config["ctm"]["strength"], config["loss"]["weight"] = 2.0, 43.0
    found = hyperparameters(config, Backbone(small_ctm(k=4)), result)
    assert (found["exposure"], found["ctm.k"], found["ctm.weights.enc"], found["loss"]) == (1.0, 4, 0.0, "mse")
    assert (found["ctm.strength"], found["loss.weight"]) == (2.0, 43.0)
    assert "ctm.P" not in found  # a list has no place on an axis
    assert {key: value for key, value in found.items() if key.startswith("backbone.")} == {"backbone.wide": "true"}
