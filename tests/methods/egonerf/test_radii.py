import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from padgs.methods.egonerf.grids import exponential_nodes, node_fraction


@given(first=st.floats(1e-4, 0.5), factor=st.floats(1.5, 1e5), count=st.integers(3, 300))
def test_nodes_grow_with_no_interval_shorter_than_the_first(first, factor, count):
    nodes = exponential_nodes(first, first * factor, count)
    assert len(nodes) == count and nodes[0] == 0
    assert nodes[1].item() == pytest.approx(first)
    assert (nodes.diff() >= first * (1 - 1e-12)).all()
    assert (nodes.diff().diff() >= -1e-9 * nodes[-1]).all(), "intervals never shrink"
    assert nodes[-1] >= first * factor * (1 - 1e-9)


def test_behind_the_threshold_the_series_is_geometric_and_only_shifted():
    first, last, count = 0.05, 520.0, 150
    ratio = (last / first) ** (1 / (count - 2))
    geometric = torch.cat((torch.zeros(1), first * ratio ** torch.arange(count - 1.0))).double()
    nodes = exponential_nodes(first, last, count)
    far = geometric.diff() > first
    assert 10 < int((~far).sum()) < 60
    assert torch.allclose(nodes.diff()[far], geometric.diff()[far], rtol=1e-4)
    assert torch.allclose(nodes.diff()[~far], torch.tensor(first, dtype=torch.float64))


def test_places_are_exact_at_nodes_linear_between_and_continuous():
    nodes = exponential_nodes(0.1, 50.0, 24)
    steps = torch.arange(24, dtype=torch.float64) / 23
    assert torch.allclose(node_fraction(nodes, nodes), steps, atol=1e-14)
    between = 0.25 * nodes[:-1] + 0.75 * nodes[1:]
    assert torch.allclose(node_fraction(between, nodes), steps[:-1] + 0.75 / 23, atol=1e-14)
    assert torch.allclose(node_fraction(nodes[1:-1] * (1 - 1e-12), nodes), steps[1:-1], atol=1e-10)


def test_places_are_monotone_and_end_at_the_last_node():
    nodes = exponential_nodes(0.1, 50.0, 24)
    radii = torch.linspace(0, 80, 10_001, dtype=torch.float64)
    places = node_fraction(radii, nodes)
    inside = radii < nodes[-1]
    assert (places.diff()[inside[1:]] > 0).all()
    assert (places[~inside] == 1).all()


def test_lengths_that_do_not_grow_are_refused():
    with pytest.raises(ValueError, match="the first radius is 2.0 and the last 1.0"):
        exponential_nodes(2.0, 1.0, 10)
    with pytest.raises(ValueError, match="2 radial nodes are too few"):
        exponential_nodes(1.0, 2.0, 2)
