import torch

from padgs.methods.egonerf.rays import visible_shares

DENSITY = 0.7


def test_shares_and_residual_are_one(generator):
    depths = torch.rand(1000, 40, generator=generator) ** 8 * 20
    weights, residual = visible_shares(depths)
    assert (weights >= 0).all() and (residual >= 0).all()
    assert torch.allclose(weights.sum(-1) + residual, torch.ones(1000), atol=2e-6)


def test_a_medium_of_constant_density_is_exact_however_it_is_cut(generator):
    """What comes from the first length s is 1 - exp(-density s)."""
    lengths = torch.rand(30, dtype=torch.float64, generator=generator)
    weights, residual = visible_shares(DENSITY * lengths)
    assert torch.allclose(weights.cumsum(0), 1 - torch.exp(-DENSITY * lengths.cumsum(0)), atol=1e-14)
    assert torch.allclose(residual, torch.exp(-DENSITY * lengths.sum()))


def test_a_slab_is_seen_through_the_empty_space_before_it():
    depths = torch.zeros(50, dtype=torch.float64)
    depths[20:30] = DENSITY * 0.1
    weights, residual = visible_shares(depths)
    assert weights[:20].sum() == 0 and weights[30:].sum() == 0
    assert torch.allclose(weights.sum(), 1 - torch.exp(torch.tensor(-DENSITY, dtype=torch.float64)))
    assert torch.allclose(residual, torch.exp(torch.tensor(-DENSITY, dtype=torch.float64)))


def test_opaque_and_empty_media():
    weights, residual = visible_shares(torch.tensor([[0.0, 0.0, 0.0], [0.0, 1e4, 5.0]]))
    assert weights.tolist() == [[0, 0, 0], [0, 1, 0]] and residual.tolist() == [1, 0]


def test_faint_media_keep_their_digits():
    weights, _ = visible_shares(torch.full((4,), 1e-9))
    assert torch.allclose(weights, torch.full((4,), 1e-9), rtol=1e-6)


def test_gradients(generator):
    depths = torch.rand(3, 5, dtype=torch.float64, generator=generator, requires_grad=True)
    assert torch.autograd.gradcheck(visible_shares, depths)
