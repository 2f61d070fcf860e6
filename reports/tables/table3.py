"""Table 3: what each part of PaD-GS contributes, on any scene; the paper's numbers beside ours where it has them."""

from __future__ import annotations

from collections.abc import Sequence

from padgs.results import Result
from reports import published
from reports.conditions import refuse_mixture
from reports.metrics import PAPER_METRICS, PROTOCOL_METRICS, column
from reports.published import Key
from reports.request import Request
from reports.settings import chosen
from reports.tables.cells import difference, measured, of_the_paper, one_setting
from reports.tables.footnotes import conditions
from reports.tables.ranking import NOTE
from reports.tables.table import Block, Cell, Column, ReportError, Row, Table

ROWS = {  # variant (conf/ablation) -> title
    "baseline": "Baseline",
    "dagd": "+ DAGD",
    "dagd_daom_no_m": "+ DAGD + DAOM, w/o M",
    "full": "+ DAGD + DAOM + M",
}
PAPER_SCENES = (("roam360", "bar"), ("ricoh360", "cat_tower"))


def build(results: Sequence[Result], request: Request) -> Table:
    """Four rows for each scene that was run, and for the two of the paper.

    Raises:
        ReportError: results that must not stand together, or a protocol that no column is known for.
    """
    if request.protocol not in PROTOCOL_METRICS:
        raise ReportError(f"unknown protocol {request.protocol!r}; known: {', '.join(PROTOCOL_METRICS)}")
    rows = [result for result in chosen(results, "table3", request) if result.variant in ROWS]
    scenes = dict.fromkeys((*PAPER_SCENES, *((result.dataset, result.scene) for result in rows)))
    paper = published.load() if request.protocol == published.PROTOCOL else {}
    blocks, blocks_of = [], {}
    for dataset, scene in scenes:
        title = published.scene_title(dataset, scene)
        own = [result for result in rows if (result.dataset, result.scene) == (dataset, scene)]
        refuse_mixture(own, request, title)
        lines = [_row(variant, own, paper, request.protocol, dataset, scene, title) for variant in ROWS]
        blocks.append(Block(title, tuple(lines)))
        blocks_of[title] = own
    notes = [*conditions(blocks_of, request.protocol), NOTE]
    if request.protocol == published.PROTOCOL:
        notes.append("Columns 'paper': published numbers, from another machine; Δ = ours - paper.")
    title = "Ablation of PaD-GS: distortion-aware decoding (DAGD), opacity modulation (DAOM), solid-angle weight (M)"
    return Table("table3", title, "Variant", _columns(request.protocol), tuple(blocks), tuple(notes))


def _columns(protocol: str) -> tuple[Column, ...]:
    columns: list[Column] = []
    for name in PAPER_METRICS:
        ours = column(PROTOCOL_METRICS[protocol][name], group=name.upper())
        columns.append(ours)
        if protocol == published.PROTOCOL:
            columns.append(Column("paper", ours.decimals, ours.higher_is_better, group=ours.group, optional=True))
            columns.append(Column("Δ", ours.decimals, signed=True, group=ours.group, optional=True))
    return tuple(columns)


def _row(variant: str, results: Sequence[Result], paper, protocol: str, dataset: str, scene: str, where: str) -> Row:
    runs = [result for result in results if result.variant == variant]
    runs = one_setting(runs, f"{where}, {ROWS[variant]}")
    cells: list[Cell] = []
    for name in PAPER_METRICS:
        ours = measured(runs, protocol, PROTOCOL_METRICS[protocol][name])
        cells.append(ours)
        if protocol == published.PROTOCOL:
            theirs_key = Key(3, published.DATASETS.get(dataset, dataset), scene, f"padgs/{variant}", name)
            theirs = of_the_paper(paper.get(theirs_key))
            cells += [theirs, difference(ours, theirs)]
    return Row(ROWS[variant], tuple(cells))
