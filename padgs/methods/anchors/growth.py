"""Growing and pruning anchors: where Gaussians pull hard on the image, new anchors; where nothing shows, none.

Statistics are collected over many views (`observe`) and acted upon every `grow_every` iterations (`adapt`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.checks import check
from padgs.methods.anchors.grid import cells_from_points, occupied, points_from_cells, unique_cells
from padgs.methods.anchors.model import PaDGS
from padgs.training.health import Failure
from padgs.training.optimizer import append_rows, keep_rows
from padgs.training.schedule import scaled

MIN_GROW_EVERY = 50  # iterations; below it `eligible_share` asks for too few views to average over
PUBLISHED_THRESHOLD = 2e-4


@dataclass(frozen=True)
class GrowthOptions:
    """When and where anchors grow and vanish. Iterations are those of a published run; see `for_run`."""

    statistics_from: int = 500  # statistics are collected after this iteration
    grow_from: int = 1500  # anchors grow and are pruned after this iteration
    grow_until: int = 15_000  # ... and before this one, and statistics are collected no longer either
    grow_every: int = 100  # iterations between two rounds of growth
    gradient_threshold: float = PUBLISHED_THRESHOLD / 3  # the loss is a mean over 3 channels, the published one a sum
    levels: int = 3  # grids from coarse to fine
    coarsest: int = 16  # cell of the first level, in voxels
    refinement: int = 4  # each level's cells are smaller by this factor, its threshold larger by refinement / 2
    eligible_share: float = 0.4  # a Gaussian must have been seen in more than this share of grow_every iterations
    prune_share: float = 0.8  # an anchor must have been decoded in more than this share of grow_every iterations
    min_opacity: float = 0.01  # anchors whose positive opacities sum to less, on average over views, are pruned
    log_scale_cap: float | None = None  # upper limit of Gaussians' log-scales, applied when pruning
    max_anchors: int | None = 1_000_000  # of ten Gaussians each; those with the largest gradients grow

    def __post_init__(self) -> None:
        if self.levels < 1 or self.refinement < 2 or self.coarsest % self.refinement ** (self.levels - 1):
            raise ValueError(
                f"coarsest is {self.coarsest} voxels; it must be a multiple of refinement ** (levels - 1), "
                f"here {self.refinement} ** {self.levels - 1}"
            )
        check(self, "at least 1 iteration", lambda every: every >= 1, "grow_every")
        times = ("statistics_from", "grow_from", "grow_until")
        check(self, "an iteration, at least 0", lambda iteration: iteration >= 0, *times)
        check(self, ">= 0 and finite", lambda value: 0 <= value < math.inf, "gradient_threshold", "min_opacity")
        check(self, "a share in [0, 1]", lambda share: 0 <= share <= 1, "eligible_share", "prune_share")
        check(self, "at least 1, or none for no limit", lambda most: most is None or most >= 1, "max_anchors")

    def for_run(self, iterations: int) -> GrowthOptions:
        """The same phases in a run of another length: every window is the same share of the run as published.

        The interval shrinks too, but not below `MIN_GROW_EVERY`, so short runs have fewer rounds of growth (26 instead
        of 134 at 3 000 iterations) with as many views behind each as they can.
        """
        return replace(
            self,
            statistics_from=scaled(self.statistics_from, iterations),
            grow_from=scaled(self.grow_from, iterations),
            grow_until=scaled(self.grow_until, iterations),
            grow_every=max(min(MIN_GROW_EVERY, self.grow_every), scaled(self.grow_every, iterations)),
        )

    def cell(self, level: int) -> int:
        """Side of a level's grid cells, in voxels."""
        return self.coarsest // self.refinement**level

    def threshold(self, level: int) -> float:
        """Mean gradient from which a Gaussian is a candidate at a level, in the units of a render's probe."""
        return self.gradient_threshold * (self.refinement // 2) ** level


@dataclass(frozen=True)
class Seeds:
    """Anchors about to be added, and how strongly their place was asked for."""

    cells: Tensor  # [M, 3] int64, in voxels
    features: Tensor  # [M, C]
    sizes: Tensor  # [M] side of the cell that each was found in, in voxels
    strength: Tensor  # [M] largest mean gradient of the Gaussians in that cell

    def __len__(self) -> int:
        return len(self.cells)

    def strongest(self, count: int) -> Seeds:
        """The `count` strongest, in their order; of equal ones the first."""
        chosen = torch.argsort(self.strength, descending=True, stable=True)[:count].sort().values
        return Seeds(self.cells[chosen], self.features[chosen], self.sizes[chosen], self.strength[chosen])


class Growth:
    """Densification of one model.

    Attributes:
        statistics: sums since each entry was last acted upon, one row per anchor (A anchors of K Gaussians):
            opacity [A] of its positive raw opacities, decoded [A] iterations, gradient [A, K] norms, seen [A, K]
            iterations.
        generator: source of the random choices, on the CPU.
    """

    def __init__(self, model: PaDGS, options: GrowthOptions, *, seed: int = 0) -> None:
        self.model, self.options = model, options
        self.generator = torch.Generator().manual_seed(seed)
        self.forget()

    def forget(self) -> None:
        """Start anew with empty statistics, of as many anchors as there are now."""
        self.statistics = self._empty(len(self.model))

    def observe(self, raw_opacities: Tensor, slots: Tensor, gradient: Tensor, visible: Tensor, iteration: int) -> None:
        """Add one view to the statistics.

        Args:
            raw_opacities: [A, K] as decoded.
            slots: [N] anchor K + k of each Gaussian that was drawn; no two alike.
            gradient: [N, 2] derivative of the loss by the probe of `padgs.render.render`.
            visible: [N] bool, as the renderer says.
            iteration: 1 for the first.
        """
        if not self.options.statistics_from < iteration < self.options.grow_until:
            return
        statistics = self.statistics
        statistics["opacity"] += raw_opacities.clamp(min=0).sum(-1)
        statistics["decoded"] += 1
        # All of them, the others with zeros: how many are visible is a number that the host would wait for.
        statistics["gradient"].view(-1)[slots] += torch.where(visible, gradient.norm(dim=-1), 0)
        statistics["seen"].view(-1)[slots] += visible

    @torch.no_grad()
    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Grow, then prune, if it is time to; returns what happened.

        Raises:
            Failure: status collapsed, if no anchor would be left.
        """
        options = self.options
        if not options.grow_from < iteration < options.grow_until or iteration % options.grow_every:
            return ()
        return (*self._grow(optimizer), *self._prune(optimizer))

    def keep(self, rows: Tensor, optimizer: torch.optim.Adam | None) -> None:
        """Keep these anchors only, [A] bool or row numbers, with their statistics and moments if there are any."""
        keep_rows(self.model.rows(), optimizer, rows)
        self.model.positions = self.model.positions[rows]
        self.statistics = {name: values[rows] for name, values in self.statistics.items()}

    def _grow(self, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        model, options, statistics = self.model, self.options, self.statistics
        eligible = statistics["seen"] > options.eligible_share * options.grow_every
        mean_gradient = torch.where(eligible, statistics["gradient"] / statistics["seen"].clamp(min=1), -1.0)
        seeds = find_seeds(model, mean_gradient.view(-1), options, self.generator)
        for name in ("gradient", "seen"):
            statistics[name].masked_fill_(eligible, 0)
        room = len(seeds) if options.max_anchors is None else max(0, options.max_anchors - len(model))
        found, seeds = len(seeds), seeds if len(seeds) <= room else seeds.strongest(room)
        limited = f"max_anchors {options.max_anchors} left out {found - len(seeds)} of {found} new anchors"
        events = (limited,) if len(seeds) < found else ()
        if len(seeds) == 0:
            return events
        log_sizes = torch.log(seeds.sizes * model.voxel_size).to(model.log_scales)
        new = {
            "offsets": model.offsets.new_zeros(len(seeds), *model.offsets.shape[1:]),
            "features": seeds.features,
            "log_scales": log_sizes[:, None].expand(-1, 6),
        }
        append_rows(model.rows(), optimizer, new)
        positions = points_from_cells(seeds.cells, model.voxel_size, model.positions.dtype)
        model.positions = torch.cat((model.positions, positions))
        self.statistics = {
            name: torch.cat((old, fresh))
            for (name, old), fresh in zip(statistics.items(), self._empty(len(seeds)).values(), strict=True)
        }
        return (f"grew {len(seeds)} anchors", *events)

    def _prune(self, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        model, options, statistics = self.model, self.options, self.statistics
        judged = statistics["decoded"] > options.prune_share * options.grow_every
        faint = judged & (statistics["opacity"] < options.min_opacity * statistics["decoded"])
        for name in ("opacity", "decoded"):
            statistics[name].masked_fill_(judged, 0)
        if faint.all():
            raise Failure("collapsed", f"all {len(faint)} anchors are fainter than min_opacity {options.min_opacity}")
        if faint.any():
            self.keep(~faint, optimizer)
        if options.log_scale_cap is not None:
            model.log_scales.data[:, 3:].clamp_(max=options.log_scale_cap)
        count = int(faint.sum())
        return (f"pruned {count} anchors",) if count else ()

    def _empty(self, count: int) -> dict[str, Tensor]:
        zeros, offsets = self.model.positions.new_zeros, self.model.options.offsets
        return {
            "opacity": zeros(count),
            "decoded": zeros(count),
            "gradient": zeros(count, offsets),
            "seen": zeros(count, offsets),
        }


def find_seeds(model: PaDGS, mean_gradient: Tensor, options: GrowthOptions, generator: torch.Generator) -> Seeds:
    """Places for new anchors: cells without an anchor that hold a Gaussian with a large gradient.

    Level by level from coarse to fine, with growing thresholds; at each level a candidate is kept with probability
    1 - 0.5^(level + 1). If the coarsest level finds none, the finer ones are not tried.

    Args:
        model: A anchors with K Gaussians each.
        mean_gradient: [A K] mean over views, negative for Gaussians that may not be candidates.
        options: grids and thresholds.
        generator: of the random choices, on the CPU.
    """
    centers, offsets = model.centers(), model.options.offsets
    anchors = cells_from_points(model.positions, model.voxel_size)  # [A, 3] in voxels
    found: list[Seeds] = []
    for level in range(options.levels):
        side = options.cell(level)
        lucky = torch.rand(len(centers), generator=generator).to(centers.device) > 0.5 ** (level + 1)
        candidates = (lucky & (mean_gradient >= options.threshold(level))).nonzero()[:, 0]
        cells, inverse = unique_cells(cells_from_points(centers[candidates], side * model.voxel_size))
        taken = torch.cat([anchors, *(seeds.cells for seeds in found)])
        free = ~occupied(cells, by=cells_from_points(taken, side))
        if free.any():
            features = _largest_per_cell(model.features.detach()[candidates // offsets], inverse, len(cells))[free]
            strength = _largest_per_cell(mean_gradient[candidates], inverse, len(cells))[free]
            sizes = torch.full_like(strength, side)
            found.append(Seeds(cells[free] * side, features, sizes, strength))
        if not found:
            break
    if not found:
        nothing = anchors[:0]
        return Seeds(nothing, model.features.detach()[:0], mean_gradient[:0], mean_gradient[:0])
    return Seeds(*(torch.cat([getattr(seeds, name) for seeds in found]) for name in Seeds.__annotations__))


def _largest_per_cell(values: Tensor, cell: Tensor, count: int) -> Tensor:
    """Elementwise maximum [count, ...] of the values [S, ...] of each cell [S]."""
    index = cell.view(-1, *(1,) * (values.ndim - 1)).expand_as(values)
    return values.new_zeros(count, *values.shape[1:]).scatter_reduce(0, index, values, "amax", include_self=False)
