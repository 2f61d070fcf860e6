"""Values and gradients of all backends against the definition in float64."""

import functools

import pytest
import torch
from support import render_cases as cases

from padgs.gaussians import Gaussians
from padgs.render import RenderOptions

CONFIGURATIONS = {
    "ours": {},
    "sharp": {"near": 0.005, "low_pass": 0.05},
    "steep": {"steepness": 0.4},
    "no wrap": {"wrap": False},
    "published": {"near": 0.005, "wrap": False, "bounds": "square"},
}
COMBINATIONS = [
    (projection, lens, name, kind)
    for projection, lens in cases.SETUPS
    for name in CONFIGURATIONS
    for kind in cases.KINDS
    if not (name == "no wrap" and projection != "erp")
    and not (name == "steep" and projection not in ("tangent", "ray"))
    and not (name == "published" and (projection == "ray" or (projection == "tangent" and lens != "panorama")))
    and not (lens == "pinhole" and kind in ("polar", "pole", "seam"))  # it sees too few of them
]
ENGINES_IN_FLOAT32 = [engine for engine in cases.engines() if torch.float32 in engine.values]


def assert_same(gaussians: Gaussians, size, lens, options, generator, **engine) -> None:
    case = defined(gaussians, size, lens, options, generator, engine["pose"])
    cases.assert_matches_definition(*case, **engine)


def defined(gaussians: Gaussians, size, lens, options, generator, pose) -> tuple:
    """Return Gaussians, camera, options, stable pixels and the definition of a case."""
    stable = cases.stable_pixels(gaussians, *size, lens=lens, pose=pose, options=options)
    assert stable.double().mean() > 0.85
    arguments = (gaussians, cases.camera_of(lens, *size), options, stable)
    return *arguments, cases.definition(*arguments, generator, pose)


@functools.cache  # for all engines
def case_of(projection, lens, configuration, kind) -> tuple:
    """Return the pose of a case, and what `defined` returns."""
    generator = torch.Generator().manual_seed(cases.KINDS.index(kind))
    options = RenderOptions(projection, **CONFIGURATIONS[configuration])
    size = cases.ODD_SIZES[cases.KINDS.index(kind) % len(cases.ODD_SIZES)]
    gaussians = cases.gaussians_of(kind, 25, generator)
    gaussians.opacities[0] = 1.0  # reaches the maximum alpha, where the derivative is 0
    pose = cases.random_pose(generator)
    if kind in ("ordinary", "huge", "needle"):
        pose[:3, 3] = torch.tensor([0.25, -0.125, 0.5])
    elif lens == "panorama":  # these places are named in the camera frame
        pose[:3, :3] = torch.eye(3)
    if kind in ("huge", "near", "pole") and (configuration == "published" or projection == "ray"):
        gaussians = Gaussians(**{**vars(gaussians), "scales": 0.2 * gaussians.scales})
    if kind == "needle" and projection == "ray":  # which fades what is thinner than a pixel
        gaussians = Gaussians(**{**vars(gaussians), "scales": gaussians.scales.clamp(min=0.03)})
    return pose, *defined(gaussians, size, lens, options, generator, pose)


@pytest.mark.parametrize(
    ("projection", "lens", "configuration", "kind"), COMBINATIONS, ids=["-".join(c) for c in COMBINATIONS]
)
@pytest.mark.parametrize(("backend", "dtype"), ENGINES_IN_FLOAT32)
def test_every_engine_agrees_with_the_definition(projection, lens, configuration, kind, backend, dtype):
    pose, *case = case_of(projection, lens, configuration, kind)
    slack = 8 if kind == "needle" else 1  # their covariances alone cost four digits of seven
    cases.assert_matches_definition(*case, pose=pose, backend=backend, dtype=dtype, slack=slack)


@pytest.mark.parametrize("projection", ["erp", "tangent", "ray"])
@cases.needs_native
def test_a_large_odd_image_agrees(projection: str):
    generator = torch.Generator().manual_seed(9)
    gaussians = cases.mixture(3, generator, ("ordinary", "polar", "seam", "needle"))
    pose = torch.eye(4, dtype=torch.float64)
    engine = {"backend": "cpu", "dtype": torch.float32}
    options = RenderOptions(projection)
    assert_same(gaussians, (500, 250), "panorama", options, generator, pose=pose, **engine)
