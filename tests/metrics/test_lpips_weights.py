import functools
import http.server
import socket
import threading
from pathlib import Path

import numpy as np
import pytest
import torch

from ctm_plugin.errors import DataError
from ctm_plugin.metrics import lpips_weights
from ctm_plugin.metrics.lpips import LPIPS, feature_network
from ctm_plugin.metrics.lpips_weights import load_lpips

NETS = ("alex", "vgg")


def features(net: str, seed: int = 0) -> dict[str, torch.Tensor]:
    torch.manual_seed(seed)
    return {f"features.{name}": value for name, value in feature_network(net).state_dict().items()}


@pytest.fixture(autouse=True)
def empty_hub(tmp_path, monkeypatch):
    """torch.hub's cache, empty at first."""
    hub = tmp_path / "hub"
    (hub / "checkpoints").mkdir(parents=True)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(hub))
    return hub / "checkpoints"


@pytest.mark.parametrize("net", NETS)
def test_state_dict_and_npz_give_the_same_model(tmp_path, net):
    weights = features(net)
    classifier = {"classifier.6.bias": torch.zeros(1000)}
    torch.save(weights | classifier, tmp_path / "w.pth")
    np.savez(tmp_path / "w.npz", **{name: value.numpy() for name, value in weights.items()})
    first, second = torch.rand(2, 40, 40, 3).unbind()
    distances = []
    for name in ("w.pth", "w.npz"):
        model, reason = load_lpips(tmp_path / name, net)
        assert reason == ""
        assert not model.training
        distances.append(model(first, second))
    assert torch.equal(*distances)
    assert distances[0] > 0


@pytest.mark.parametrize("net", NETS)
def test_heads_are_the_released_ones(tmp_path, ctm_data, net):
    torch.save(features(net), tmp_path / "w.pth")
    model, _ = load_lpips(tmp_path / "w.pth", net)
    with np.load(ctm_data / "lpips" / "lpips_v0.1_heads.npz") as released:
        arrays = {name: released[name] for name in released.files if name.startswith(net)}
    assert len(arrays) == len(model.heads) == 5
    for layer, head in enumerate(model.heads):
        (expected,) = (value for name, value in arrays.items() if f"lin{layer}" in name)
        np.testing.assert_array_equal(head.numpy().ravel(), expected.ravel())


BROKEN = {
    "text": lambda path: path.write_text("not weights"),
    "empty": lambda path: path.touch(),
    "list": lambda path: torch.save([1, 2], path),
    "object": lambda path: torch.save(LPIPS("alex"), path),
    "other keys": lambda path: torch.save({"conv.weight": torch.zeros(3)}, path),
    "other network": lambda path: torch.save(features("vgg"), path),
    "wrong shape": lambda path: torch.save(features("alex") | {"features.0.bias": torch.zeros(63)}, path),
    "nan": lambda path: torch.save(features("alex") | {"features.0.bias": torch.full((64,), torch.nan)}, path),
}
"""Writers of files that are no weights."""


@pytest.mark.parametrize("suffix", [".pth", ".npz"])
@pytest.mark.parametrize("what", BROKEN)
def test_an_unusable_file_is_an_error_that_names_it_in_a_line(tmp_path, what, suffix):
    path = tmp_path / f"broken{suffix}"
    BROKEN[what](path)
    with pytest.raises(DataError, match="broken") as told:
        load_lpips(path)
    assert "\n" not in str(told.value)


def test_heads_that_torchmetrics_lacks_are_not_blamed_on_the_file(tmp_path, monkeypatch):
    torch.save(features("alex"), tmp_path / "w.pth")
    monkeypatch.setattr(lpips_weights.torchmetrics, "__file__", str(tmp_path / "torchmetrics" / "__init__.py"))
    with pytest.raises(DataError, match=r"torchmetrics/.*/alex\.pth: found .*, expected the weights of LPIPS' heads"):
        load_lpips(tmp_path / "w.pth")
    assert "alex.pth: FileNotFoundError" in load_lpips()[1]
    assert "lpips_weights" not in load_lpips()[1]


