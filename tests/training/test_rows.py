import torch
from torch import Tensor, nn

from padgs.training.optimizer import append_rows, keep_rows


def trained(count: int, generator: torch.Generator) -> tuple[dict[str, nn.Parameter], torch.optim.Adam, nn.Parameter]:
    """Two parameters with rows, one without, an optimizer with moments in all of them."""
    parameters = {
        "a": nn.Parameter(torch.randn(count, 3, generator=generator)),
        "b": nn.Parameter(torch.randn(count, generator=generator)),
    }
    network = nn.Parameter(torch.randn(4, generator=generator))
    optimizer = torch.optim.Adam([*parameters.values(), network], lr=0.1, fused=True)
    step(parameters, optimizer, network, torch.arange(count, dtype=torch.float32))
    return parameters, optimizer, network


def step(parameters, optimizer, network, pull: Tensor) -> None:
    optimizer.zero_grad()
    loss = (parameters["a"].sum(-1) * pull + parameters["b"] ** 2 * pull).sum() + network.square().sum()
    loss.backward()
    optimizer.step()


def test_kept_rows_train_on_as_if_the_others_had_never_been(generator):
    count, keep = 6, torch.tensor([True, False, True, True, False, True])
    parameters, optimizer, network = trained(count, generator)
    twin = {name: p.detach().clone() for name, p in parameters.items()}
    identities = {name: id(p) for name, p in parameters.items()}
    keep_rows(parameters, optimizer, keep)
    assert {name: id(p) for name, p in parameters.items()} == identities
    assert torch.equal(parameters["a"], twin["a"][keep])
    for _ in range(3):
        step(parameters, optimizer, network, torch.arange(count, dtype=torch.float32)[keep])

    whole, whole_optimizer, whole_network = trained(count, generator.manual_seed(2025))
    for _ in range(3):
        step(whole, whole_optimizer, whole_network, torch.arange(count, dtype=torch.float32))
    assert torch.equal(parameters["a"], whole["a"][keep])
    assert torch.equal(parameters["b"], whole["b"][keep])
    assert torch.equal(network, whole_network)


def test_rows_can_be_kept_by_number_in_any_order(generator):
    parameters, optimizer, _ = trained(4, generator)
    before = {name: p.detach().clone() for name, p in parameters.items()}
    moments = optimizer.state[parameters["a"]]["exp_avg"].clone()
    order = torch.tensor([3, 1])
    keep_rows(parameters, optimizer, order)
    assert torch.equal(parameters["b"], before["b"][order])
    assert torch.equal(optimizer.state[parameters["a"]]["exp_avg"], moments[order])


def test_appended_rows_have_no_moments_and_old_ones_keep_theirs(generator):
    parameters, optimizer, network = trained(3, generator)
    moments = optimizer.state[parameters["a"]]["exp_avg_sq"].clone()
    append_rows(parameters, optimizer, {"a": torch.ones(2, 3), "b": torch.zeros(2)})
    assert parameters["a"].shape == (5, 3) and torch.equal(parameters["a"][3:], torch.ones(2, 3))
    now = optimizer.state[parameters["a"]]["exp_avg_sq"]
    assert torch.equal(now[:3], moments) and torch.equal(now[3:], torch.zeros(2, 3))
    step(parameters, optimizer, network, torch.ones(5))
    assert not torch.equal(parameters["a"][3:], torch.ones(2, 3)), "new rows are optimised"


def test_rows_can_change_before_the_first_step():
    parameter = nn.Parameter(torch.zeros(2, 3))
    optimizer = torch.optim.Adam([parameter], fused=True)
    append_rows({"a": parameter}, optimizer, {"a": torch.ones(1, 3)})
    keep_rows({"a": parameter}, optimizer, torch.tensor([2]))
    assert torch.equal(parameter, torch.ones(1, 3))
