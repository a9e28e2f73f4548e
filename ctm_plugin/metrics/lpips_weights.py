"""LPIPS' weights: the heads out of torchmetrics' package, the network out of a file or by torch.hub."""

from __future__ import annotations

import socket
import sys
import zipfile
from collections.abc import Mapping
from functools import cache
from http.client import HTTPException
from pathlib import Path, PurePosixPath
from pickle import UnpicklingError
from urllib.parse import urlsplit

import numpy as np
import torch
import torchmetrics
from torch import Tensor

from ctm_plugin.errors import DataError
from ctm_plugin.files import check_zip
from ctm_plugin.metrics.lpips import LPIPS, Net

# The eight digits in a name are the start of the file's SHA-256, which is checked.
URLS = {
    "alex": "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
    "vgg": "https://download.pytorch.org/models/vgg16-397923af.pth",
}
"""Addresses of the networks' weights."""
MEGABYTES = {"alex": 233, "vgg": 528}
"""Size in megabytes of the file of each network's weights."""
HEAD_FILE = "functional/image/lpips_models/{}.pth"
"""Path inside torchmetrics of the weights of LPIPS' linear layers."""
LOAD_ERRORS = (DataError, OSError, HTTPException, EOFError, UnpicklingError, KeyError, ValueError, RuntimeError)
"""Errors of reading or downloading a file of weights, and of a network that is given other weights."""
TIMEOUT_S = 4.0
"""Seconds without an answer after which a download is given up."""
MAX_BYTES = 2**30
"""Most bytes of a file of weights, unpacked: VGG-16 has half as many."""


def load_lpips(path: str | Path | None = None, net: Net = "alex") -> tuple[LPIPS | None, str]:
    """A ready LPIPS model, or the reason why there is none.

    Args:
        path: file with the network's weights, torchvision's ``features.*`` keys: ``.npz``, or a state dict saved by
            torch. ``None``: torchvision's published file, in torch.hub's cache or downloaded to it.
        net: ``alex`` or ``vgg``.

    Returns:
        ``(model, "")``, or ``(None, reason)`` where ``path`` was not given and nothing could be had.

    Raises:
        DataError: ``path`` cannot be read, or does not hold this network's convolutions; or torchmetrics lacks the
            heads, its own file of which is named.
    """
    model = LPIPS(net)
    source, what = Path(torchmetrics.__file__).parent / HEAD_FILE.format(net), "heads, which torchmetrics has"
    try:
        heads = torch.load(source, map_location="cpu", weights_only=True)
        for layer, parameter in enumerate(model.heads):
            parameter.copy_(heads[f"lin{layer}.model.1.weight"])
        source, what = path or URLS[net], f"{net} network, as .npz or saved by torch"
        weights = read_weights(_download(net) if path is None else Path(path))
        model.features.load_state_dict(
            {name.removeprefix("features."): each for name, each in weights.items() if name.startswith("features.")}
        )
        if not all(bool(value.isfinite().all()) for value in model.features.parameters()):
            raise ValueError("NaN or infinite weights")
    except LOAD_ERRORS as error:
        warning = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        if path is None:
            advice = "; set metrics.lpips_weights to a file" if source == URLS[net] else ""
            return None, f"no weights for LPIPS ({net}): {source}: {warning}{advice}"
        if isinstance(error, DataError):
            raise
        raise DataError(source, f"no such weights ({warning})", f"the weights of LPIPS' {what}") from error
    return model.eval(), ""


def read_weights(path: Path) -> Mapping[str, Tensor]:
    """Read a file's arrays [...] by name, without running code that the file may hold.

    Raises:
        DataError: missing or unreadable.
    """
    if not path.is_file():
        raise DataError(path, found="no file", expected="weights of LPIPS' network (.npz or .pth)")
    try:
        if zipfile.is_zipfile(path):
            check_zip(path, MAX_BYTES)
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as arrays:
                return {name: torch.from_numpy(arrays[name]) for name in arrays.files}
        return {str(name): each for name, each in torch.load(path, map_location="cpu", weights_only=True).items()}
    except Exception as error:  # unpicklers raise anything on a damaged file
        found = f"an unreadable file ({type(error).__name__})"
        raise DataError(path, found=found, expected="an .npz or a state dict saved by torch") from error


def _download(net: Net) -> Path:
    """Find torchvision's weights in torch.hub's cache, or download them there after a line that says so."""
    url = URLS[net]
    path = Path(torch.hub.get_dir(), "checkpoints", PurePosixPath(url).name)
    if path.exists():
        return path
    _announce(net)
    path.parent.mkdir(parents=True, exist_ok=True)
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(TIMEOUT_S)  # torch.hub sets none: a server that goes silent would block for ever
    try:
        known = torch.hub.HASH_REGEX.search(path.name)
        torch.hub.download_url_to_file(url, str(path), known and known[1], progress=False)
    finally:
        socket.setdefaulttimeout(before)
    return path


@cache
def _announce(net: Net) -> None:
    """Tell what is downloaded, once in a process: the demo has three runs, of which each asks for it."""
    size = f"{MEGABYTES[net]} MB from {urlsplit(URLS[net]).netloc}"
    print(f"LPIPS, one of the scores, needs {size}, once; if they cannot be had, it is left out", file=sys.stderr)
