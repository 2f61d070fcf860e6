"""Growing and pruning of anchors: new ones at Gaussians with large positional gradients, none where all are faint.

Statistics are collected over many views (`observe`) and used every `grow_every` iterations (`adapt`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.checks import check
from padgs.methods.anchors.anchors import PaDGS, cells_from_points, occupied, points_from_cells, unique_cells
from padgs.training.health import Failure
from padgs.training.optimizer import append_rows, keep_rows
from padgs.training.schedule import scaled

MIN_GROW_EVERY = 50  # iterations; below it `eligible_share` averages over too few views
LEAST_SHARE = 0.5  # of the iterations planned for a round
PUBLISHED_THRESHOLD = 2e-4


@dataclass(frozen=True)
class GrowthOptions:
    """When and where anchors are added and removed. Iterations are those of a published run, see `for_run`."""

    statistics_from: int = 500  # statistics are collected after this iteration
    grow_from: int = 1500  # anchors are added and pruned after this iteration
    grow_until: int = 15_000  # anchors are added and pruned before this iteration; statistics end here too
    grow_every: int = 100  # iterations between two rounds of growth
    gradient_threshold: float = PUBLISHED_THRESHOLD / 3  # the loss is a mean over 3 channels, the published one a sum
    levels: int = 3  # number of grids, from coarse to fine
    coarsest: int = 16  # cell of the first level, in voxels
    refinement: int = 4  # each level's cells are smaller by this factor, its threshold larger by refinement // 2
    eligible_share: float = 0.4  # a Gaussian must have been seen in more than this share of grow_every iterations
    prune_share: float = 0.8  # an anchor must have been decoded in more than this share of grow_every iterations
    min_opacity: float = 0.01  # anchors with a smaller mean sum of positive opacities are pruned
    log_scale_cap: float | None = None  # upper limit of log-scales of Gaussians, applied when pruning
    max_anchors: int | None = 1_000_000  # beyond it only the places with the largest gradients get anchors

    def __post_init__(self) -> None:
        check(self, "at least 1", lambda count: count >= 1, "levels", "coarsest")
        check(self, "at least 2", lambda factor: factor >= 2, "refinement")
        if self.coarsest % self.refinement ** (self.levels - 1):
            raise ValueError(
                f"coarsest is {self.coarsest} voxels; it must be a multiple of refinement ** (levels - 1), "
                f"here {self.refinement} ** {self.levels - 1}"
            )
        check(self, "at least 1 iteration", lambda every: every >= 1, "grow_every")
        times = ("statistics_from", "grow_from", "grow_until")
        check(self, "an iteration, at least 0", lambda iteration: iteration >= 0, *times)
        check(self, ">= 0 and finite", lambda value: 0 <= value < math.inf, "gradient_threshold", "min_opacity")
        check(self, "a share in [0, 1]", lambda share: 0 <= share <= 1, "eligible_share", "prune_share")
        check(self, "at least 1, or null for no limit", lambda most: most is None or most >= 1, "max_anchors")

    def for_run(self, iterations: int) -> GrowthOptions:
        """Return the options for another length, windows as shares of it; intervals are `MIN_GROW_EVERY` at least."""
        return replace(
            self,
            statistics_from=scaled(self.statistics_from, iterations),
            grow_from=scaled(self.grow_from, iterations),
            grow_until=scaled(self.grow_until, iterations),
            grow_every=max(min(MIN_GROW_EVERY, self.grow_every), scaled(self.grow_every, iterations)),
        )


@dataclass(frozen=True)
class NewAnchors:
    """Anchors to be added, and the gradients that ask for them."""

    cells: Tensor  # [M, 3] int64, in voxels
    features: Tensor  # [M, C]
    sizes: Tensor  # [M] side of the cell of each, in voxels
    gradients: Tensor  # [M] largest mean gradient of the Gaussians in that cell

    def __len__(self) -> int:
        return len(self.cells)

    def largest(self, count: int) -> NewAnchors:
        """Return the `count` anchors with the largest gradients, in order; ties go to the first."""
        chosen = torch.argsort(self.gradients, descending=True, stable=True)[:count].sort().values
        return NewAnchors(self.cells[chosen], self.features[chosen], self.sizes[chosen], self.gradients[chosen])


class Growth:
    """Densification of one model; random choices are of its `generator`, on the CPU.

    `statistics` are sums since each entry was last used, one row per anchor (A anchors of K Gaussians): opacity [A],
    positive raw opacities; decoded [A], iterations; gradient [A, K], norms; seen [A, K], iterations.
    """

    def __init__(self, model: PaDGS, options: GrowthOptions, *, seed: int = 0) -> None:
        self.model, self.options = model, options
        self.generator = torch.Generator().manual_seed(seed)
        self.reset_statistics()

    def reset_statistics(self) -> None:
        """Set the statistics to 0, for the present number of anchors."""
        self.statistics = self._empty(len(self.model))

    def observe(self, raw_opacities: Tensor, slots: Tensor, gradient: Tensor, visible: Tensor, iteration: int) -> None:
        """Add one view: raw opacities [A, K], distinct slots [N], positional gradient [N, 2] and visible [N] bool."""
        if not self.options.statistics_from < iteration < self.options.grow_until:
            return
        statistics = self.statistics
        statistics["opacity"] += raw_opacities.clamp(min=0).sum(-1)
        statistics["decoded"] += 1
        # All rows, invisible ones with zeros: the host would have to wait for the number of visible ones.
        statistics["gradient"].view(-1)[slots] += torch.where(visible, gradient.norm(dim=-1), 0)
        statistics["seen"].view(-1)[slots] += visible

    @torch.no_grad()
    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Grow, then prune, if it is time to; return events."""
        options = self.options
        if not options.grow_from < iteration < options.grow_until or iteration % options.grow_every:
            return ()
        # By the clock iterations skip steps: a round after fewer iterations is judged by these, or left out.
        planned = max(1, min(options.grow_every, iteration - options.statistics_from))
        share = min(1.0, self.statistics["decoded"].max().item() / planned)
        return (*self._grow(optimizer, share), *self._prune(optimizer, share)) if share >= LEAST_SHARE else ()

    def keep(self, rows: Tensor, optimizer: torch.optim.Adam | None) -> None:
        """Keep these anchors only, [A] bool or row numbers, with their statistics and Adam moments."""
        keep_rows(self.model.rows(), optimizer, rows)
        self.model.positions = self.model.positions[rows]
        self.statistics = {name: values[rows] for name, values in self.statistics.items()}

    def _grow(self, optimizer: torch.optim.Adam, share: float) -> tuple[str, ...]:
        model, options, statistics = self.model, self.options, self.statistics
        eligible = statistics["seen"] > options.eligible_share * share * options.grow_every
        mean_gradient = torch.where(eligible, statistics["gradient"] / statistics["seen"].clamp(min=1), -1.0)
        new_anchors = find_new_anchors(model, mean_gradient.view(-1), options, self.generator)
        for name in ("gradient", "seen"):
            statistics[name].masked_fill_(eligible, 0)
        room = len(new_anchors) if options.max_anchors is None else max(0, options.max_anchors - len(model))
        found, new_anchors = len(new_anchors), new_anchors if len(new_anchors) <= room else new_anchors.largest(room)
        limited = f"max_anchors {options.max_anchors} left out {found - len(new_anchors)} of {found} new anchors"
        events = (limited,) if len(new_anchors) < found else ()
        if len(new_anchors) == 0:
            return events
        log_sizes = torch.log(new_anchors.sizes * (model.voxel_size / model.unit)).to(model.log_scales)
        new = {
            "offsets": model.offsets.new_zeros(len(new_anchors), *model.offsets.shape[1:]),
            "features": new_anchors.features,
            "log_scales": log_sizes[:, None].expand(-1, 6),
        }
        append_rows(model.rows(), optimizer, new)
        positions = points_from_cells(new_anchors.cells, model.voxel_size, model.positions.dtype)
        model.positions = torch.cat((model.positions, positions))
        self.statistics = {
            name: torch.cat((old, fresh))
            for (name, old), fresh in zip(statistics.items(), self._empty(len(new_anchors)).values(), strict=True)
        }
        return (f"grew {len(new_anchors)} anchors", *events)

    def _prune(self, optimizer: torch.optim.Adam, share: float) -> tuple[str, ...]:
        model, options, statistics = self.model, self.options, self.statistics
        judged = statistics["decoded"] > options.prune_share * share * options.grow_every
        faint = judged & (statistics["opacity"] < options.min_opacity * statistics["decoded"])
        for name in ("opacity", "decoded"):
            statistics[name].masked_fill_(judged, 0)
        if faint.all():
            raise Failure("collapsed", f"all {len(faint)} anchors are fainter than min_opacity {options.min_opacity}")
        if faint.any():
            self.keep(~faint, optimizer)
        if options.log_scale_cap is not None:
            model.log_scales.data[:, 3:].clamp_(max=options.log_scale_cap - math.log(model.unit))
        count = int(faint.sum())
        return (f"pruned {count} anchors",) if count else ()

    def _empty(self, count: int) -> dict[str, Tensor]:
        zeros, each = self.model.positions.new_zeros, (count, self.model.options.offsets)
        return {"opacity": zeros(count), "decoded": zeros(count), "gradient": zeros(each), "seen": zeros(each)}


