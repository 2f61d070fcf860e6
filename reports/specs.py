"""Tables as data (`tables.yaml`): runs, rows, blocks, columns and notes of each. `padgs.reports.build` makes them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml
from pandas import DataFrame

from padgs.reports import TABLES, conditions, methods
from padgs.reports.frame import CONFIG
from padgs.reports.measures import COSTS, Measure, metric, metrics
from padgs.reports.selection import is_number


@dataclass(frozen=True)
class Spec:
    """A table of `build.table`."""

    title: str
    columns: Mapping[str, Sequence[str]]  # heading -> costs and PROTOCOL/METRIC; "protocol": SSIM, PSNR, LPIPS of that
    corner: str = "Method"
    renamed: Mapping[str, str] = field(default_factory=dict)  # name of a column -> title
    best: bool = True  # whether columns have a best number
    # Runs
    experiments: Sequence[str] = ()
    fallback: bool = False  # without runs of its experiments, show ad hoc runs, see `RunSet.chosen`
    prepare: str = ""  # function of `PREPARE` that filters, or adds columns
    outdoor: bool | None = None  # only outdoor scenes, or only indoor ones
    # Blocks: one a scene, and ...
    blocks: Sequence[str] = ()  # ... a value of these columns
    by_experiment: bool = False  # ... an experiment
    conditions: str | Sequence[str] = "OF_TIMES"  # shared by all runs of a block; or their name in `conditions`
    # Rows
    rows: str = "preset"  # column whose values are rows; "setting": see `selection.settings`; "run": all runs
    titles: str = ""  # key of `TITLES`; empty: all presets
    difference: str = ""  # note on a column with the difference of each PSNR from the first row's
    by_rank: bool = False  # sort by the first measure, and add a column of ranks
    unranked: bool = False  # leave presets out of the ranking: see `conditions.unranked`
    # Columns of the paper, and notes
    paper: Mapping[str, int] = field(default_factory=dict)  # data set -> table of the paper
    averages: bool = False  # blocks with the means over each data set of `paper`, and over all other scenes
    scenes_down: bool = False  # the data sets of `paper` have a block for each measure, with methods across
    pivot: Sequence[str] = ()  # columns of the frame whose values are columns of the first measure
    protocols: Sequence[str] = ()  # of the footnotes; empty: that of the request
    notes: Sequence[str] = ()

    @property
    def shared(self) -> Sequence[str]:
        """Conditions that all runs of a block share."""
        return getattr(conditions, self.conditions) if isinstance(self.conditions, str) else self.conditions

    def measures(self, protocol: str) -> list[Measure]:
        """Return a measure for each column, for the protocol of the request."""
        found = []
        for group, names in self.columns.items():
            known = (metric(*name.split("/")) if "/" in name else COSTS[name] for name in names)
            for one in metrics(protocol) if group == "protocol" else known:
                changes: dict[str, Any] = {} if group == "protocol" else {"group": group}
                changes |= {} if self.best else {"higher_is_better": None}
                changes |= {"title": self.renamed[one.name]} if one.name in self.renamed else {}
                found.append(replace(one, column=replace(one.column, **changes)))
        return found


def _variants(table: str) -> dict[str, str]:
    """Return variant -> title of a table in conf/variants."""
    folder = Path(__file__).resolve().parent.parent / "conf" / "variants"  # beside reports, installed or not
    rows = yaml.safe_load((folder / f"{table}.yaml").read_text("utf-8"))
    return {name: row["title"] for name, row in rows.items()}


BUDGET, TAU, RATES = (CONFIG + key for key in ("budget.gaussians", "method.tau", "train.learning_rates"))
ABLATION, WITHOUT, DEVIATION = map(_variants, ("ablation", "plus_ablation", "deviation"))
RUNGS = {name: title for name, title in ABLATION.items() if name[0] == "a" and name[1].isdigit()}
PARTS = {name: title for name, title in ABLATION.items() if name not in RUNGS}
DEVIATIONS = {  # method -> variant -> title
    method: {name: title for name, title in DEVIATION.items() if methods.method_of(name) == method}
    for method in methods.ordered(map(methods.method_of, DEVIATION))
}
VOXELS = {"padgs_small": "one anchor per 3 px", "padgs": "one anchor per 0.1 px"}  # ours for the paper's 0.001
CROSSED = {f"{preset} {tau}": f"{title}, τ = {tau:g}" for preset, title in VOXELS.items() for tau in (0.0, 0.9)}


def _with_budget(runs: DataFrame) -> DataFrame:
    """Keep runs with a number of Gaussians, not auto or null, the fewest first."""
    if runs.empty:
        return runs
    return runs.loc[runs[BUDGET].map(lambda count: is_number(count) and count > 0)].sort_values(BUDGET, kind="stable")


def _with_rates(runs: DataFrame) -> DataFrame:
    """Keep runs with published rates or those for the run; other factors are for `learning_rates`."""
    runs = runs.assign(rates=runs[RATES].fillna("published") if RATES in runs else "published")
    return runs.loc[runs["rates"].isin(["published", "run"])]


def _crossed(runs: DataFrame) -> DataFrame:
    taus = runs[TAU] if TAU in runs else [None] * len(runs)
    return runs.assign(crossed=[f"{preset} {tau}" for preset, tau in zip(runs["preset"], taus, strict=True)])


PREPARE: Mapping[str, Callable[[DataFrame], DataFrame]] = {
    "": lambda runs: runs,
    "with_budget": _with_budget,
    "with_rates": _with_rates,
    "crossed": _crossed,
    "begun": lambda runs: runs.loc[runs["iterations"] > 0],  # a run of seconds may fail before its first
}
TITLES: Mapping[str, Mapping[str, Mapping[str, str]]] = {  # method -> value -> title
    "": {},
    "parts": {"padgs": PARTS},
    "rungs": {"padgs": RUNGS},
    "without": {"padgs_plus": WITHOUT},
    "deviations": DEVIATIONS,
    "crossed": {"padgs": CROSSED},
}
SPECS: Mapping[str, Spec] = {name: Spec(**fields) for name, fields in TABLES.items()}
