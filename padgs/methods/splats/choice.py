"""Whom to keep: a round after growth those Gaussians go that the training views would miss least."""

from __future__ import annotations

from padgs.methods.splats.clone_split import CloneSplitOptions
from padgs.training.worth import Worth, needed


class Choice:
    """When it is due, and how many it leaves.

    Attributes:
        due: its iteration.
        made: whether it has been; None: not known yet, of a checkpoint that does not say.
    """

    def __init__(
        self, growth: CloneSplitOptions, iterations: int, *, asked: int | str | None, removal_psnr: float | None
    ) -> None:
        """Of a run of so many iterations.

        Args:
            growth: options of the run.
            iterations: of the run.
            asked: by the budget. A number: so many stay; auto, or None where nothing is asked: as many as
                `padgs.training.worth.needed` says.
            removal_psnr: dB, for that. None: all stay, and there is no choice.
        """
        self._iterations, self._asked, self._removal_psnr = iterations, asked, removal_psnr
        self.due = growth.densify_until - 1 + growth.densify_every
        self.made: bool | None = False

    def lies_ahead(self, iteration: int) -> bool:
        """Whether there is a choice, and it comes later."""
        return self._removal_psnr is not None and iteration < self.due

    def is_due(self, iteration: int) -> bool:
        """Whether it is time to choose.

        What a budget asks for is met later, too: once a stop has left that out, and a number in any case at the end.
        Where none asks, all stay then, for little is to come that mends what the others leave.
        """
        if self._removal_psnr is None:
            return False
        if self._asked is None:
            return iteration == self.due
        due = min(self.due, self._iterations) if isinstance(self._asked, int) else self.due
        if self.made is None:
            self.made = iteration > due
        return iteration >= due and not self.made

    def count(self, found: Worth) -> int:
        """How many stay of those that were scored."""
        if isinstance(self._asked, int):
            return min(self._asked, len(found.change))
        assert self._removal_psnr is not None, "asked where there is a choice only"
        return needed(found, self._removal_psnr)
