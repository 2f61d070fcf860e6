"""Explicit Gaussians, and cameras that learn with them, do not care about the units of the world."""

from dataclasses import replace

import pytest
import torch
from support.tiny_scene import in_other_units, tiny_scene

from padgs.baselines import METHODS
from padgs.checks import lookup
from padgs.methods.splats.method import SplatMethod
from padgs.scene import Scene
from padgs.training.options import Budget

FACTORS = [2.0**10, 2.0**-10]  # lengths are multiplied exactly, and what differs is the rounding of logarithms
STEPS = 20
# padgs_plus grows in twenty steps, so it has a test of its own (tests/methods/plus).
EXPLICIT = [
    name for name in METHODS if issubclass(lookup(METHODS, name, "method"), SplatMethod) and name != "padgs_plus"
]


def trained(name: str, scene: Scene) -> tuple[torch.Tensor, torch.Tensor, list[float]]:
    """How far the means were moved [N, 3], an image of a held-out view, and all losses."""
    kind = lookup(METHODS, name, "method")
    method = kind(train=replace(kind.TRAIN, learning_rates="published"))
    losses = [float(record.loss) for record in method.fit(scene, Budget(STEPS))]
    image = method.render(scene.test[0]).image
    return method.model.splats.means.detach() - scene.points, image, losses


@pytest.mark.parametrize("other", FACTORS)
@pytest.mark.parametrize("name", EXPLICIT)
def test_training_is_invariant_to_world_units(name, other):
    scene = tiny_scene()
    (moves, image, losses), (far, larger_image, larger_losses) = (
        trained(name, in_other_units(scene, factor)) for factor in (1.0, other)
    )
    assert moves.norm(dim=-1).mean() > 1e-5 * scene.scale, "measured: 5e-5"
    assert (far / other - moves).norm() < 0.05 * moves.norm()  # measured: 1e-4
    assert larger_losses == pytest.approx(losses, rel=1e-3)  # measured: 1.5e-5
    # A response around 1/255 is drawn or is not, as rounding has it.
    difference = (larger_image - image).abs()
    assert difference.mean() < 1e-4 and difference.max() < 2 / 255  # measured: 1e-5 and 0.002
