"""Growing and pruning anchors: the published rules, one by one, on models small enough to work out by hand."""

import math
from dataclasses import replace

import pytest
import torch

from padgs import load_scene
from padgs.methods.anchors.anchors import PaDGS, PaDGSOptions
from padgs.methods.anchors.growth import PUBLISHED_THRESHOLD, Growth, GrowthOptions, find_new_anchors
from padgs.training.health import Failure

VOXEL = 0.5
PUBLISHED = GrowthOptions(gradient_threshold=PUBLISHED_THRESHOLD, log_scale_cap=0.05, max_anchors=None)


@pytest.fixture
def lucky(monkeypatch) -> None:
    """No candidate is left out by chance."""
    monkeypatch.setattr(torch, "rand", lambda *size, **_: torch.ones(size))


def model_at(cells, offsets=2, features=3) -> PaDGS:
    positions = torch.tensor(cells, dtype=torch.float32) * VOXEL
    options = PaDGSOptions(features=features, offsets=offsets, hidden=4)
    return PaDGS(positions, torch.zeros(len(cells), 6), options, voxel_size=VOXEL)


def move(model, slot, center) -> None:
    """Put a Gaussian somewhere."""
    anchor = slot // model.options.offsets
    with torch.no_grad():
        model.offsets.view(-1, 3)[slot] = torch.tensor(center) - model.positions[anchor]


def adam(model) -> torch.optim.Adam:
    optimizer = torch.optim.Adam(list(model.parameters()), lr=0.0)
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    optimizer.zero_grad()
    return optimizer


@pytest.mark.parametrize("name", ["room", "flat"])
def test_default_voxels_of_a_captured_cloud_leave_free_cells(name, shared, generator):
    """The voxels are so small that nearly every point is an anchor, and that around them even the coarsest cells are
    free: where none is, finer ones are not tried, and nothing ever grows.
    """
    scene = load_scene(shared / "data" / name, width=512)
    model = PaDGS.from_scene(scene)
    assert len(model) > 0.85 * len(scene.points)
    model.offsets.data.normal_(std=0.5, generator=generator)
    pulled = torch.full((len(model) * model.options.offsets,), 1.0)
    seeds = find_new_anchors(model, pulled, GrowthOptions(), generator)
    assert (seeds.sizes == GrowthOptions().coarsest).sum() > 0.05 * len(model)


def seeds_of(model, gradients, options=PUBLISHED):
    seeds = find_new_anchors(model, torch.tensor(gradients), options, torch.Generator())
    return [tuple(cell) for cell in seeds.cells.tolist()], seeds


def test_sampling_probability_of_each_level():
    count = 40_000
    cells = [[64 * i, 0, 0] for i in range(count)]  # far apart: every anchor may seed its own cell at every level
    model = model_at(cells, offsets=1)
    with torch.no_grad():
        model.offsets[:, 0, 1] = 20 * 16 * VOXEL
    seeds = find_new_anchors(model, torch.ones(count), PUBLISHED, torch.Generator().manual_seed(0))
    # Level 1 and 2 may only add where no anchor, and no seed of a coarser level, is in their own cell.
    by_size = {size: int((seeds.sizes == size).sum()) for size in (16, 4, 1)}
    assert by_size[16] == pytest.approx(count / 2, rel=0.03)
    assert by_size[4] == pytest.approx(count / 2 * 3 / 4, rel=0.03)  # 320 voxels up is a vertex of all three grids
    assert by_size[1] == pytest.approx(count / 2 * 1 / 4 * 7 / 8, rel=0.03)


@pytest.mark.parametrize(("gradient", "levels"), [(1.9e-4, 0), (2.1e-4, 1), (4.1e-4, 2), (8.1e-4, 3)])
def test_thresholds_and_cells_of_each_level(lucky, gradient, levels):
    model = model_at([[0, 0, 0]])
    move(model, 1, [18.5, 0.5, 0.5])  # voxel (37, 1, 1): another vertex on each grid
    cells, seeds = seeds_of(model, [0.0, gradient])
    assert cells == [(32, 0, 0), (36, 0, 0), (37, 1, 1)][:levels]
    assert seeds.sizes.tolist() == [16, 4, 1][:levels]


def test_finer_levels_are_tried_only_after_a_seed_at_the_coarsest(lucky):
    model = model_at([[0, 0, 0], [64, 0, 0]])
    move(model, 1, [0.5 * 3, 0.0, 0.0])  # voxel 3: free at 1 and at 4, but 16-cell 0 holds the anchor
    assert seeds_of(model, [0.0, 1.0, 0.0, 0.0])[0] == []
    move(model, 1, [0.5 * 1, 0.0, 0.0])  # voxel 1: free only at the finest level
    move(model, 2, [0.5 * 160, 0.0, 0.0])  # free at the coarsest
    assert seeds_of(model, [0.0, 1.0, 1.0, 0.0])[0] == [(160, 0, 0), (1, 0, 0)]