@pytest.mark.parametrize("given", [True, False])
def test_a_bug_is_not_taken_for_missing_weights(tmp_path, monkeypatch, empty_hub, given):
    path = tmp_path / "w.pth" if given else empty_hub / lpips_weights.URLS["alex"].rpartition("/")[2]
    torch.save(features("alex"), path)
    monkeypatch.setattr(lpips_weights, "read_weights", lambda path: path.no_such_method())
    with pytest.raises(AttributeError, match="no_such_method"):
        load_lpips(path if given else None)


def test_a_missing_file_is_an_error(tmp_path):
    with pytest.raises(DataError, match=r"nowhere\.npz: found no file"):
        load_lpips(tmp_path / "nowhere.npz")


# torch.hub: its cache, a download, neither


@pytest.mark.parametrize("net", NETS)
def test_hub_cache_is_used(empty_hub, net):
    torch.save(features(net), empty_hub / lpips_weights.URLS[net].rpartition("/")[2])
    model, reason = load_lpips(net=net)
    assert (model.net, reason) == (net, "")


@pytest.fixture
def published(tmp_path, monkeypatch):
    """``published(name)``: a file that a server has in place of torchvision's."""
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()

        def publish(name: str) -> Path:
            url = f"http://127.0.0.1:{running.server_port}/{name}"
            monkeypatch.setitem(lpips_weights.URLS, "alex", url)
            return tmp_path / name

        yield publish
        running.shutdown()


def test_download_goes_to_the_cache_after_one_line(published, empty_hub, capsys):
    lpips_weights._announce.cache_clear()
    torch.save(features("alex"), published("alexnet-owt.pth"))
    model, reason = load_lpips()
    assert (model.net, reason) == ("alex", "")
    assert (empty_hub / "alexnet-owt.pth").is_file()
    host = lpips_weights.URLS["alex"].split("/")[2]
    line = f"LPIPS, one of the scores, needs 233 MB from {host}, once; if they cannot be had, it is left out\n"
    said = capsys.readouterr()
    assert said.err.startswith(line)
    assert "Downloading" not in said.out + said.err
    load_lpips()
    assert capsys.readouterr() == ("", "")


def test_download_with_the_wrong_hash_is_a_reason_and_leaves_no_file(published, empty_hub):
    torch.save(features("alex"), published("alexnet-owt-00000000.pth"))
    model, reason = load_lpips()
    assert model is None
    assert "invalid hash value" in reason
    assert not list(empty_hub.iterdir())


@pytest.mark.parametrize("what", ["text", "other network"])
def test_a_download_that_cannot_be_used_is_a_reason(published, what):
    BROKEN[what](published("alexnet-owt.pth"))
    model, reason = load_lpips()
    assert model is None
    assert f"{lpips_weights.URLS['alex']}: " in reason


def test_a_download_that_fails_twice_is_told_once(published, empty_hub, capsys):
    lpips_weights._announce.cache_clear()
    BROKEN["text"](published("alexnet-owt-00000000.pth"))
    assert [load_lpips()[0] for _ in range(2)] == [None, None]
    assert capsys.readouterr().err.count("needs 233 MB") == 1


def test_a_server_that_never_answers_costs_only_the_timeout(monkeypatch):
    monkeypatch.setattr(lpips_weights, "TIMEOUT_S", 0.3)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        monkeypatch.setitem(lpips_weights.URLS, "alex", f"http://127.0.0.1:{silent.getsockname()[1]}/alexnet.pth")
        assert "timed out" in load_lpips()[1]
    assert socket.getdefaulttimeout() is None


def test_without_cache_and_network_the_reason_says_what_to_set():
    model, reason = load_lpips()
    assert model is None
    assert f"{lpips_weights.URLS['alex']}: URLError: " in reason
    assert "set metrics.lpips_weights to a file" in reason
