"""Files of a trained model, from exact to small, that can be read back.

Our own hold its tensors with 32 or 16 bits, or with 8: these are relative to the extremes of 256 rows that lie close
together, and positions have 16. Those that other programs open are written, and read, by `padgs.apps.export.splat_file`.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from padgs.apps.export.splat_file import CONVERTED, CONVERTER, read_splats, write_splats
from padgs.methods.anchors.anchors import PaDGS
from padgs.methods.anchors.model import AnchorModel
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.training.model import Prunable

Model = Splats | PaDGS
WHOLE, HALF, BYTE = ".float32.npz", ".float16.npz", ".8bit.npz"  # endings of our own
OTHERS = (".compressed.ply", ".spz")  # of CONVERTED; without a GPU .sog takes minutes, and is larger than .spz
CHUNK = 256  # rows that share their extremes
POSITIONS = ("means", "positions")
CURVE_BITS = 10  # for each axis of the curve that puts neighbours side by side
LOWEST, STEP, ORDERED = "/lowest", "/step", "/codes"  # of a tensor's name, the arrays that it is stored as


def endings(model: Model) -> tuple[str, ...]:
    """Of the files that a model can be written to here; the first is exact."""
    others = OTHERS if isinstance(model, Splats) and shutil.which(CONVERTER) else ()
    return (WHOLE, HALF, BYTE, *others)


def model_of(trainee: Prunable) -> Model:
    """What of a trainee is stored.

    Raises:
        TypeError: it is of a kind that has no files here.
    """
    match trainee:
        case SplatModel():
            return trainee.splats
        case AnchorModel():
            return trainee.model
    raise TypeError(f"{type(trainee).__name__} has no files to compare: those of splats and of anchors have")


def write(path: Path, model: Model) -> None:
    """Write a model to a file whose name ends in one of `endings`.

    Raises:
        OSError, ValueError: it cannot be written.
    """
    if path.name.endswith(CONVERTED):
        assert isinstance(model, Splats), "offered for these only"
        write_splats(path, model)
        return
    arrays: dict[str, Any] = {name: tensor.detach().cpu().numpy() for name, tensor in model.state_dict().items()}
    if path.name.endswith(BYTE):
        arrays = _in_bytes(arrays, {*model.rows(), *POSITIONS})
    elif path.name.endswith(HALF):
        arrays = {name: array.astype(np.float16) for name, array in arrays.items()}
    np.savez_compressed(path, **arrays)


def read(path: Path, model: Model) -> None:
    """Have a model of the same options become what the file holds.

    Raises:
        OSError, ValueError: it cannot be read.
    """
    if path.name.endswith(CONVERTED):
        assert isinstance(model, Splats), "offered for these only"
        tensors: dict[str, Tensor] = read_splats(path, unit=model.unit).state_dict()
        used = tensors["sh_rest"].shape[1]  # files have the harmonics in use only
        rest = model.sh_rest.new_zeros(len(tensors["means"]), *model.sh_rest.shape[1:])
        rest[:, :used] = tensors["sh_rest"]
        tensors["sh_rest"] = rest
    else:
        with np.load(path) as arrays:
            tensors = {name: torch.from_numpy(array) for name, array in _decoded(arrays).items()}
    model.load(tensors)


def _in_bytes(arrays: Mapping[str, np.ndarray], rows: set[str]) -> dict[str, np.ndarray]:
    """Codes of what has rows, chunk by chunk of an order in which neighbours follow each other; half of all else."""
    order = _along_curve(next(arrays[name] for name in POSITIONS if name in arrays))
    starts = np.arange(0, len(order), CHUNK)
    found: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        if name not in rows or array.size == 0:
            found[name] = array.astype(np.float16)
            continue
        kind = np.uint16 if name in POSITIONS else np.uint8
        ordered = array[order]
        lowest, highest = np.minimum.reduceat(ordered, starts), np.maximum.reduceat(ordered, starts)
        step = ((highest - lowest) / np.iinfo(kind).max).clip(min=np.finfo(np.float32).tiny)
        chunks = np.arange(len(order)) // CHUNK
        codes = ((ordered - lowest[chunks]) / step[chunks]).round().clip(0, np.iinfo(kind).max).astype(kind)
        found |= {f"{name}{LOWEST}": lowest, f"{name}{STEP}": step, f"{name}{ORDERED}": codes}
    return found


def _decoded(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Tensors as float32, of codes as well."""
    found = {}
    for name in arrays:
        if name.endswith(ORDERED):
            name, codes = name.removesuffix(ORDERED), arrays[name]
            chunks = np.arange(len(codes)) // CHUNK
            found[name] = arrays[f"{name}{LOWEST}"][chunks] + arrays[f"{name}{STEP}"][chunks] * codes
        elif not name.endswith((LOWEST, STEP)):
            found[name] = arrays[name].astype(np.float32)
    return found


def _along_curve(points: np.ndarray) -> np.ndarray:
    """An order [N] of points [N, 3] in which neighbours mostly follow each other: Morton's, of their ranks by axis.

    Ranks, as a few points of a sky lie much farther off than all others.
    """
    ranks = points.argsort(0).argsort(0) * 2**CURVE_BITS // max(1, len(points))
    code = np.zeros(len(points), np.int64)
    for bit in range(CURVE_BITS):
        for axis in range(3):
            code |= (ranks[:, axis] >> bit & 1) << 3 * bit + axis
    return code.argsort(kind="stable")
