import torch

from padgs.methods.egonerf.rays import interval_lengths, inverse_cdf, jittered, refined


def test_quantiles_of_an_exponential_density():
    """Density exp(-x) on [0, 8], cut finely: the quantile of share u is -log(1 - u (1 - exp(-8)))."""
    edges = torch.linspace(0, 8, 20_001, dtype=torch.float64)[None]
    weights = torch.exp(-edges[:, :-1]) - torch.exp(-edges[:, 1:])
    shares = torch.linspace(0.001, 0.999, 500, dtype=torch.float64)[None]
    exact = -torch.log1p(-shares * (1 - torch.exp(torch.tensor(-8.0, dtype=torch.float64))))
    assert torch.allclose(inverse_cdf(edges, weights, shares), exact, atol=2e-5)


def test_quantiles_of_pieces_are_exact_and_at_the_ends_the_ends(generator):
    edges = torch.tensor([[1.0, 2.0, 4.0, 5.0], [0.0, 1.0, 2.0, 3.0]], dtype=torch.float64)
    weights = torch.tensor([[1.0, 2.0, 1.0], [1e-12, 1.0, 1e-12]], dtype=torch.float64)
    shares = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0], dtype=torch.float64).expand(2, 5)
    found = inverse_cdf(edges, weights, shares)
    assert torch.allclose(found[0], torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0], dtype=torch.float64))
    assert torch.allclose(found[1, 1:4], torch.tensor([1.25, 1.5, 1.75], dtype=torch.float64))
    random = torch.rand(2, 1000, dtype=torch.float64, generator=generator).sort(dim=-1).values
    assert (inverse_cdf(edges, weights, random).diff(dim=-1) >= 0).all()


def test_refined_samples_gather_where_the_weight_is():
    distances = torch.arange(1.0, 11.0)[None]
    weights = torch.zeros(1, 10)
    weights[0, 4] = 1.0  # at distance 5
    found = refined(distances, weights, torch.linspace(0.01, 0.99, 50)[None])
    assert ((found >= 4.5) & (found <= 5.5)).all()


def test_a_ray_through_nothing_is_sampled_everywhere():
    distances = torch.arange(1.0, 11.0)[None]
    found = refined(distances, torch.zeros(1, 10), torch.linspace(0, 1, 9)[None])
    assert torch.allclose(found, torch.linspace(1.5, 9.5, 9)[None])


def test_jitter_stays_within_the_interval(generator):
    distances = torch.tensor([1.0, 2.0, 4.0, 8.0]).expand(100, 4)
    moved = jittered(distances, torch.rand(100, 4, generator=generator))
    assert ((moved >= distances) & (moved <= distances + interval_lengths(distances))).all()
    assert (moved.diff(dim=-1) > 0).all()
