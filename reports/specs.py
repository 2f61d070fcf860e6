"""Tables as data: which runs, rows, blocks, columns and notes each has. `padgs.reports.build` makes them.

A new table is an entry of `SPECS` and one of `REPORTS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from pandas import DataFrame

from padgs.reports import methods
from padgs.reports.conditions import CONDITIONS, OF_PARTS, OF_TIMES
from padgs.reports.frame import CONFIG
from padgs.reports.measures import Measure, costs, metric, metrics
from padgs.reports.selection import is_number
from padgs.reports.significance import NOTE, SEEDS

Measures = tuple[Measure, ...]


@dataclass(frozen=True)
class Spec:
    """A table of `build.table`. Its experiments are in `padgs.reports.REPORTS`."""

    title: str
    measures: Callable[[str], Measures]  # protocol of the request -> one a column
    corner: str = "Method"
    # Runs
    fallback: bool = False  # without runs of its experiments, show ad hoc runs, see `RunSet.chosen`
    prepare: Callable[[DataFrame], DataFrame] = lambda runs: runs  # filter, or add columns
    outdoor: bool | None = None  # only outdoor scenes, or only indoor ones
    # Blocks: one a scene, and ...
    blocks: tuple[str, ...] = ()  # ... a value of these columns
    by_experiment: bool = False  # ... an experiment
    conditions: tuple[str, ...] = OF_TIMES  # shared by all runs of a block
    # Rows
    rows: str = "preset"  # column whose values are rows; "setting": see `selection.settings`; "run": all runs
    titles: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  # method -> value -> title; {}: all presets
    difference: str = ""  # note on a column with the difference of each PSNR from the first row's
    by_rank: bool = False  # sort by the first measure, and add a column of ranks
    equal_images: bool | None = None  # leave out of the ranking: see `conditions.unranked`; None: nothing
    # Columns of the paper, and notes
    paper: Mapping[str, int] = field(default_factory=dict)  # data set -> table of the paper
    averages: bool = False  # a block with the mean over each data set of `paper`, and over all other scenes
    scenes_down: bool = False  # the data sets of `paper` have a block for each measure, with methods across
    pivot: tuple[str, ...] = ()  # columns of the frame whose values are columns of the first measure
    protocols: tuple[str, ...] = ()  # of the footnotes; empty: that of the request
    notes: tuple[str, ...] = (NOTE,)


def _variants(table: str, chosen: Callable[[str], bool] = lambda name: True) -> dict[str, str]:
    """Return variant -> title of a table in conf/variants."""
    folder = Path(__file__).resolve().parent.parent / "conf" / "variants"  # beside reports, installed or not
    rows = yaml.safe_load((folder / f"{table}.yaml").read_text("utf-8"))
    return {name: row["title"] for name, row in rows.items() if chosen(name)}


def _is_rung(variant: str) -> bool:
    return variant[0] == "a" and variant[1].isdigit()


INDOOR, OUTDOOR = {"roam360": 1}, {"ricoh360": 2}
ABLATED = {"roam360": 3, "ricoh360": 3}
EFFICIENCY = {"roam360": 4, "ricoh360": 4}
BUDGET, TAU = f"{CONFIG}budget.gaussians", f"{CONFIG}method.tau"
RATES = f"{CONFIG}train.learning_rates"
PARTS = _variants("ablation", lambda name: not _is_rung(name))
RUNGS = _variants("ablation", _is_rung)
WITHOUT = _variants("plus_ablation")
DEVIATIONS = {  # method -> variant -> title
    method: _variants("deviation", lambda name, method=method: methods.method_of(name) == method)
    for method in methods.ordered(map(methods.method_of, _variants("deviation")))
}
VOXELS = {"padgs_small": "one anchor per 3 px", "padgs": "one anchor per 0.1 px"}  # ours for the paper's 0.001
CROSSED = {f"{preset} {tau}": f"{title}, τ = {tau:g}" for preset, title in VOXELS.items() for tau in (0.0, 0.9)}
BANDS = ("equator", "middle", "high", "pole")
WS_PSNR = (metric("sphere", "ws_psnr"),)
PAPER = tuple(metric("paper", name, "paper") for name in ("psnr", "ssim", "lpips_vgg_01"))
SPHERE = tuple(metric("sphere", name, "sphere") for name in ("psnr", "ws_psnr", "ws_psnr_pole"))
EVERYTHING = (
    *PAPER,
    *(metric("sphere", name, "sphere") for name in ("ws_psnr", *(f"ws_psnr_{band}" for band in BANDS), "seam")),
    *costs("iterations_done", "images", "train_seconds", "wall_seconds", "frame_ms", "start", "gaussians"),
    *costs("megabytes", title="MB"),
    *costs("peak_gigabytes", "peak_gpu_gigabytes"),
)
_NO_BEST = {"higher_is_better": None}
_NO_BEST_COST = {"group": "cost", **_NO_BEST}
OF_A_RUN = (
    *(metric("paper", name, "paper", **_NO_BEST) for name in ("psnr", "ssim", "lpips_vgg_01")),
    *(
        metric("sphere", name, "sphere", **_NO_BEST)
        for name in ("ws_psnr", "ws_ssim", "ws_lpips_alex", *(f"ws_psnr_{band}" for band in BANDS))
    ),
    *costs("anchors", "gaussians", **_NO_BEST_COST),
    *costs("megabytes", title="MB", **_NO_BEST_COST),
    *costs("train_seconds", "frame_ms", "peak_gigabytes", "peak_gpu_gigabytes", **_NO_BEST_COST),
)


def _with_costs(protocol: str) -> Measures:
    return (*metrics(protocol), *costs("gaussians", "megabytes", "train_seconds", "frame_ms"))


def _with_budget(runs: DataFrame) -> DataFrame:
    """Keep runs with a number of Gaussians, not auto or null, the fewest first."""
    if runs.empty:
        return runs
    runs = runs.loc[runs[BUDGET].map(lambda count: is_number(count) and count > 0)].sort_values(BUDGET, kind="stable")
    return runs.assign(budget=[f"at most {count:,} Gaussians".replace(",", " ") for count in runs[BUDGET]])


def _with_rates(runs: DataFrame) -> DataFrame:
    """Keep runs with published rates or those for the run; other factors are for `learning_rates`."""
    rates = runs[RATES].fillna("published") if RATES in runs else "published"
    runs = runs.assign(rates=rates)
    return runs.loc[runs["rates"].isin(["published", "run"])]


def _crossed(runs: DataFrame) -> DataFrame:
    taus = runs[TAU] if TAU in runs else [None] * len(runs)
    return runs.assign(crossed=[f"{preset} {tau}" for preset, tau in zip(runs["preset"], taus, strict=True)])


SPECS: Mapping[str, Spec] = {
    "table1": Spec(
        "Quality on indoor scenes",
        metrics,
        fallback=True,
        outdoor=False,
        conditions=CONDITIONS,
        equal_images=True,
        paper=INDOOR,
        averages=True,
        scenes_down=True,
    ),
    "table2": Spec(
        "Quality on outdoor scenes",
        metrics,
        fallback=True,
        outdoor=True,
        conditions=CONDITIONS,
        equal_images=True,
        paper=OUTDOOR,
        averages=True,
        scenes_down=True,
    ),
    "table3": Spec(
        "Ablation of PaD-GS: distortion-aware decoding (DAGD), opacity modulation (DAOM), solid-angle weight (M)",
        metrics,
        "Variant",
        fallback=True,
        conditions=CONDITIONS,
        rows="variant",
        titles={"padgs": PARTS},
        paper=ABLATED,
    ),
    "table4": Spec(
        "Efficiency",
        lambda _: costs(
            *("train_hours", "fps", "frame_ms", "gaussians", "megabytes", "peak_gigabytes", "peak_gpu_gigabytes")
        ),
        fallback=True,
        equal_images=True,
        paper=EFFICIENCY,
        averages=True,
        notes=(
            NOTE,
            "Training time and time per frame (median of repeats, decoding included): CPU time of all threads of the "
            "process, on a GPU wall time. Memory: peak of the process while training "
            "and of the tensors on the GPU.",
        ),
    ),
    "methods": Spec(
        "Every method after the same number of iterations",
        lambda _: EVERYTHING,
        fallback=True,
        averages=True,
        equal_images=True,
        protocols=("paper", "sphere"),
    ),
    "equal_time": Spec(
        "Every method after the same training time",
        lambda _: EVERYTHING,
        blocks=("resolution", "length"),
        equal_images=False,
        protocols=("paper", "sphere"),
    ),
    "ladder": Spec(
        "From panoramic 3DGS to PaD-GS", _with_costs, "Rung", fallback=True, rows="variant", titles={"padgs": RUNGS}
    ),
    "deviations": Spec(
        "Deviations of released programs, one at a time",
        _with_costs,
        "Setting",
        fallback=True,
        rows="variant",
        titles=DEVIATIONS,
        difference="Δ: PSNR beside the method as described.",
    ),
    "plus_ablation": Spec(
        "padgs+ without each of its parts",
        _with_costs,
        "Setting",
        fallback=True,
        conditions=OF_PARTS,
        rows="variant",
        titles={"padgs_plus": WITHOUT},
        difference="Δ: PSNR beside the complete method.",
    ),
    "order": Spec(
        "Methods in the order of their quality",
        lambda _: (
            *WS_PSNR,
            metric("paper", "psnr"),
            metric("paper", "lpips_vgg_01"),
            *costs("start", "gaussians", "cpu_seconds", "frame_ms"),
        ),
        by_experiment=True,
        blocks=("resolution", "length"),
        rows="setting",
        by_rank=True,
        protocols=("paper", "sphere"),
        notes=(
            f"Rank: 1 + the number of rows in better places by WS-PSNR, where all rows have {SEEDS} seeds; rows "
            "that tie share one.",
            NOTE,
        ),
    ),
    "length": Spec(
        "WS-PSNR after training of different length",
        lambda _: WS_PSNR,
        prepare=_with_rates,
        blocks=("resolution",),
        conditions=("protocol", "data"),
        pivot=("rates", "iterations"),
        protocols=("sphere",),
    ),
    "learning_rates": Spec(
        "WS-PSNR for factors on all learning rates",
        lambda _: WS_PSNR,
        "Factor",
        prepare=lambda runs: runs.loc[runs["iterations"] > 0],  # a run of seconds may fail before its first
        blocks=("resolution",),
        conditions=("protocol", "data"),
        pivot=("iterations",),
        protocols=("sphere",),
    ),
    "modulation": Spec(
        "Voxel size and opacity modulation of PaD-GS",
        lambda _: (
            *SPHERE,
            metric("paper", "psnr", "paper", title="PSNR by the paper's protocol"),  # its runs have protocol=roam360
            *costs("polar_transmittance", "start", "gaussians", "cpu_seconds"),
        ),
        "Setting",
        prepare=_crossed,
        blocks=("resolution", "length"),
        rows="crossed",
        titles={"padgs": CROSSED},
        protocols=("paper", "sphere"),
    ),
    "capacity": Spec(
        "Methods with equal numbers of Gaussians",
        lambda _: (
            *SPHERE,
            metric("sphere", "ws_lpips_alex", "sphere"),
            *costs("gaussians", "cpu_seconds", "frame_ms"),
        ),
        prepare=_with_budget,
        blocks=("resolution", "length", "budget"),
        protocols=("sphere",),
        notes=(
            "At most: when training ends. padgs+ grows to twice as many and keeps the most important; the others never "
            "have more.",
            NOTE,
        ),
    ),
    "runs": Spec(
        "Runs",
        lambda _: OF_A_RUN,
        "Run",
        blocks=("resolution", "length"),
        conditions=(),
        rows="run",
        protocols=("paper", "sphere"),
        notes=(),
    ),
}
