"""How many Gaussians each method needs of a scene, and what the need costs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from padgs.reports.conditions import OF_TIMES, footnotes, refuse_mixture
from padgs.reports.frame import by_conditions
from padgs.reports.gathered import Gathered
from padgs.reports.needs import EPSILONS, STATED, Curve, by_method, curves, gain, ratio, searched
from padgs.reports.tables.cells import spread
from padgs.reports.tables.table import Block, Cell, Column, Row, Table

COLUMNS: dict[Column, Callable[[Curve, Curve], float | None]] = {
    Column("Gaussians blended", 0): lambda own, _: own.found["steps"][0]["blended"],
    **{
        Column(f"needed for {epsilon} dB", 0, False): lambda own, _, e=epsilon: own.needs[e]["blended"]
        for epsilon in EPSILONS
    },
    Column(f"share for {STATED} dB", 2): lambda own, _: own.needs[STATED]["rows"] / own.found["rows"],
    Column("knee", 0): lambda own, _: None if own.knee is None else own.knee["blended"],
    Column(f"MB for {STATED} dB", 2, False): lambda own, _: own.needs[STATED]["bytes"] / 1e6,
    Column(f"degree for {STATED} dB", 0, False): lambda own, _: own.degree,
    Column(f"MB of its file, {STATED} dB", 2, False): lambda own, _: (
        None if own.file is None else own.file["bytes"] / 1e6
    ),
    Column(f"least ms of a frame for {STATED} dB", 1, False): lambda own, _: own.needs[STATED]["frame_ms"],
    Column(f"WS-PSNR for {STATED} dB", 2, True): lambda own, _: own.quality_of(own.needs[STATED]),
    Column("WS-PSNR of all", 2, True): lambda own, _: own.quality_of(own.found["steps"][0]),
    Column("dB at equal N against the first", 2, signed=True): gain,
    Column("N at equal dB over the first's", 2): ratio,
    Column("CPU s of the search", 0): lambda own, _: own.found["cpu_seconds"],
}
NOTES = (
    "Needed: the smallest model as good as one that was refined as often and lost nothing, on views taken from the "
    "training: WS-PSNR by at most so many dB with 95 % confidence, each latitude band by twice and each view by five "
    "times that, LPIPS by 0.005. WS-PSNR: of the test views, which decide nothing, less what was lost there against a "
    "model refined as often. Not searched: offsets an anchor, features.",
    "Degree and file: of the model for that need, with as few harmonics and as small a file as lose no more against it "
    "with all of them and in full; the file was written, read back and measured.",
    "Knee: the largest model below which a halving costs more than 0.1 dB. Beside the first: means over what both "
    "curves share.",
)


def _over_seeds(seeds: Sequence[Curve], first: Sequence[Curve], of: Callable[[Curve, Curve], float | None]) -> Cell:
    """A number of the runs of a method, each beside that of the first method with its seed, if there is one."""
    beside = {one.seed: one for one in first}
    values = [of(one, beside.get(one.seed, first[0])) for one in seeds]
    return spread([value for value in values if value is not None])


def need(gathered: Gathered) -> Table:
    """A block for each scene, resolution and length, a row for each method whose runs `padgs need` searched.

    Raises:
        ReportError: results that must not stand together.
    """
    blocks, runs_of = [], {}
    for title, own in by_conditions(searched(gathered), "resolution", "length").items():
        refuse_mixture(own, gathered.request, title, OF_TIMES)
        found = by_method(curves(own))
        first = next(iter(found.values()))
        rows = (
            Row(method, tuple(_over_seeds(seeds, first, of) for of in COLUMNS.values()))
            for method, seeds in found.items()
        )
        blocks.append(Block(title, tuple(rows)))
        runs_of[title] = own
    notes = (*footnotes(runs_of, gathered.request.protocol), *NOTES) if blocks else ()
    return Table("need", "How many Gaussians a scene needs", "Method", tuple(COLUMNS), tuple(blocks), notes)