def find_new_anchors(
    model: PaDGS, mean_gradient: Tensor, options: GrowthOptions, generator: torch.Generator
) -> NewAnchors:
    """Return cells without an anchor that hold a Gaussian with a large gradient.

    Levels go from coarse to fine with growing thresholds; at each a candidate is kept with probability
    1 - 0.5^(level + 1). If the coarsest level finds none, finer ones are skipped. `mean_gradient` [A K] is negative for
    Gaussians that may not be candidates.
    """
    centers, offsets = model.centers(), model.options.offsets
    anchors = cells_from_points(model.positions, model.voxel_size)  # [A, 3] in voxels
    nothing = mean_gradient[:0]
    found = [NewAnchors(anchors[:0], model.features.detach()[:0], nothing, nothing)]
    for level in range(options.levels):
        side = options.coarsest // options.refinement**level
        threshold = options.gradient_threshold * (options.refinement // 2) ** level
        sampled = torch.rand(len(centers), generator=generator).to(centers.device) > 0.5 ** (level + 1)
        candidates = (sampled & (mean_gradient >= threshold)).nonzero()[:, 0]
        cells, inverse = unique_cells(cells_from_points(centers[candidates], side * model.voxel_size))
        taken = torch.cat([anchors, *(new_anchors.cells for new_anchors in found)])
        free = ~occupied(cells, by=cells_from_points(taken, side))
        if free.any():
            features = _largest_per_cell(model.features.detach()[candidates // offsets], inverse, len(cells))[free]
            gradients = _largest_per_cell(mean_gradient[candidates], inverse, len(cells))[free]
            sizes = torch.full_like(gradients, side)
            found.append(NewAnchors(cells[free] * side, features, sizes, gradients))
        if len(found) == 1:
            break
    columns = zip(*(vars(new_anchors).values() for new_anchors in found), strict=True)
    return NewAnchors(*map(torch.cat, columns))


def _largest_per_cell(values: Tensor, cell: Tensor, count: int) -> Tensor:
    """Return the elementwise maximum [count, ...] of values [S, ...] of each cell [S]."""
    index = cell.view(-1, *(1,) * (values.ndim - 1)).expand_as(values)
    return values.new_zeros(count, *values.shape[1:]).scatter_reduce(0, index, values, "amax", include_self=False)
