"""Native results are bit-equal for any number of threads, and nearly so on any instruction set."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from support.render_cases import OUTPUTS, camera_of, differentiated, mixture, needs_native, random_pose
from torch import Tensor

from padgs.geometry.camera import Panorama
from padgs.methods.anchors.decoder import Decoder, SeenAnchors, decode_gaussians
from padgs.methods.plus.smoothness import roughness
from padgs.native import cpu
from padgs.render import Rendering, RenderOptions
from padgs.training.loss import photometric_loss

pytestmark = needs_native
RENDERINGS = {
    "erp": ("erp", "panorama", {}),
    "erp in strips": ("erp", "panorama", {"max_instances": 2000}),
    "tangent": ("tangent", "panorama", {}),
    "ray": ("ray", "panorama", {"near": 0.05}),
    "pinhole": ("pinhole", "pinhole", {}),
    "cube map": ("pinhole", "panorama", {"cubemap": True}),
    "erp, hybrid": ("erp", "panorama", {"blending": "hybrid", "core_size": 8}),
    "ray, hybrid": ("ray", "panorama", {"blending": "hybrid", "core_size": 3}),
    "ray in a pinhole": ("ray", "pinhole", {"steepness": 0.3}),
    "tangent along a table": ("tangent", "fisheye", {}),
    "ray along a table": ("ray", "fisheye", {}),
}


def drawn(name: str, count: int = 250, size: tuple[int, int] = (250, 125)) -> dict[str, Tensor]:
    """Return outputs and gradients of one rendering, by name."""
    projection, lens, settings = RENDERINGS[name]
    generator = torch.Generator().manual_seed(99)
    gaussians = mixture(count, generator, ("ordinary", "polar", "seam", "needle"))
    camera, options = camera_of(lens, *size), RenderOptions(projection, **settings)
    weights, pose = torch.randn(*size[::-1], 5, generator=generator), random_pose(generator, shift=0.1)
    engine = {"pose": pose, "backend": "cpu", "dtype": torch.float32}
    rendering, gradients = differentiated(gaussians, camera, options, weights, **engine)
    outputs = {key: getattr(rendering, key).detach() for key in OUTPUTS}
    counters = torch.tensor([rendering.counters[key] for key in sorted(rendering.counters)])
    return {**outputs, "counters": counters, **{f"by {key}": gradient for key, gradient in gradients.items()}}


def decoded(anchors: int = 3000) -> dict[str, Tensor]:
    """Return Gaussians of a decoder and the gradients of its parameters, by name."""
    generator = torch.Generator().manual_seed(98)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    weights = Decoder(36, 10, generator=generator).weights()
    leaf = {"features": randn(anchors, 32), "offsets": randn(anchors, 10, 3), "log_scales": 0.3 * randn(anchors, 6)}
    leaf = {key: value.requires_grad_() for key, value in leaf.items()}
    seen, positions, attenuation = randn(anchors, 4), randn(anchors, 3), torch.rand(anchors, generator=generator)
    tensors = SeenAnchors(seen=seen, positions=positions, attenuation=attenuation, **leaf)
    gaussians, slots, raw, _ = decode_gaussians(weights, tensors)
    loss = sum((value * randn(*value.shape)).sum() for value in vars(gaussians).values())
    flat = [*leaf.values(), *(tensor for head in weights for tensor in head)]
    gradients = torch.autograd.grad(loss, flat)
    return {**vars(gaussians), "slots": slots, "raw": raw, **{f"by {i}": g for i, g in enumerate(gradients)}}


def compared(size: tuple[int, int] = (203, 101)) -> dict[str, Tensor]:
    """Return the photometric loss of two images and its gradient."""
    generator = torch.Generator().manual_seed(97)
    image, target = torch.rand(2, *size, 3, generator=generator)
    image.requires_grad_()
    loss = photometric_loss(image, target, torch.rand(size, generator=generator))
    return {"loss": loss.detach(), "by image": torch.autograd.grad(loss, image)[0]}


def roughened(size: tuple[int, int] = (101, 203)) -> dict[str, Tensor]:
    """Return the roughness of a rendering and its gradient."""
    generator = torch.Generator().manual_seed(96)
    image, transmittance = torch.rand(*size, 3, generator=generator), torch.rand(size, generator=generator)
    depth = (1 + 0.1 * torch.rand(size, generator=generator)).requires_grad_()
    shown = Rendering(image, transmittance, depth, torch.ones(1, dtype=torch.bool))
    value = roughness(shown, Panorama(size[1], size[0]), near=0.1)
    return {"roughness": value.detach(), "by depth": torch.autograd.grad(value, depth)[0]}


NAMELESS = {"decode": decoded, "loss": compared, "roughness": roughened}
EVERYTHING = {**{name: (drawn, name) for name in RENDERINGS}, **{name: (made,) for name, made in NAMELESS.items()}}


@pytest.fixture
def restored_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("name", EVERYTHING)
def test_results_are_bit_equal_for_any_number_of_threads(name: str, restored_threads: None):
    function, *arguments = EVERYTHING[name]
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        results.append(function(*arguments))
    for threads, result in zip((2, 3), results[1:], strict=True):
        for key, expected in results[0].items():
            assert torch.equal(result[key], expected), f"{key} with {threads} threads"


def small_results() -> dict[str, dict[str, Tensor]]:
    """Return results with few pairs, none of them near the cut."""
    results = {name: drawn(name, 6, (72, 36)) for name in RENDERINGS}
    return {**results, **{name: made() for name, made in NAMELESS.items()}}


IN_ANOTHER_PROCESS = """
import sys, torch, test_determinism
from padgs.native import cpu
torch.save(test_determinism.small_results(), sys.argv[1])
print(cpu.library().padgs_isa().decode(), end="")
"""


def on_instruction_set(isa: str, file: Path) -> tuple[str, dict[str, dict[str, Tensor]]]:
    """Return the instruction set that was used with PADGS_ISA set, and all results."""
    search_path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", IN_ANOTHER_PROCESS, str(file)],
        env={**os.environ, "PYTHONPATH": search_path, "PADGS_ISA": isa},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, torch.load(file)


def test_every_instruction_set_computes_the_same(tmp_path: Path):
    here, best = small_results(), cpu.library().padgs_isa().decode()
    others = {}
    for isa in {"baseline", "avx2", "avx512"} - {best}:
        used, result = on_instruction_set(isa, tmp_path / f"{isa}.pt")
        if used != best:  # it is, where the machine does not have what was asked for
            assert used == isa
            others[isa] = result
    if not others and best == "baseline":
        pytest.skip("this machine has only the baseline instruction set")
    assert "baseline" in (best, *others), "PADGS_ISA=baseline is not obeyed"
    for isa, result in others.items():
        for name, expected in here.items():
            for key, truth in expected.items():
                actual, truth = result[name][key].double(), truth.double()
                assert actual.shape == truth.shape, f"{name}: {key} with {isa}"
                assert (actual - truth).abs().max() <= 1e-4 * truth.abs().max(), f"{name}: {key} with {isa}"
