"""Print the numbers of docs/notes/gpu.md: deviations of backend cuda from the definition in float64.

    python docs/cuda_parity.py

Runs on a GPU if there is one, else the same kernels on the CPU (tests/render/cuda/emulation.h), and prints which.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/render"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/render/cuda"))

from support import cuda_engine
from support.render_cases import (
    SETUPS,
    blended,
    camera_of,
    differentiated,
    gaussians_of,
    identity_pose,
    random_pose,
    row_error,
    stable_pixels,
)
from test_hybrid_rendering import fragments

from padgs.render import RenderOptions
from padgs.render.contract import BLENDINGS

REGIONS = ("ordinary", "polar", "seam", "near")
SIZE = (72, 36)
COUNT = 60


def main() -> None:
    """Print the table as Markdown."""
    where = torch.cuda.get_device_name() if cuda_engine.ON_GPU else "emulated on the CPU"
    print(f"{COUNT} Gaussians, {SIZE[0]}x{SIZE[1]} pixels; {where}\n")
    errors_of = "image: max | mean | depth: max, relative | mean | gradients: max | mean"
    print(f"| projection, camera, blending | region | {errors_of} |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for blending in BLENDINGS:
        for projection, lens in SETUPS:
            everywhere = lens == "panorama" and (blending == "sorted" or projection == "ray")
            for region in REGIONS if everywhere else ("ordinary",):
                numbers = " | ".join(f"{error:.1e}" for error in errors(projection, lens, region, blending))
                print(f"| {projection}, {lens}, {blending} | {region} | {numbers} |")


def errors(projection: str, lens: str, region: str, blending: str) -> list[float]:
    """Return the largest and the mean error of the image, the depth (relative) and the gradients (relative, by row)."""
    generator = torch.Generator().manual_seed(11)
    gaussians = gaussians_of(region, COUNT, generator)
    if region == "near" and projection == "ray":  # cameras inside a Gaussian do not see it
        gaussians.scales.mul_(0.2)
    pose = random_pose(generator) if region == "ordinary" and lens != "panorama" else identity_pose()
    options = RenderOptions(projection, **blended(blending, 4))
    stable = stable_pixels(gaussians, *SIZE, lens=lens, pose=pose, options=options)
    if blending == "hybrid":
        *_, decided = fragments(gaussians, camera_of(lens, *SIZE), options, pose)
        stable &= decided.view_as(stable)
    weights = torch.randn(*stable.shape, 5, generator=generator, dtype=torch.float64) * stable[..., None]
    runs = [
        differentiated(gaussians, camera_of(lens, *SIZE), options, weights, pose=pose, backend=backend, dtype=dtype)
        for backend, dtype in (("torch", torch.float64), ("cuda", torch.float32))
    ]
    (truth, exact), (drawn, found) = runs
    image = (drawn.image.double() - truth.image)[stable].abs()
    depth = ((drawn.depth.double() - truth.depth).abs() / truth.depth.clamp(min=1e-9))[stable & (truth.depth > 0)]
    gradients = torch.tensor([row_error(found[name], exact[name]) for name in exact if name != "rays"])
    return [x for e in (image, depth, gradients) for x in (e.max().item(), e.mean().item())]


if __name__ == "__main__":
    main()