def test_new_anchors_take_the_largest_features_of_their_cell(lucky):
    model = model_at([[0, 0, 0], [64, 0, 0]])
    for slot in (1, 2):
        move(model, slot, [0.5 * 160, 0.0, 0.0])
    with torch.no_grad():
        model.features.copy_(torch.tensor([[-1.0, -2.0, 3.0], [-4.0, -1.0, 5.0]]))
    cells, seeds = seeds_of(model, [0.0, 3e-4, 2.5e-4, 0.0])
    assert cells == [(160, 0, 0)]
    assert seeds.features.tolist() == [[-1.0, -1.0, 5.0]]
    assert seeds.gradients.item() == pytest.approx(3e-4)


def ready(model, options, *, gradient, seen) -> Growth:
    """A growth whose statistics say that every Gaussian had this mean gradient, this often."""
    growth = Growth(model, options)
    growth.statistics["gradient"].fill_(gradient * seen)
    growth.statistics["seen"].fill_(seen)
    growth.statistics["decoded"].fill_(options.grow_every)
    growth.statistics["opacity"].fill_(options.grow_every)
    return growth


@pytest.mark.parametrize(("seen", "grown"), [(40, 0), (41, 1)])
def test_gaussians_seen_in_few_iterations_are_not_eligible(lucky, seen, grown):
    model = model_at([[0, 0, 0]])
    move(model, 1, [0.5 * 160, 0.0, 0.0])
    growth = ready(model, PUBLISHED, gradient=2.5e-4, seen=seen)
    growth.adapt(1600, adam(model))
    assert len(model) == 1 + grown
    left = growth.statistics["seen"][0]
    assert left.tolist() == ([0.0, 0.0] if grown else [seen, seen])  # only those that were judged start again


@pytest.mark.parametrize(("iterations", "seen", "grown"), [(49, 49, 0), (60, 24, 0), (60, 25, 1), (200, 40, 0)])
def test_by_the_clock_a_round_is_judged_by_its_iterations_or_left_out(iterations, seen, grown, lucky):
    model = model_at([[0, 0, 0]])
    move(model, 1, [0.5 * 160, 0.0, 0.0])
    growth = ready(model, PUBLISHED, gradient=2.5e-4, seen=seen)
    growth.statistics["decoded"].fill_(iterations)
    growth.statistics["opacity"].fill_(iterations)
    growth.adapt(1600, adam(model))
    assert len(model) == 1 + grown
    assert growth.statistics["decoded"][0] == (49 if iterations == 49 else 0), "too few are kept for the next round"


def test_new_anchors_start_as_published(lucky):
    model = model_at([[0, 0, 0]])
    move(model, 1, [0.5 * 160, 0.0, 0.0])
    parameters = {name: id(parameter) for name, parameter in model.rows().items()}
    optimizer = adam(model)
    growth = ready(model, replace(PUBLISHED, log_scale_cap=None), gradient=2.5e-4, seen=50)
    assert growth.adapt(1600, optimizer) == ("grew 1 anchors",)
    assert model.positions[1].tolist() == [80.0, 0.0, 0.0]
    assert torch.allclose(model.log_scales[1], torch.tensor(math.log(16 * VOXEL)))
    assert (model.offsets[1] == 0).all() and torch.equal(model.features[1], model.features[0])
    assert {name: id(parameter) for name, parameter in model.rows().items()} == parameters
    for parameter in model.rows().values():
        moments = optimizer.state[parameter]["exp_avg"]
        assert moments.shape == parameter.shape and (moments[0] != 0).all() and (moments[1] == 0).all()
    for values in growth.statistics.values():
        assert len(values) == 2 and (values[1] == 0).all()


def test_ends_of_the_growth_window_are_exclusive(monkeypatch):
    growth = Growth(model_at([[0, 0, 0]]), PUBLISHED)
    optimizer = adam(growth.model)
    monkeypatch.setattr(growth, "_grow", lambda optimizer, share: ("grew",))
    monkeypatch.setattr(growth, "_prune", lambda optimizer, share: ())
    growth.statistics["decoded"].fill_(100)
    rounds = [iteration for iteration in range(1, 30_001) if growth.adapt(iteration, optimizer)]
    assert rounds == list(range(1600, 15_000, 100))


@pytest.mark.parametrize(("iteration", "collected"), [(500, 0), (501, 1), (14_999, 1), (15_000, 0)])
def test_statistics_are_collected_in_their_window(iteration, collected):
    growth = Growth(model_at([[0, 0, 0], [9, 0, 0]]), PUBLISHED)
    raw = torch.tensor([[0.5, -0.7], [0.25, 0.5]])
    slots = torch.tensor([0, 2, 3])
    gradient = torch.tensor([[3.0, 4.0], [1.0, 0.0], [5.0, 12.0]])
    growth.observe(raw, slots, gradient, torch.tensor([True, False, True]), iteration)
    expected = {
        "opacity": [0.5, 0.75],
        "decoded": [1.0, 1.0],
        "gradient": [[5.0, 0.0], [0.0, 13.0]],
        "seen": [[1.0, 0.0], [0.0, 1.0]],
    }
    for name, values in expected.items():
        assert torch.equal(growth.statistics[name], collected * torch.tensor(values)), name


