"""Where LPIPS' weights come from: the heads out of torchmetrics' package, the network out of a file or torch.hub.

The network's weights (233 MB for AlexNet, 528 MB for VGG-16) are not shipped. In order: the file the user names,
torch.hub's cache, torchvision's published file. A machine without any of them runs without LPIPS and says why.
"""

from __future__ import annotations

import functools
import socket
import threading
import urllib.request
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ctm_plugin.errors import CTMError, DataError
from ctm_plugin.files import check_zip
from ctm_plugin.metrics.lpips import LPIPS, Net
from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import check_choice

# The eight digits in a name are the start of the file's SHA-256, which torch.hub checks.
URLS = {
    "alex": "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
    "vgg": "https://download.pytorch.org/models/vgg16-397923af.pth",
}
CACHED = {"alex": "alexnet-owt*.pth", "vgg": "vgg16-*.pth"}
TIMEOUT_S = 4.0
MOST = 2**30
"""Bytes that a file of weights may hold, unpacked: VGG-16 has half as many."""


def load_lpips(path: str | Path | None = None, net: Net = "alex", download: bool = True) -> tuple[LPIPS | None, str]:
    """A ready LPIPS model, or the reason why there is none.

    Args:
        path: file with the network's weights, torchvision's ``features.*`` keys: ``.npz``, or a state dict saved by
            torch. ``None`` looks in torch.hub's cache and then downloads.
        net: ``alex`` or ``vgg``.
        download: whether to try torchvision's published file. Without a network this gives up in ``TIMEOUT_S``.

    Returns:
        ``(model, "")``, or ``(None, reason)`` where no weights were found and ``path`` was not given.

    Raises:
        DataError: ``path`` cannot be read, or does not hold this network's convolutions.
    """
    try:
        heads = _shipped_heads(net)
    except CTMError as error:
        return None, str(error)
    if path is not None:
        return _build(net, Path(path), read_weights(Path(path)), heads), ""

    tried = []
    for cached in sorted(Path(torch.hub.get_dir(), "checkpoints").glob(CACHED[net])):
        try:
            return _build(net, cached, read_weights(cached), heads), ""
        except CTMError as error:
            tried.append(str(error))
    if not tried:
        tried.append("no file in torch.hub's cache")
    if not download:
        tried.append("download not allowed")
    elif not _reachable(URLS[net]):
        tried.append(f"{URLS[net]} cannot be reached")
    else:
        try:
            return _build(net, Path(URLS[net]), _download(URLS[net]), heads), ""
        except Exception as error:  # unpicklers raise anything on a damaged file, one in the cache too
            tried.append(f"{URLS[net]}: {type(error).__name__}: {' '.join(str(error).split())[:200]}")
    return None, f"no weights for LPIPS ({net}): {'; '.join(tried)}; set metrics.lpips_weights to a file"


def read_weights(path: Path) -> dict[str, Tensor]:
    """Read the ``features.*`` arrays of a file, float32, without running code that the file may hold.

    Kernels are ``[out, in, height, width]``, biases ``[out]``; :class:`~ctm_plugin.metrics.lpips.LPIPS` checks them.

    Raises:
        DataError: missing, unreadable, or without such arrays.
    """
    if not path.is_file():
        raise DataError(path, found="no file", expected="weights of LPIPS' network (.npz or .pth)")
    try:
        if zipfile.is_zipfile(path):
            check_zip(path, MOST)
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as arrays:
                weights = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
        else:
            weights = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # unpicklers raise anything on a damaged file
        found = f"an unreadable file ({type(error).__name__})"
        raise DataError(path, found=found, expected="an .npz or a state dict saved by torch") from error
    if not isinstance(weights, dict) or not all(isinstance(value, Tensor) for value in weights.values()):
        raise DataError(path, found="something else", expected="a flat dict of tensors")
    features = {name: value.float() for name, value in weights.items() if str(name).startswith("features.")}
    if not features:
        raise DataError(path, found=f"keys {sorted(map(str, weights))[:3]}", expected="keys 'features.0.weight', ...")
    return features


def _build(net: Net, origin: Path, features: dict[str, Tensor], heads: list[Tensor]) -> LPIPS:
    model = LPIPS(net)
    try:
        model.features.load_state_dict({name.removeprefix("features."): value for name, value in features.items()})
    except RuntimeError as error:
        found = "weights of another network: " + " ".join(str(error).split())[:200]
        raise DataError(origin, found=found, expected=f"the convolutions of LPIPS' {net} network") from error
    if not all(bool(value.isfinite().all()) for value in model.features.parameters()):
        raise DataError(origin, found="NaN or infinite weights", expected="finite ones")
    for parameter, head in zip(model.heads, heads, strict=True):
        parameter.data.copy_(head)
    return model.eval()


def _shipped_heads(net: Net) -> list[Tensor]:
    """The five linear heads of LPIPS v0.1 inside torchmetrics' package, each ``[1, C, 1, 1]``."""
    resource = files("torchmetrics") / "functional" / "image" / "lpips_models" / f"{net}.pth"
    try:
        with as_file(resource) as path:
            state = torch.load(path, map_location="cpu", weights_only=True)
        return [state[f"lin{layer}.model.1.weight"] for layer in range(5)]
    except Exception as error:  # another torchmetrics may have moved or changed the file
        raise CTMError(f"no LPIPS heads in the installed torchmetrics ({type(error).__name__}: {error})") from error


@functools.cache
def _reachable(url: str) -> bool:
    """Whether the server answers in ``TIMEOUT_S``. In a thread, because a name look-up cannot be given a timeout."""
    answered = threading.Event()

    def ask() -> None:
        try:
            with urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=TIMEOUT_S):
                answered.set()
        except OSError:
            pass

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(TIMEOUT_S)
    return answered.is_set()


def _download(url: str) -> dict[str, Tensor]:
    with _socket_timeout(TIMEOUT_S):  # torch.hub sets none: a server that goes silent would block for ever
        state = torch.hub.load_state_dict_from_url(
            url, map_location="cpu", progress=False, check_hash=True, weights_only=True
        )
    return {name: value for name, value in state.items() if name.startswith("features.")}


@contextmanager
def _socket_timeout(seconds: float) -> Iterator[None]:
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(seconds)
    try:
        yield
    finally:
        socket.setdefaulttimeout(before)


@dataclass(frozen=True, kw_only=True)
class MetricsConfig:
    """How test views are scored."""

    lpips_weights: str | Path | None = setting(
        None, "file (.npz or .pth) with AlexNet's or VGG's convolutions; null: torch.hub's cache, else a download"
    )
    lpips_net: str = setting("alex", "network that LPIPS compares with: alex or vgg")

    def __post_init__(self) -> None:
        check_choice("metrics.lpips_net", self.lpips_net, ("alex", "vgg"))
