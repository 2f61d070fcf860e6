"""Every golden render case on every backend: values, number of pairs, derivatives.

The cases, made by another program in float64, lie beside the checkout. They say themselves where a decision is so near
that rounding may take it: pixels that are not `stable`, `close_pairs`, gradients that are not `valid`.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from support.render_cases import INPUTS, engines, view_of

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Camera, Panorama, Pinhole
from padgs.render import RenderOptions, render
from padgs.render.projection import PROJECTIONS, SLOPE_LIMIT

FOLDER = Path(__file__).resolve().parents[2].parent / "shared" / "golden"
CASES = sorted(path.stem for projection in PROJECTIONS for path in FOLDER.glob(f"{projection}_*.npz"))
VALUE_TOLERANCE, DEPTH_TOLERANCE, GRADIENT_TOLERANCE = 2e-5, 1e-4, 2e-3


def options_of(meta: dict) -> RenderOptions:
    """Return the options of a case; unknown meta keys raise an error."""
    option_of = {
        "projection": "projection",
        "near": "near",
        "wrap": "wrap",
        "dilation": "low_pass",
        "filter_variance": "low_pass",
    }
    described = {"format", "scene", "width", "height", "margin", "pairs", "close_pairs", "fx", "fy", "cx", "cy"}
    unknown = set(meta) - set(option_of) - described - {"clamp"}
    assert not unknown, f"the case depends on {sorted(unknown)}, which this test does not pass on"
    assert meta.get("clamp", SLOPE_LIMIT) == SLOPE_LIMIT
    return RenderOptions(**{option: meta[key] for key, option in option_of.items() if key in meta})


def camera_of(meta: dict) -> Camera:
    if meta["projection"] == "pinhole":
        return Pinhole(*(meta[key] for key in ("width", "height", "fx", "fy", "cx", "cy")))
    return Panorama(meta["width"], meta["height"])


@pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no golden cases: {FOLDER} is not there")
def test_every_projection_has_golden_cases():
    for projection in PROJECTIONS:
        assert any(case.startswith(f"{projection}_") for case in CASES), projection


def cases_on_engines() -> list:
    found = []
    for case in CASES:
        for engine in engines():
            slow = case == "erp_many" and engine.values[0] == "torch"  # 3000 Gaussians by brute force
            marks = [*engine.marks, *([pytest.mark.slow] if slow else [])]
            found.append(pytest.param(case, *engine.values, id=f"{case}-{engine.id}", marks=marks))
    return found


@pytest.mark.parametrize(("case", "backend", "dtype"), cases_on_engines())
def test_golden_case(case: str, backend: str, dtype: torch.dtype):
    data = np.load(FOLDER / f"{case}.npz")
    meta = json.loads(str(data["meta"]))

    def tensor(key: str) -> torch.Tensor:
        return torch.tensor(data[key], dtype=dtype)

    inputs = {name: tensor(name).requires_grad_() for name in INPUTS}
    pose = torch.eye(4, dtype=dtype)
    pose[:3, :3], pose[:3, 3] = tensor("R"), tensor("t")
    arguments = {"background": tensor("background"), "backend": backend}
    rendering = render(Gaussians(**inputs), view_of(camera_of(meta), pose), options_of(meta), **arguments)

    stable = torch.tensor(data["stable"])
    for name in ("image", "transmittance"):
        error = (getattr(rendering, name) - tensor(name))[stable].abs().max()
        assert error <= VALUE_TOLERANCE, name
    depth = tensor("depth")
    assert ((rendering.depth - depth).abs() <= DEPTH_TOLERANCE * depth)[stable].all()
    assert abs(rendering.counters["contributing"] - meta["pairs"]) <= meta["close_pairs"]

    (rendering.image * tensor("image_weight")).sum().backward()
    index = torch.tensor(data["grad_index"]).long()
    for name, leaf in inputs.items():
        assert leaf.grad is not None and torch.isfinite(leaf.grad).all(), name
        actual, expected = leaf.grad[index], tensor(f"grad_{name}")
        valid = torch.tensor(data[f"valid_{name}"])
        rows = [x.reshape(len(index), -1) for x in (actual, expected, valid)]
        norms = rows[1].norm(dim=-1, keepdim=True)
        limit = GRADIENT_TOLERANCE * (norms + 1e-3 * norms.max())
        wrong = ~((rows[0] - rows[1]).abs() <= limit) & rows[2].bool()  # a limit that is NaN would let all through
        assert not wrong.any(), f"{name} of Gaussians {index[wrong.any(-1)].tolist()}"
