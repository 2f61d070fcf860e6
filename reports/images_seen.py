"""How much of the training images a run has looked at: iterations of one method see far more than those of another."""

from __future__ import annotations

import math

from padgs.results import Result


def images_seen(result: Result) -> float | None:
    """Training pixels looked at, again and again included, as a number of whole panoramas; None where unknown.

    An iteration sees a panorama, a perspective view cut from one (of the resolution at its horizon), or single rays.
    """
    options = result.config.get("method", {})
    if result.method == "egonerf":
        share = options["rays"] / (result.width * result.height) if "rays" in options else None
    elif result.method == "cubemap_3dgs":
        share = _of_a_view(90.0)
    elif result.method == "crops_3dgs":
        share = _of_a_view(options["field_of_view"]) if "field_of_view" in options else None
    else:
        share = 1.0
    return None if share is None else share * result.iterations_done


def _of_a_view(degrees: float) -> float:
    """The pixels of a square view of f = W / 2 pi, beside those of the panorama, W x W / 2."""
    return 2 * (math.tan(math.radians(degrees / 2)) / math.pi) ** 2
