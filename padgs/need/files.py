"""The smallest file that a model can be kept in: each is written, read back and measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from padgs.need import tiers
from padgs.need.calibration import QUALITY, differences, objections
from padgs.need.search import Search
from padgs.training.model import Prunable

NAME = "model"  # of the file, before what its tier adds


@torch.no_grad()
def files(search: Search, model: Prunable, folder: Path, epsilon: float) -> list[dict[str, Any]]:
    """Of each tier, from the exact one on, what its file takes and shows; `model` is as it was afterwards.

    Only the smallest file as good as the exact one up to epsilon dB stays in the folder.

    Returns:
        file: its name; bytes; loss: mean WS-PSNR, dB, that it shows less of the calibration views than the exact one;
        test_ws_psnr: of the test views; objections: to it; kept: whether it is the one that stays.

    Raises:
        OSError, ValueError: one cannot be written or read.
    """
    stored = tiers.model_of(model)
    trained = {name: tensor.clone() for name, tensor in stored.state_dict().items()}
    found, exact = [], None
    for ending in tiers.endings(stored):
        path = folder / f"{NAME}{ending}"
        tiers.write(path, stored)
        tiers.read(path, stored)
        marks, test = search.scored(model)
        stored.load(trained)
        exact = exact or marks
        losses = differences(exact, marks, QUALITY)
        one = {"file": path.name, "bytes": path.stat().st_size, "loss": sum(losses) / len(losses)}
        one |= {"test_ws_psnr": test.get(QUALITY), "objections": list(objections(marks, exact, epsilon))}
        found.append(one)
    best = min((one for one in found if not one["objections"]), key=lambda one: one["bytes"])
    for one in found:
        one["kept"] = one is best
        if one is not best:
            (folder / one["file"]).unlink()
    return found
