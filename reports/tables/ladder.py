"""From panoramic 3DGS to PaD-GS, one change a rung (conf/experiment/ladder.yaml), and what each rung costs."""

from __future__ import annotations

from collections.abc import Sequence

from padgs.results import Result
from reports.conditions import OF_TIMES, refuse_mixture
from reports.measures import QUANTITIES, marks
from reports.request import Request
from reports.scenes import at, places
from reports.settings import chosen
from reports.tables.cells import one_setting, over_seeds
from reports.tables.footnotes import conditions
from reports.tables.ranking import NOTE
from reports.tables.table import Block, Row, Table

RUNGS = {  # variant (conf/ablation) -> title
    "a0_pano_3dgs": "A0 panoramic 3DGS",
    "a1_anchors": "A1 + anchors and networks",
    "a2_distance": "A2 + distance",
    "a3_distortion": "A3 + distortion degree (DAGD)",
    "a4_modulation": "A4 + opacity modulation (DAOM)",
    "a5_weight": "A5 + solid-angle weight (M)",
    "a6_triple_loss": "A6 + loss three times as large",
}
COSTS = ("gaussians", "megabytes", "train_seconds", "frame_ms")


def build(results: Sequence[Result], request: Request) -> Table:
    """A block for each scene, a row for each rung.

    Raises:
        ReportError: results that must not stand together, or an unknown protocol.
    """
    measures = (*marks(request.protocol), *(QUANTITIES[name] for name in COSTS))
    rungs = [result for result in chosen(results, "ladder", request) if result.variant in RUNGS]
    found = {place: at(place, rungs) for place in places(rungs)}
    blocks = []
    for place, own in found.items():
        refuse_mixture(own, request, place.title, OF_TIMES)
        rows = []
        for variant, title in RUNGS.items():
            runs = one_setting([result for result in own if result.variant == variant], f"{place.title}, {title}")
            rows.append(Row(title, tuple(over_seeds(runs, measure.number) for measure in measures)))
        blocks.append(Block(place.title, tuple(rows)))
    notes = conditions({place.title: own for place, own in found.items()}, request.protocol)
    columns = tuple(measure.column for measure in measures)
    return Table("ladder", "From panoramic 3DGS to PaD-GS", "Rung", columns, tuple(blocks), (*notes, NOTE))
