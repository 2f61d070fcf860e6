"""How much of the training images a run has looked at: iterations of one method see far more than those of another."""

from __future__ import annotations

from padgs.results import Result

LEAST_WIDTH = 512  # pixels of views that are made smaller; as `padgs.training.views.sizes` has it, without torch


def images_seen(result: Result) -> float | None:
    """Training pixels looked at, again and again included, as a number of whole panoramas; None where unknown.

    An iteration sees a panorama, as many views cut from panoramas as show as much, or single rays. In the first part of
    a run, `method.coarse_share`, it may see smaller ones; how many iterations that part has is known only where the
    schedule counted them all.
    """
    options, share = result.config.get("method", {}), 1.0
    coarse = options.get("coarse_share", 0.0) if result.width >= 2 * LEAST_WIDTH else 0.0
    if result.method == "egonerf":
        share = options["rays"] / (result.width * result.height) if "rays" in options else None
    elif coarse:
        counted = not result.ended and "seconds" not in result.config.get("budget", {})
        share = 1 - coarse * (1 - of_small_views(result.width)) if counted else None
    return None if share is None else share * result.iterations_done


def of_small_views(width: int) -> float:
    """Mean share of the pixels of a panorama that is seen in `method.coarse_share` of a run.

    It has half the width in the second half of that time; in the first, the same begins again with half the width.

    >>> of_small_views(512), of_small_views(1024), of_small_views(2048)
    (1.0, 0.25, 0.15625)
    """
    return 1.0 if width < 2 * LEAST_WIDTH else (1 + of_small_views(width // 2)) / 8