def test_windows_scale_with_the_run():
    assert PUBLISHED.for_run(30_000) == PUBLISHED
    short = PUBLISHED.for_run(3_000)
    assert (short.statistics_from, short.grow_from, short.grow_until, short.grow_every) == (50, 150, 1500, 50)
    rounds = [i for i in range(1, 3001) if short.grow_from < i < short.grow_until and i % short.grow_every == 0]
    assert len(rounds) == 26
    assert PUBLISHED.for_run(60_000).grow_every == 200


@pytest.mark.parametrize(
    ("decoded", "opacity", "pruned"),
    [(80, 0.0, False), (81, 0.0, True), (81, 0.80, True), (81, 0.82, False), (500, 4.9, True), (500, 5.1, False)],
)
def test_anchors_below_the_mean_opacity_limit_are_pruned(decoded, opacity, pruned):
    model = model_at([[0, 0, 0], [9, 0, 0], [30, 0, 0]])
    with torch.no_grad():
        model.features.copy_(torch.arange(9.0).view(3, 3))
    optimizer = adam(model)
    growth = Growth(model, PUBLISHED)
    growth.statistics["decoded"].copy_(torch.tensor([500.0, decoded, 10.0]))
    growth.statistics["opacity"].copy_(torch.tensor([400.0, opacity, 0.0]))
    events = growth.adapt(1600, optimizer)
    assert events == (("pruned 1 anchors",) if pruned else ())
    kept = [0, 2] if pruned else [0, 1, 2]
    assert torch.equal(model.features, torch.arange(9.0).view(3, 3)[kept])
    assert torch.equal(model.positions[:, 0], torch.tensor([0.0, 4.5, 15.0])[kept])
    assert optimizer.state[model.offsets]["exp_avg"].shape == model.offsets.shape
    judged = decoded > 80
    expected = torch.tensor([0.0, 0.0 if judged else decoded, 10.0])[kept]
    assert torch.equal(growth.statistics["decoded"], expected)


def test_pruning_all_anchors_fails_as_collapsed():
    model = model_at([[0, 0, 0]])
    growth = Growth(model, PUBLISHED)
    growth.statistics["decoded"].fill_(500)
    with pytest.raises(Failure, match="all 1 anchors are fainter") as failure:
        growth.adapt(1600, adam(model))
    assert failure.value.status == "collapsed"


@pytest.mark.parametrize(("cap", "expected"), [(None, 2.0), (0.05, 0.05)])
def test_log_scale_cap_is_off_by_default(cap, expected):
    model = model_at([[0, 0, 0]])
    with torch.no_grad():
        model.log_scales.fill_(2.0)
    ready(model, GrowthOptions(log_scale_cap=cap), gradient=0.0, seen=0).adapt(1600, adam(model))
    assert torch.allclose(model.log_scales[0], torch.tensor([2.0] * 3 + [expected] * 3))
    assert GrowthOptions().log_scale_cap is None


def test_max_anchors_keeps_the_largest_gradients_and_reports_it(lucky):
    cells = [[64 * i, 0, 0] for i in range(5)]
    model = model_at(cells, offsets=1)
    with torch.no_grad():
        model.offsets[:, 0, 1] = 320 * VOXEL
    growth = ready(model, replace(PUBLISHED, max_anchors=7), gradient=0.0, seen=50)
    growth.statistics["gradient"].copy_(50 * torch.tensor([2.1e-4, 3.9e-4, 2.2e-4, 3.8e-4, 1e-5])[:, None])
    events = growth.adapt(1600, adam(model))
    assert events == ("grew 2 anchors", "max_anchors 7 left out 2 of 4 new anchors")
    assert model.positions[5:, 0].tolist() == [64 * VOXEL, 3 * 64 * VOXEL]
    for name, values in (("seen", 50), ("gradient", 50 * 3e-4), ("decoded", 100), ("opacity", 100)):
        growth.statistics[name].fill_(values)
    assert growth.adapt(1700, adam(model)) == ("max_anchors 7 left out 3 of 3 new anchors",)
    assert len(model) == 7


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"coarsest": 10}, "coarsest is 10 voxels; it must be a multiple"),
        ({"coarsest": 0}, "coarsest is 0; it must be at least 1"),
        ({"grow_every": 0}, "grow_every is 0"),
        ({"max_anchors": 0}, "max_anchors is 0"),
    ],
)
def test_invalid_options_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        GrowthOptions(**wrong)
