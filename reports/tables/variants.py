"""Rows of a method that differ in a part: the ablation of the paper, the ladder to PaD-GS, the quirks of programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pandas import DataFrame

from padgs.reports import methods, published
from padgs.reports.conditions import OF_PARTS, OF_TIMES, footnotes, refuse_mixture
from padgs.reports.frame import by_place
from padgs.reports.gathered import Gathered
from padgs.reports.measures import PAPER_METRICS, costs, marks
from padgs.reports.scenes import Place
from padgs.reports.tables import beside_paper
from padgs.reports.tables.cells import of_each
from padgs.reports.tables.ranking import NOTE
from padgs.reports.tables.table import Block, Column, Row, Table

PARTS = {  # variant (conf/variants/ablation.yaml) -> title
    "baseline": "Baseline",
    "dagd": "+ DAGD",
    "dagd_daom_no_m": "+ DAGD + DAOM, w/o M",
    "full": "+ DAGD + DAOM + M",
}
PAPER_SCENES = (Place("roam360", "bar"), Place("ricoh360", "cat_tower"))
WITHOUT = {  # variant (conf/variants/plus_ablation.yaml) -> title
    "complete": "complete",
    **{
        f"without_{part}": title
        for part, title in {
            "rays": "tangent planes for rays",
            "filter": "twice the filter",
            "weight": "no solid-angle weight",
            "rates": "published rates",
            "speed": "means at the rate of 3DGS",
            "size": "no weight of the size",
            "smoothness": "no weight of the roughness",
            "start": "all points to begin with",
            "opacity": "initial opacity of 3DGS",
            "scale": "initial scale of 3DGS",
            "threshold": "twice the threshold",
            "limit": "no limit",
            "selection": "all that has grown",
            "average": "the last state",
            "sky": "no sky",
            "fill": "no points from photographs",
            "drop": "all in each drawing",
            "coarse": "all views of full size",
        }.items()
    },
}
RUNGS = {  # variant (conf/variants/ablation.yaml) -> title
    "a0_pano_3dgs": "A0 panoramic 3DGS",
    "a1_anchors": "A1 + anchors and networks",
    "a2_distance": "A2 + distance",
    "a3_distortion": "A3 + distortion degree (DAGD)",
    "a4_modulation": "A4 + opacity modulation (DAOM)",
    "a5_weight": "A5 + solid-angle weight (M)",
    "a6_triple_loss": "A6 + loss three times as large",
}
QUIRKS = {  # method -> variant (conf/variants/deviation.yaml) -> title
    method: {method: "as described", **{f"{method}_{name}": title for name, title in quirks.items()}}
    | {f"{method}_all": "as released"}
    for method, quirks in {
        "op43dgs": {"extents": "extents", "low_pass": "low-pass", "pruning": "pruning"},
        "odgs": {"colors": "colours without direction", "margin": "extent + 100", "bias": "half a pixel off"},
        "omnigs": {"start": "early start", "reset": "empty resets", "bounds": "squares, no seam", "near": "near 0.2"},
        "padgs": {
            "distortion": "distortion by world z",
            "distance": "distance in world units",
            "scale_cap": "limit on scales",
            "loss": "weights and three-fold loss",
            "bounds": "squares, no seam",
        },
    }.items()
}
COSTS = costs("gaussians", "megabytes", "train_seconds", "frame_ms")


def table3(gathered: Gathered) -> Table:
    """Table 3: what each part of PaD-GS contributes, on the two scenes of the paper and on any that was run.

    Raises:
        ReportError: results that must not stand together.
    """
    protocol = gathered.request.protocol
    measures, paper = marks(protocol), published.load() if protocol == published.PROTOCOL else {}
    runs = _runs(gathered, "table3", PARTS)
    blocks, runs_of = [], {}
    for place, own in {**dict.fromkeys(PAPER_SCENES, runs.iloc[:0]), **by_place(runs)}.items():
        title = place.heading
        refuse_mixture(own, gathered.request, title)
        rows = []
        for variant, ours in of_each(own, "variant", PARTS, title, measures).items():
            theirs = published.row(paper, 3, place.dataset, place.scene, f"padgs/{variant}")
            rows.append(Row(PARTS[variant], beside_paper.cells(measures, ours, theirs)))
        blocks.append(Block(title, tuple(rows)))
        runs_of[title] = own
    notes = [*footnotes(runs_of, protocol), NOTE]
    if paper:
        notes.append("Columns 'paper': published numbers, from another machine; Δ = ours - paper.")
    title = "Ablation of PaD-GS: distortion-aware decoding (DAGD), opacity modulation (DAOM), solid-angle weight (M)"
    return Table("table3", title, "Variant", beside_paper.columns(measures), tuple(blocks), tuple(notes))


def ladder(gathered: Gathered) -> Table:
    """From panoramic 3DGS to PaD-GS, one change a rung (conf/experiment/ladder.yaml), and what each rung costs.

    Raises:
        ReportError: results that must not stand together.
    """
    measures = (*marks(gathered.request.protocol), *COSTS)
    blocks, runs_of = [], {}
    for place, own in by_place(_runs(gathered, "ladder", RUNGS)).items():
        refuse_mixture(own, gathered.request, place.title, OF_TIMES)
        cells = of_each(own, "variant", RUNGS, place.title, measures)
        blocks.append(Block(place.title, tuple(Row(RUNGS[variant], tuple(row)) for variant, row in cells.items())))
        runs_of[place.title] = own
    columns = tuple(measure.column for measure in measures)
    notes = (*footnotes(runs_of, gathered.request.protocol), NOTE)
    return Table("ladder", "From panoramic 3DGS to PaD-GS", "Rung", columns, tuple(blocks), notes)


def quirks(gathered: Gathered) -> Table:
    """What each quirk of a released program costs or gains: a block for each scene and method; rows: as described, with
    each quirk alone, as released; and the change.

    Raises:
        ReportError: results that must not stand together.
    """
    title = "Quirks of released programs, one at a time"
    return _changes(gathered, "quirks", title, QUIRKS, "PSNR beside the method as described")


def plus_ablation(gathered: Gathered) -> Table:
    """What each part of padgs+ is worth: a block for each scene; rows: complete, and without each part; and the change.

    Raises:
        ReportError: results that must not stand together.
    """
    title = "padgs+ without each of its parts"
    change = "PSNR beside the complete method"
    return _changes(gathered, "plus_ablation", title, {"padgs_plus": WITHOUT}, change, OF_PARTS)


def _changes(
    gathered: Gathered,
    name: str,
    title: str,
    variants: Mapping[str, Mapping[str, str]],
    change: str,
    conditions: Sequence[str] = OF_TIMES,
) -> Table:
    """A block for each scene and method of `variants`: a row for each of its variants, beside the first."""
    measures, psnr = (*marks(gathered.request.protocol), *COSTS), PAPER_METRICS.index("psnr")
    blocks, runs_of = [], {}
    for place, own in by_place(_runs(gathered, name, *variants.values())).items():
        refuse_mixture(own, gathered.request, place.title, conditions)
        for method, titles in variants.items():
            cells = of_each(own, "variant", titles, place.title, measures)
            unchanged = cells[next(iter(titles))][psnr]
            for row in cells.values():
                row.insert(psnr + 1, beside_paper.difference(row[psnr], unchanged))
            if own["variant"].isin(titles).any():
                rows = (Row(titles[variant], tuple(row)) for variant, row in cells.items())
                blocks.append(Block(f"{methods.name(method)}, {place.title}", tuple(rows)))
        runs_of[place.title] = own
    columns = [measure.column for measure in measures]
    columns.insert(psnr + 1, Column("Δ", 2, signed=True))
    notes = (*footnotes(runs_of, gathered.request.protocol), f"Δ: {change}.", NOTE)
    return Table(name, title, "Setting", tuple(columns), tuple(blocks), notes)


def _runs(gathered: Gathered, report: str, *titles: Mapping[str, str]) -> DataFrame:
    """The runs for a report that are of these variants."""
    runs = gathered.chosen(report)
    return runs.loc[runs["variant"].isin([variant for of in titles for variant in of])]
