"""Densification of explicit Gaussians as in 3DGS: clone, split, prune and reset opacities.

A Gaussian with a large positional gradient, averaged over the views since the last round, marks a place with too few
Gaussians. A small one is cloned; a large one is replaced by two smaller ones sampled from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.checks import check, check_known
from padgs.gaussians import rotation_matrices
from padgs.methods.splats.splats import Splats
from padgs.training.optimizer import append_rows, forget_moments, keep_rows
from padgs.training.schedule import scaled

MIN_DENSIFY_EVERY = 50  # iterations; the mean gradient over fewer views is mostly noise
MIN_RESET_EVERY = 500  # iterations; after a reset opacities need some 200 steps of Adam, however long the run
PIECES = 2  # Gaussians that replace a split one
SHRINK = 0.8 * PIECES  # their scales are smaller by this factor
MIN_DECAYED_OPACITY = 1e-6
MAX_PIECE_OPACITY = 0.99
POSITIONAL_GRADIENTS = ("image", "space", "space_absolute")
SPLITS = ("random", "long_axis")
AXIS_TIE = 1e-3  # axes that differ by a smaller share are equally long
AXIS_STEP = 0.7  # of split="long_axis": distance of a piece from the middle, in standard deviations
AXIS_WIDTH = 0.7  # ... and the factor on its other two standard deviations


@dataclass(frozen=True)
class DensificationOptions:
    """When and where Gaussians are added and removed. Iterations are those of a published run, see `for_run`."""

    densify_from: int = 500  # Gaussians are added and pruned after this iteration
    densify_until: int = 15_000  # ... and before this iteration
    densify_every: int = 100  # iterations between two rounds
    # Gradient that is compared with the threshold. image: by the projected mean in normalised image units (3DGS).
    # space: by the mean itself, in units of half its distance to the camera (SPaGS). space_absolute: as space, and as
    # many Gaussians again by the sum of absolute gradients of single pixels (absgrad, GOF).
    positional_gradient: str = "image"
    gradient_threshold: float = 2e-4  # in the unit of the positional gradient, for a loss that is a plain mean
    percent_dense: float = 0.01  # largest scale that is cloned rather than split, in extents
    sample_clones: bool = False  # clones are placed at random inside the Gaussian, not exactly on it (GOF)
    # random: two pieces at random inside the Gaussian (3DGS). long_axis: two along its longest axis, which together are
    # as opaque in the middle as it was, up to 0.85 (Improved-GS).
    split: str = "random"
    min_opacity: float = 0.005  # fainter Gaussians are pruned
    opacity_decay: float = 0.0  # subtracted from all opacities in every round
    prune_by_extent: bool = False  # also prune scales above max_scale; empties scenes with little camera motion
    max_scale: float = 0.1  # in extents
    prune_by_extent_from: int = 3000  # ... after this iteration
    reset_every: int = 3000  # iterations between opacity resets
    reset_opacity: float = 0.01  # upper limit of rendered opacities after a reset; 1: only Adam's moments are reset
    max_gaussians: int | None = 10_000_000  # beyond it only those with the largest gradients are cloned or split

    def __post_init__(self) -> None:
        check(self, "at least 1 iteration", lambda every: every >= 1, "densify_every", "reset_every")
        times = ("densify_from", "densify_until", "prune_by_extent_from")
        check(self, "an iteration, at least 0", lambda iteration: iteration >= 0, *times)
        sizes = ("gradient_threshold", "percent_dense", "max_scale")
        check(self, ">= 0 and finite", lambda value: 0 <= value < math.inf, *sizes)
        check_known(self, positional_gradient=POSITIONAL_GRADIENTS, split=SPLITS)
        check(self, "an opacity > 0", lambda opacity: 0 < opacity <= 1, "reset_opacity")
        check(self, "an opacity below 1", lambda opacity: 0 <= opacity < 1, "opacity_decay", "min_opacity")
        check(self, "at least 1, or null for no limit", lambda most: most is None or most >= 1, "max_gaussians")

    def for_run(self, iterations: int) -> DensificationOptions:
        """Return the options for another length, windows as shares of it; intervals have lower limits."""
        every = scaled(self.densify_every, iterations)
        return replace(
            self,
            densify_from=scaled(self.densify_from, iterations),
            densify_until=scaled(self.densify_until, iterations),
            prune_by_extent_from=scaled(self.prune_by_extent_from, iterations),
            densify_every=max(min(MIN_DENSIFY_EVERY, self.densify_every), every),
            reset_every=max(min(MIN_RESET_EVERY, self.reset_every), scaled(self.reset_every, iterations)),
        )


class Densifier:
    """Densification of one model; random positions are of its `generator`, on the CPU.

    `statistics` are sums since the last round, one row per Gaussian: gradient [N] norms, seen [N] iterations, and for
    space_absolute absolute [N] gradients.
    """

    def __init__(
        self,
        splats: Splats,
        options: DensificationOptions,
        *,
        extent: float,
        extents: Callable[[Tensor], Tensor] | None = None,
        target: int | None = None,
        rendered_opacities: Callable[[], Tensor] | None = None,
        seed: int = 0,
    ) -> None:
        """Start with empty statistics; `options` have iterations of the run, see `DensificationOptions.for_run`.

        Sizes are compared with `extent`, world units, or with what `extents` returns [N] for means [N, 3]. `target` is
        the number of Gaussians to reach by the last round, in equal steps; None: as many as thresholds give.
        `rendered_opacities` returns opacities [N] in [0, 1] after filters, at most the stored ones.
        """
        self._rendered_opacities = rendered_opacities or (lambda: torch.sigmoid(splats.opacity_logits))
        self.splats, self.options, self.extent, self._extents = splats, options, extent, extents
        self._target = target
        self.generator = torch.Generator().manual_seed(seed)
        self.reset_statistics()

    def observe(self, gradient: Tensor, visible: Tensor, iteration: int) -> None:
        """Add one view to the statistics: positional gradient [N, 2], [N, 3] or [N, 4], and visible [N] bool."""
        if iteration < self.options.densify_until:
            if self.options.positional_gradient == "space_absolute":
                gradient, absolute = gradient[:, :3], gradient[:, 3]
                self.statistics["absolute"] += torch.where(visible, absolute, 0.0)
            self.statistics["gradient"] += torch.where(visible, gradient.norm(dim=-1), 0.0)
            self.statistics["seen"] += visible

    def reset_statistics(self) -> None:
        """Set the statistics to 0, for the present number of Gaussians."""
        zeros = self.splats.means.new_zeros(len(self.splats))
        more = ["absolute"] if self.options.positional_gradient == "space_absolute" else []
        self.statistics = {name: zeros.clone() for name in ("gradient", "seen", *more)}

    @torch.no_grad()
    def adapt(
        self, iteration: int, optimizer: torch.optim.Adam, *, grows: Callable[[], bool] = lambda: True
    ) -> tuple[str, ...]:
        """Clone, split, prune and reset opacities if it is time to, and `grows()` in a round; return events."""
        options = self.options
        if iteration >= options.densify_until:
            return ()
        events = []
        if iteration > options.densify_from and iteration % options.densify_every == 0 and grows():
            cloned, split, left_out = self._multiply(optimizer, iteration)
            pruned = self._prune(optimizer, iteration)
            self._decay_opacities(optimizer)
            self.reset_statistics()
            events.append(f"cloned {cloned}, split {split}, pruned {pruned} Gaussians")
            if left_out:
                total = cloned + split + left_out
                events.append(f"max_gaussians {options.max_gaussians} left out {left_out} of {total} candidates")
        # After a reset rounds must follow, as in the published schedule.
        if iteration % options.reset_every == 0 and iteration + 2 * options.densify_every < options.densify_until:
            self._reset_opacities(optimizer)
            events.append("reset opacities")
        return tuple(events)

    def _multiply(self, optimizer: torch.optim.Adam, iteration: int) -> tuple[int, int, int]:
        """Clone and split within `max_gaussians`; return the numbers cloned, split and left out."""
        rows = self.splats.rows()
        seen = self.statistics["seen"].clamp(min=1)
        mean_gradient = self.statistics["gradient"] / seen
        chosen = self._above_threshold(mean_gradient, seen)
        if self._target is not None:
            chosen = self._towards_target(mean_gradient, seen, iteration)
        candidate_count = int(chosen.sum())
        if self.options.max_gaussians is not None:
            room = max(0, self.options.max_gaussians - len(chosen))
            if candidate_count > room:
                chosen = _largest(torch.where(chosen, mean_gradient, -1.0), room)
        small = ~self._is_larger(self.options.percent_dense)
        clones = self._copies(chosen & small, 1, sampled=self.options.sample_clones)
        pieces = self._pieces(chosen & ~small)
        append_rows(rows, optimizer, {name: torch.cat((clones[name], pieces[name])) for name in rows})
        replaced = torch.zeros(len(self.splats), dtype=torch.bool, device=chosen.device)
        replaced[: len(chosen)] = chosen & ~small
        keep_rows(rows, optimizer, ~replaced)
        cloned, split = len(clones["means"]), len(pieces["means"]) // PIECES
        return cloned, split, candidate_count - cloned - split

    def _above_threshold(self, mean_gradient: Tensor, seen: Tensor) -> Tensor:
        """Return which Gaussians [N] exceed the threshold; means are over `seen` [N] views."""
        chosen = mean_gradient >= self.options.gradient_threshold
        if self.options.positional_gradient == "space_absolute":  # above the quantile 1 - (chosen / all)
            chosen |= _largest(self.statistics["absolute"] / seen, int(chosen.sum()))
        return chosen

    def _towards_target(self, mean_gradient: Tensor, seen: Tensor, iteration: int) -> Tensor:
        """Return which Gaussians [N] multiply on the way to the target, half of them by absolute gradients if known."""
        assert self._target is not None
        rounds = 1 + (self.options.densify_until - 1 - iteration) // self.options.densify_every  # with this one
        count = max(0, self._target - len(seen)) // rounds
        if self.options.positional_gradient != "space_absolute":
            return _largest(mean_gradient, count)
        chosen = _largest(mean_gradient, count // 2)
        absolute = (self.statistics["absolute"] / seen).masked_fill(chosen, -1.0)
        return chosen | _largest(absolute, count - int(chosen.sum()))

    def _pieces(self, split: Tensor) -> dict[str, Tensor]:
        """Return rows that replace the Gaussians marked in split [N]: smaller ones inside them."""
        if self.options.split == "long_axis":
            return self._pieces_of_long_axis(split)
        pieces = self._copies(split, PIECES, sampled=True)
        pieces["log_scales"] = pieces["log_scales"] - math.log(SHRINK)
        return pieces

    def _pieces_of_long_axis(self, split: Tensor) -> dict[str, Tensor]:
        """Return pairs at +- `AXIS_STEP` on the longest axis, whose variance with that of the pair is as before."""
        pieces = self._copies(split, PIECES, sampled=False)
        scales, step = torch.exp(pieces["log_scales"]), AXIS_STEP
        longest = scales >= (1 - AXIS_TIE) * scales.amax(-1, keepdim=True)  # the first, whatever rounding does
        axis = torch.nn.functional.one_hot(longest.to(scales).argmax(-1), 3).to(scales)
        sides = scales.new_tensor((step, -step)).repeat(len(scales) // PIECES)[:, None]
        rotations = rotation_matrices(pieces["quats"])
        pieces["means"] = pieces["means"] + (rotations @ (sides * axis * scales)[..., None])[..., 0]
        factors = torch.where(axis > 0, math.sqrt(1 - step * step), AXIS_WIDTH)
        pieces["log_scales"] = pieces["log_scales"] + factors.log()
        # In the middle each piece has `share` of its opacity: 1 - (1 - o share)^2 is the opacity of before.
        share = math.exp(-0.5 * step * step / (1 - step * step))
        opacities = (1 - (1 - torch.sigmoid(pieces["opacity_logits"])).sqrt()) / share
        pieces["opacity_logits"] = torch.logit(opacities.clamp(max=MAX_PIECE_OPACITY), eps=MIN_DECAYED_OPACITY)
        return pieces

    def _copies(self, which: Tensor, times: int, *, sampled: bool) -> dict[str, Tensor]:
        """Return rows of the Gaussians marked in `which` [N], repeated; sampled: at random places inside them."""
        copies = {name: parameter[which].repeat_interleave(times, 0) for name, parameter in self.splats.rows().items()}
        if sampled:
            scales = torch.exp(copies["log_scales"])
            steps = torch.randn(scales.shape, generator=self.generator).to(scales) * scales
            copies["means"] = copies["means"] + (rotation_matrices(copies["quats"]) @ steps[..., None])[..., 0]
        return copies

    def _prune(self, optimizer: torch.optim.Adam, iteration: int) -> int:
        # Not ">=": NaN stays, so that the loop finds and reports it.
        keep = ~(torch.sigmoid(self.splats.opacity_logits) < self.options.min_opacity)
        if self.options.prune_by_extent and iteration > self.options.prune_by_extent_from:
            keep &= ~self._is_larger(self.options.max_scale)
        keep_rows(self.splats.rows(), optimizer, keep)
        return int((~keep).sum())

    def _is_larger(self, size: float) -> Tensor:
        """Return which Gaussians [N] have a scale above `size` extents."""
        extent = self.extent if self._extents is None else self._extents(self.splats.means)
        return torch.exp(self.splats.log_scales).amax(-1) > size * extent

    def _decay_opacities(self, optimizer: torch.optim.Adam) -> None:
        if self.options.opacity_decay > 0:
            logits = self.splats.opacity_logits
            opacities = torch.sigmoid(logits) - self.options.opacity_decay
            logits.copy_(torch.logit(opacities.clamp(min=MIN_DECAYED_OPACITY)))
            forget_moments(logits, optimizer)

    def _reset_opacities(self, optimizer: torch.optim.Adam) -> None:
        """Limit the opacity that is rendered, o c with the compensation c of a filter, by o = limit / c (GOF)."""
        logits, highest = self.splats.opacity_logits, self.options.reset_opacity
        rendered = self._rendered_opacities()
        lowered = torch.logit(torch.sigmoid(logits) * highest / rendered)
        logits.copy_(torch.where(rendered > highest, lowered, logits))
        forget_moments(logits, optimizer)


def _largest(values: Tensor, count: int) -> Tensor:
    """Return a mask [N] of the `count` largest values; ties go to the first."""
    order = torch.argsort(values, descending=True, stable=True)[:count]
    return torch.zeros_like(values, dtype=torch.bool).index_fill(0, order, True)
