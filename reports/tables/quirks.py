"""What each quirk of a released program costs or gains beside the method as it is described (conf/quirk)."""

from __future__ import annotations

from collections.abc import Sequence

from padgs.results import Result
from reports.conditions import OF_TIMES, refuse_mixture
from reports.measures import QUANTITIES, marks
from reports.methods import title
from reports.metrics import PAPER_METRICS
from reports.request import Request
from reports.scenes import at, places
from reports.settings import chosen
from reports.tables.cells import difference, one_setting, over_seeds
from reports.tables.footnotes import conditions
from reports.tables.ranking import NOTE
from reports.tables.table import Block, Column, Row, Table

QUIRKS = {  # method -> variant (conf/quirk) without its name -> title
    "op43dgs": {"extents": "extents", "low_pass": "low-pass", "pruning": "pruning"},
    "odgs": {"colors": "colours without direction", "margin": "extent + 100", "bias": "half a pixel off"},
    "omnigs": {"start": "early start", "reset": "empty resets", "bounds": "squares, no seam", "near": "near 0.2"},
    "padgs": {
        "distortion": "distortion by world z",
        "distance": "distance in world units",
        "offsets": "offset rate in world units",
        "scale_cap": "limit on scales",
        "loss": "weights and three-fold loss",
        "bounds": "squares, no seam",
    },
}
COSTS = ("gaussians", "megabytes", "train_seconds", "frame_ms")


def build(results: Sequence[Result], request: Request) -> Table:
    """A block for each scene and method; rows: as described, with each quirk alone, as released; and the change.

    Raises:
        ReportError: results that must not stand together, or an unknown protocol.
    """
    measures = (*marks(request.protocol), *(QUANTITIES[name] for name in COSTS))
    psnr = PAPER_METRICS.index("psnr")
    found = [result for result in chosen(results, "quirks", request) if result.variant in _variants()]
    blocks, runs_of = [], {}
    for place in places(found):
        own = at(place, found)
        refuse_mixture(own, request, place.title, OF_TIMES)
        for method, quirks in QUIRKS.items():
            titles = {method: "as described", **{f"{method}_{name}": text for name, text in quirks.items()}}
            rows: list[Row] = []
            for variant, text in {**titles, f"{method}_all": "as released"}.items():
                runs = one_setting([r for r in own if r.variant == variant], f"{place.title}, {variant}")
                cells = [over_seeds(runs, measure.number) for measure in measures]
                described = rows[0].cells[psnr] if rows else cells[psnr]
                cells.insert(psnr + 1, difference(cells[psnr], described))
                rows.append(Row(text, tuple(cells)))
            if any(cell.value is not None or cell.status for row in rows for cell in row.cells):
                blocks.append(Block(f"{title(method)}, {place.title}", tuple(rows)))
        runs_of[place.title] = own
    columns = [measure.column for measure in measures]
    columns.insert(psnr + 1, Column("Δ", 2, signed=True))
    notes = (*conditions(runs_of, request.protocol), "Δ: PSNR beside the method as described.", NOTE)
    return Table(
        "quirks", "Quirks of released programs, one at a time", "Setting", tuple(columns), tuple(blocks), notes
    )


def _variants() -> set[str]:
    return {f"{method}_{name}".removesuffix("_") for method, quirks in QUIRKS.items() for name in ("", *quirks, "all")}
