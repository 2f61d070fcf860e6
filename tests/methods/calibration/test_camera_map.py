import pytest
import torch

from padgs.geometry.panorama import rays, sample_pixels, unproject
from padgs.methods.calibration.lenses import CameraMap

W, H = 64, 32


def smooth(size: float = 0.03, seed: int = 0) -> torch.Tensor:
    """A smooth field [H, W, 3] on the sphere: a random quadratic form of the direction."""
    generator = torch.Generator().manual_seed(seed)
    d = rays(W, H, dtype=torch.float64)
    quadratic = torch.randn(3, 3, 3, generator=generator, dtype=torch.float64)
    return size * torch.einsum("hwi,cij,hwj->hwc", d, quadratic, d)


def distorted(size: float = 0.03) -> CameraMap:
    camera = CameraMap(W, H, dtype=torch.float64)
    with torch.no_grad():
        camera.focal.copy_(torch.tensor([1.02, 0.99, 1.0]))
        camera.offsets.copy_(smooth(size))
    return camera


def test_an_ideal_camera_changes_no_bit(generator):
    camera, image = CameraMap(W, H), torch.rand(H, W, 3, generator=generator)
    assert torch.equal(sample_pixels(image, camera.source_pixels()), image)
    assert torch.equal(sample_pixels(image, camera.ideal_pixels()), image)
    assert camera.roughness() == 0


def test_there_and_back(generator):
    """The inverse map, sampled at where the map leads, leads back: to a small share of a pixel away from the poles."""
    camera = distorted()
    there, back = camera.source_pixels(), camera.ideal_pixels()
    found = torch.nn.functional.normalize(sample_pixels(unproject(back, W, H), there), dim=-1)
    off = (found - rays(W, H, dtype=torch.float64)).norm(dim=-1) * (W / (2 * torch.pi))
    moved = (camera.directions() - rays(W, H, dtype=torch.float64)).norm(dim=-1) * (W / (2 * torch.pi))
    assert moved.mean() > 0.2, "in pixels: the camera is distorted"
    assert off.max() < 0.03 and off.mean() < 0.006


def test_a_turn_in_the_map_is_none():
    """A rotation of all cameras in their own frames is left to the poses."""
    camera = CameraMap(W, H, dtype=torch.float64)
    d = rays(W, H, dtype=torch.float64)
    turn = torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64)
    with torch.no_grad():
        camera.offsets.copy_(torch.linalg.cross(turn.expand_as(d), d))
    assert (camera.directions() - d).abs().max() < 1e-4  # the mean over pixels is that over the sphere up to 1/H^2


def test_gradients_are_those_of_differences(generator):
    camera = distorted()
    photograph = torch.rand(H, W, 3, generator=generator, dtype=torch.float64)
    weight = torch.randn(H, W, 3, generator=generator, dtype=torch.float64)

    def loss() -> torch.Tensor:
        return (sample_pixels(photograph, camera.source_pixels()) * weight).sum() + camera.roughness()

    loss().backward()
    entries = [(camera.focal, (k,)) for k in range(3)]
    entries += [(camera.offsets, place) for place in [(0, 3, 1), (15, 0, 0), (16, 63, 2), (31, 40, 1), (8, 30, 0)]]
    for parameter, place in entries:
        sides = []
        for step in (1e-7, -1e-7):
            with torch.no_grad():
                parameter[place] += step
                sides.append(loss().item())
                parameter[place] -= step
        assert parameter.grad[place].item() == pytest.approx((sides[0] - sides[1]) / 2e-7, rel=1e-5, abs=1e-5)


def test_roughness_of_a_linear_field_is_its_slope():
    """D = a d.y along one axis, a times the sine of the latitude: its slope is a times the cosine, pi/4 on average."""
    rough = []
    for scale in (1.0, 2.0):
        camera = CameraMap(256, 128, dtype=torch.float64)
        with torch.no_grad():
            camera.offsets[..., 0] = scale * rays(256, 128, dtype=torch.float64)[..., 1]
        rough.append(camera.roughness().item())
    assert rough[0] == pytest.approx(torch.pi / 4, rel=1e-3) and rough[1] == pytest.approx(2 * rough[0])


def test_roughness_is_the_same_upside_down(generator: torch.Generator):
    camera = CameraMap(64, 32, dtype=torch.float64)
    with torch.no_grad():
        camera.offsets.copy_(torch.randn(camera.offsets.shape, generator=generator, dtype=torch.float64))
        upright = camera.roughness().item()
        camera.offsets.copy_(camera.offsets.flip(0))
    assert camera.roughness().item() == pytest.approx(upright, rel=1e-12)
