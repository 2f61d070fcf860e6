import math

import torch
from random_splats import random_splats
from scipy.spatial.transform import Rotation
from tiny_scene import tiny_scene

from padgs.apps.export.explicit import harmonics_rotation, transform_splats, upright_rotation
from padgs.geometry import harmonics
from padgs.methods.calibration.align import Similarity
from padgs.render import RenderOptions, render


def test_moved_gaussians_look_the_same_from_moved_cameras(generator):
    splats = random_splats(3, generator)
    splats.log_scales.data -= 1.5
    turn = torch.from_numpy(Rotation.from_rotvec([0.5, -1.2, 0.3]).as_matrix())
    similarity = Similarity(1.7, turn, torch.tensor([0.3, -2.0, 5.0], dtype=torch.float64))
    view = tiny_scene().train[3]
    pose = view.cam_from_world.clone()
    pose[:3, :3] = view.cam_from_world[:3, :3] @ turn.T
    pose[:3, 3] = -pose[:3, :3] @ similarity(view.center)
    before = render(splats.gaussians(view), view, RenderOptions())
    new = transform_splats(splats, similarity)
    after = render(new.gaussians(view.at(pose)), view.at(pose), RenderOptions())
    assert torch.allclose(after.image, before.image, atol=2e-3) and before.image.std() > 0.1
    assert math.isclose(new.unit, 1.7 * splats.unit)
    back = transform_splats(new, similarity.inverse())
    for name in ("means", "log_scales", "sh_dc", "sh_rest"):
        assert torch.allclose(back.rows()[name], splats.rows()[name], atol=1e-4), name


def test_turned_harmonics_are_the_function_turned(generator):
    turn = torch.from_numpy(Rotation.random(random_state=3).as_matrix())
    directions = torch.nn.functional.normalize(torch.randn(9, 3, generator=generator, dtype=torch.float64), dim=-1)
    coefficients = torch.randn(16, generator=generator, dtype=torch.float64)
    before = harmonics.basis(directions, 3) @ coefficients
    after = harmonics.basis(directions @ turn.T, 3) @ harmonics_rotation(turn, 3) @ coefficients
    assert torch.allclose(after, before, atol=1e-9)


def test_upright_turns_up_against_down():
    for up in ([0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [0.0, 1.0, 0.0]):
        turned = upright_rotation(torch.tensor(up, dtype=torch.float64))(torch.tensor(up, dtype=torch.float64))
        assert torch.allclose(turned, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64), atol=1e-9)
