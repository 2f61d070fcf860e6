"""Densification of explicit Gaussians, as 3DGS and OmniGS do it: clone the small, split the large, prune the faint.

A Gaussian that is pulled hard (`padgs.methods.splats.probes`), on average over the views since the last round, marks a place
where there are too few. Where it is small it is copied, where it is large two smaller ones sampled from it take its
place.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.checks import check, check_known
from padgs.gaussians import rotation_matrices
from padgs.methods.splats.model import Splats
from padgs.methods.splats.probes import SIGNALS
from padgs.training.optimizer import append_rows, forget_moments, keep_rows
from padgs.training.schedule import scaled

MIN_DENSIFY_EVERY = 50  # iterations; the mean gradient over fewer views is mostly noise
MIN_RESET_EVERY = 500  # iterations; after a reset opacities need some 200 steps of Adam, however long the run
PIECES = 2  # a split Gaussian becomes this many
SHRINK = 0.8 * PIECES  # ... each smaller by this factor
FAINTEST = 1e-6  # opacity that decay stops at


@dataclass(frozen=True)
class CloneSplitOptions:
    """When and where Gaussians multiply and vanish. Iterations are those of a published run; see `for_run`."""

    densify_from: int = 500  # Gaussians multiply and are pruned after this iteration
    densify_until: int = 15_000  # ... and before this one
    densify_every: int = 100  # ... in rounds that are so many iterations apart
    # What is compared with the threshold: a name of `padgs.methods.splats.probes.SIGNALS`. With space_absolute as many
    # Gaussians as pass it multiply for their absolute pull, those that are pulled hardest (GOF).
    signal: str = "image"
    gradient_threshold: float = 2e-4  # in the units of the signal's probe, for a loss that is a plain mean
    polar_threshold: float | None = None  # what it grows to at the poles, with 1 - cos(latitude) (ODGS); None: nothing
    percent_dense: float = 0.01  # largest scale that is cloned rather than split, in extents
    sample_clones: bool = False  # clones are placed at random inside the Gaussian, not exactly on it (GOF)
    min_opacity: float = 0.005  # fainter Gaussians are pruned
    opacity_decay: float = 0.0  # taken from all opacities in every round
    prune_by_extent: bool = False  # also prune scales above max_scale; empties scenes of tiny camera motion
    max_scale: float = 0.1  # in extents
    prune_by_extent_from: int = 3000  # ... after this iteration
    extent_margin: float = 0.0  # world units added to the extent that sizes are compared with (the released ODGS)
    reset_every: int = 3000  # iterations between opacity resets
    reset_opacity: float = 0.01  # none is drawn with a larger opacity after a reset
    max_gaussians: int | None = 10_000_000  # as many as PaD-GS may have; those with the largest gradients multiply
    released_start: bool = False  # bug of the released OmniGS: densify_from is read as 0
    released_reset: bool = False  # bug of the released OmniGS: resets clear Adam moments but keep the opacities

    def __post_init__(self) -> None:
        check(self, "at least 1 iteration", lambda every: every >= 1, "densify_every", "reset_every")
        times = ("densify_from", "densify_until", "prune_by_extent_from")
        check(self, "an iteration, at least 0", lambda iteration: iteration >= 0, *times)
        sizes = ("gradient_threshold", "percent_dense", "max_scale", "extent_margin")
        check(self, ">= 0 and finite", lambda value: 0 <= value < math.inf, *sizes)
        check(self, ">= 0, or none", lambda value: value is None or 0 <= value < math.inf, "polar_threshold")
        check_known(self, signal=SIGNALS)
        check(self, "an opacity below 1", lambda opacity: 0 < opacity < 1, "reset_opacity")
        check(self, "an opacity below 1", lambda opacity: 0 <= opacity < 1, "opacity_decay", "min_opacity")
        check(self, "at least 1, or none for no limit", lambda most: most is None or most >= 1, "max_gaussians")

    def for_run(self, iterations: int) -> CloneSplitOptions:
        """The same phases in a run of another length: every window is the same share of the run as published.

        The intervals shrink too, but not below `MIN_DENSIFY_EVERY` and `MIN_RESET_EVERY`: short runs have fewer rounds
        and fewer resets.
        """
        every = scaled(self.densify_every, iterations)
        return replace(
            self,
            densify_from=scaled(self.densify_from, iterations),
            densify_until=scaled(self.densify_until, iterations),
            prune_by_extent_from=scaled(self.prune_by_extent_from, iterations),
            densify_every=max(min(MIN_DENSIFY_EVERY, self.densify_every), every),
            reset_every=max(min(MIN_RESET_EVERY, self.reset_every), scaled(self.reset_every, iterations)),
        )


class CloneSplit:
    """Densification of one model.

    Attributes:
        statistics: sums since the last round, one row per Gaussian: gradient [N] norms, seen [N] iterations, for a
            threshold that depends on it polar [N]: 1 - cos(latitude), and for signal space_absolute absolute [N] pulls.
        generator: source of the random positions of split Gaussians, on the CPU.
    """

    def __init__(
        self,
        splats: Splats,
        options: CloneSplitOptions,
        *,
        extent: float,
        target: int | None = None,
        drawn_opacities: Callable[[], Tensor] | None = None,
        seed: int = 0,
    ) -> None:
        """Start with empty statistics.

        Args:
            splats: the model.
            options: iterations are those of the run.
            extent: the length that sizes are compared with, in world units.
            target: as many Gaussians as there shall be after the last round, in equal steps, those that are pulled
                hardest; None: as many as thresholds give.
            drawn_opacities: of the model as it is then, [N] in [0, 1], at most its own, where a filter lowers them.
            seed: of all that is random.
        """
        self._drawn_opacities = drawn_opacities or (lambda: torch.sigmoid(splats.opacity_logits))
        self.splats, self.options, self.extent = splats, options, extent + options.extent_margin
        self._target = target
        self.generator = torch.Generator().manual_seed(seed)
        self.statistics = self._empty()

    def observe(self, gradient: Tensor, visible: Tensor, iteration: int, cos_latitudes: Tensor | None = None) -> None:
        """Add one view.

        Args:
            gradient: [N, 2, 3 or 4] of the loss by the probe (`padgs.methods.splats.probes`).
            visible: [N] bool.
            iteration: of the view.
            cos_latitudes: [N] where the view has the Gaussians; needed with `polar_threshold` only.
        """
        if iteration < self.options.densify_until:
            if self.options.signal == "space_absolute":
                gradient, absolute = gradient[:, :3], gradient[:, 3]
                self.statistics["absolute"] += torch.where(visible, absolute, 0.0)
            self.statistics["gradient"] += torch.where(visible, gradient.norm(dim=-1), 0.0)
            self.statistics["seen"] += visible
            if self.options.polar_threshold is not None:
                assert cos_latitudes is not None, "polar_threshold needs the latitudes"
                self.statistics["polar"] += torch.where(visible, 1 - cos_latitudes, 0.0)

    def forget(self) -> None:
        """Start anew with empty statistics, of as many Gaussians as there are now."""
        self.statistics = self._empty()

    @torch.no_grad()
    def adapt(
        self, iteration: int, optimizer: torch.optim.Adam, *, grows: Callable[[], bool] = lambda: True
    ) -> tuple[str, ...]:
        """Clone, split, prune and reset opacities where it is time to; returns what happened.

        `grows` is asked when a round of growth is due, and says whether there is one.
        """
        options = self.options
        if iteration >= options.densify_until:
            return ()
        events = []
        begin = 0 if options.released_start else options.densify_from
        if iteration > begin and iteration % options.densify_every == 0 and grows():
            cloned, split, left_out = self._multiply(optimizer, iteration)
            pruned = self._prune(optimizer, iteration)
            self._decay_opacities(optimizer)
            self.forget()
            events.append(f"cloned {cloned}, split {split}, pruned {pruned} Gaussians")
            if left_out:
                total = cloned + split + left_out
                events.append(f"max_gaussians {options.max_gaussians} left out {left_out} of {total} candidates")
        if iteration % options.reset_every == 0:
            self._reset_opacities(optimizer)
            events.append("reset opacities")
        return tuple(events)

    def _multiply(self, optimizer: torch.optim.Adam, iteration: int) -> tuple[int, int, int]:
        """Clone and split; returns how many of each, and how many had to be left out.

        Each adds one Gaussian to the count, within `max_gaussians`.
        """
        rows = self.splats.rows()
        seen = self.statistics["seen"].clamp(min=1)
        mean_gradient = self.statistics["gradient"] / seen
        chosen = self._above_threshold(mean_gradient, seen)
        if self._target is not None:
            chosen = self._on_the_way(mean_gradient, seen, iteration)
        candidate_count = int(chosen.sum())
        if self.options.max_gaussians is not None:
            room = max(0, self.options.max_gaussians - len(chosen))
            if candidate_count > room:
                candidates = torch.where(chosen, mean_gradient, -1.0)  # their thresholds may differ
                chosen = _largest(candidates, room)
        small = torch.exp(self.splats.log_scales).amax(-1) <= self.options.percent_dense * self.extent
        clones = self._copies(chosen & small, 1, sampled=self.options.sample_clones)
        pieces = self._pieces(chosen & ~small)
        append_rows(rows, optimizer, {name: torch.cat((clones[name], pieces[name])) for name in rows})
        replaced = torch.zeros(len(self.splats), dtype=torch.bool, device=chosen.device)
        replaced[: len(chosen)] = chosen & ~small
        keep_rows(rows, optimizer, ~replaced)
        cloned, split = len(clones["means"]), len(pieces["means"]) // PIECES
        return cloned, split, candidate_count - cloned - split

    def _above_threshold(self, mean_gradient: Tensor, seen: Tensor) -> Tensor:
        """Which Gaussians [N] are pulled hard enough; `seen` [N] views are what means are over."""
        threshold = self.options.gradient_threshold
        if self.options.polar_threshold is not None:
            threshold += (self.options.polar_threshold - threshold) * self.statistics["polar"] / seen
        chosen = mean_gradient >= threshold
        if self.options.signal == "space_absolute":  # those above the quantile that leaves as many: 1 - (chosen / all)
            chosen |= _largest(self.statistics["absolute"] / seen, int(chosen.sum()))
        return chosen

    def _on_the_way(self, mean_gradient: Tensor, seen: Tensor, iteration: int) -> Tensor:
        """Which Gaussians [N] multiply in this round towards the target: those that are pulled hardest.

        With absolute pulls half of them are the first by these.
        """
        assert self._target is not None
        rounds = 1 + (self.options.densify_until - 1 - iteration) // self.options.densify_every  # with this one
        count = max(0, self._target - len(seen)) // rounds
        if self.options.signal != "space_absolute":
            return _largest(mean_gradient, count)
        chosen = _largest(mean_gradient, count // 2)
        absolute = (self.statistics["absolute"] / seen).masked_fill(chosen, -1.0)
        return chosen | _largest(absolute, count - int(chosen.sum()))

    def _pieces(self, split: Tensor) -> dict[str, Tensor]:
        """What takes the place of the Gaussians marked in split [N]: smaller ones, at random places inside them."""
        pieces = self._copies(split, PIECES, sampled=True)
        pieces["log_scales"] = pieces["log_scales"] - math.log(SHRINK)
        return pieces

    def _copies(self, which: Tensor, times: int, *, sampled: bool) -> dict[str, Tensor]:
        """Rows of the Gaussians marked in which [N], each so many times; sampled: at random places inside them."""
        copies = {name: parameter[which].repeat_interleave(times, 0) for name, parameter in self.splats.rows().items()}
        if sampled:
            scales = torch.exp(copies["log_scales"])
            steps = torch.randn(scales.shape, generator=self.generator).to(scales) * scales
            copies["means"] = copies["means"] + (rotation_matrices(copies["quats"]) @ steps[..., None])[..., 0]
        return copies

    def _prune(self, optimizer: torch.optim.Adam, iteration: int) -> int:
        # Not ">=": what is NaN stays, for the loop to find and name it.
        keep = ~(torch.sigmoid(self.splats.opacity_logits) < self.options.min_opacity)
        if self.options.prune_by_extent and iteration > self.options.prune_by_extent_from:
            keep &= torch.exp(self.splats.log_scales).amax(-1) <= self.options.max_scale * self.extent
        keep_rows(self.splats.rows(), optimizer, keep)
        return int((~keep).sum())

    def _decay_opacities(self, optimizer: torch.optim.Adam) -> None:
        if self.options.opacity_decay > 0:
            logits = self.splats.opacity_logits
            logits.copy_(torch.logit((torch.sigmoid(logits) - self.options.opacity_decay).clamp(min=FAINTEST)))
            forget_moments(logits, optimizer)

    def _reset_opacities(self, optimizer: torch.optim.Adam) -> None:
        """Make everything nearly transparent, so that only what the images ask for comes back.

        What is limited is the opacity that is drawn, o c with the compensation c of a filter, by o = limit / c (GOF).
        """
        logits, highest = self.splats.opacity_logits, self.options.reset_opacity
        if not self.options.released_reset:
            drawn = self._drawn_opacities()
            lowered = torch.logit(torch.sigmoid(logits) * highest / drawn)
            logits.copy_(torch.where(drawn > highest, lowered, logits))
        forget_moments(logits, optimizer)

    def _empty(self) -> dict[str, Tensor]:
        zeros = self.splats.means.new_zeros(len(self.splats))
        names = ["gradient", "seen"]
        if self.options.polar_threshold is not None:
            names.append("polar")
        if self.options.signal == "space_absolute":
            names.append("absolute")
        return {name: zeros.clone() for name in names}


def _largest(values: Tensor, count: int) -> Tensor:
    """Where [N] the `count` largest values are; of equal ones the first."""
    order = torch.argsort(values, descending=True, stable=True)[:count]
    return torch.zeros_like(values, dtype=torch.bool).index_fill(0, order, True)
