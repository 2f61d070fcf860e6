"""How much of the training images a run has looked at: iterations of one method see far more than those of another."""

from __future__ import annotations

from padgs.results import Result


def images_seen(result: Result) -> float | None:
    """Training pixels looked at, again and again included, as a number of whole panoramas; None where unknown.

    An iteration sees a panorama, as many views cut from panoramas as show as much, or single rays.
    """
    options = result.config.get("method", {})
    if result.method == "egonerf":
        share = options["rays"] / (result.width * result.height) if "rays" in options else None
    else:
        share = 1.0
    return None if share is None else share * result.iterations_done
