"""Robustness of methods under stress (`+experiment=stress`): tables `stability` and `limits`, and a heat map.

The robustness under a condition is (Q - Q1) / (Q0 - Q1_0) within [0, 1]. Q is WS-PSNR of the protocol `stability`, Q1
that of one colour for the whole image, and Q0 and Q1_0 are those of the same run without the condition. A failed run
has 0.
"""

import ast
import math
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.resources import files
from typing import Any

import pandas as pd
from pandas import DataFrame

from padgs.files import file_name
from padgs.reports import methods
from padgs.reports.charts.drawing import Chart, figure, lay_out, styled
from padgs.reports.conditions import footnotes, refuse_mixture
from padgs.reports.frame import CONFIG, by_conditions, grouped
from padgs.reports.selection import RunSet, one_setting, refuse_differences
from padgs.reports.significance import failures, mean_cell
from padgs.reports.table import Block, Cell, Column, Row, Table

CONDITION, LEVEL = f"{CONFIG}stress.condition", f"{CONFIG}stress.level"
PROTOCOL = "stability"
QUALITY, ONE_COLOR = f"{PROTOCOL}/ws_psnr", f"{PROTOCOL}/ws_psnr_one_color"
EQUATOR, POLE = f"{PROTOCOL}/ws_psnr_equator", f"{PROTOCOL}/ws_psnr_pole"
SHARED = ("resolution", "learning_rates", "data", "machine", f"{PROTOCOL} rules")
SCORES = ("stability_score", "worst_quartile", "failure_rate")  # of a `StressedMethod`
NOT_SCORED = {"textureless"}  # shown but not scored, because the scene becomes easier
HALF = 0.5  # a condition breaks a method below this robustness
LIMITS_ARE_FOR = ("256x128", 1500)  # resolution, and iterations without stress
BEYOND = "beyond"
UNITS = {"seam": "seam", "depth_error": "depth error", "ws_psnr_fitted": "dB after a fit of colours", "ws_psnr": "dB"}
STATUS_LETTERS = {"oom": "M", "timeout": "T", "nan": "N", "diverged": "V", "collapsed": "C"}
STATUS_LETTERS |= {"exploded": "E", "degenerate": "D", "rejected": "R"}
COLORS = "cividis"  # dark where nothing is left; readable for colour-blind readers
LIGHT, DARK = "#fafafa", "#101010"  # numbers on dark and on bright cells
SHOWN_LEVEL = 2  # of stress, in the heat map; 1 is mild, 3 is severe
WIDTH, HEIGHT, BORDER = 0.8, 0.34, (1.8, 1.9)  # inches of a cell, and beside and above all cells
NARROWEST, WIDEST = 5.2, 13.5  # inches of a heat map; 1500 pixels at most
UNSTRESSED = {  # title -> column of the frame, and columns that are subtracted from it
    "WS-PSNR, dB": (QUALITY,),
    "training views above test views, dB": (f"{PROTOCOL}/ws_psnr_training", QUALITY),
    "equator above poles, dB": (EQUATOR, POLE),
    "the same, above a truth blurred alike, dB": (EQUATOR, POLE, f"{PROTOCOL}/pole_gap_oracle"),
    "seam": (f"{PROTOCOL}/seam",),
    "yaw error": (f"{PROTOCOL}/yaw_error",),
    "depth error (AbsRel)": (f"{PROTOCOL}/depth_error",),
    "floaters": (f"{PROTOCOL}/floaters",),
}
STABILITY_NOTES = (
    "Robustness: how far above one colour for the image a run stays under a condition, as a share of the same "
    "method and seed without it (the mean of other seeds where that has no such run), within [0, 1]; 0 for a run that "
    "failed. Level 1 is mild, 3 is severe.",
    f"A method breaks at the first level where it keeps less than {HALF:g} or a run fails; – where it does not.",
    "Score: the mean over conditions of the mean over their levels. Worst quartile: that of the worst quarter of the "
    "conditions; columns stand in its order on the first scene, the best first. Both, and the failure rate, are over "
    f"all conditions but {', '.join(sorted(NOT_SCORED))}, and missing for a method that was not run under all "
    "conditions of the scene.",
)
LIMITS_NOTES = (
    "dB: WS-PSNR without the condition less that with it, of the same seed (the mean of other seeds where that has no "
    "such run); after a fit of colours: each view with the gain and the offset of each channel that bring it nearest "
    "to the truth. Other rows: the metric itself.",
    "BEYOND: more than a method that is meant to be robust may lose; – in the first column: no limit.",
)

Stress = tuple[str, int]  # condition, level


def _limits() -> dict[str, dict[str, Any]]:
    """Return the keywords of each `@condition` in data/perturb, read from the source, because importing takes long."""
    sources = [file.read_text("utf-8") for file in files("padgs").joinpath("data/perturb").iterdir() if file.is_file()]
    functions = [node for text in sources for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)]
    calls = ((of.name, call) for of in functions for call in of.decorator_list if isinstance(call, ast.Call))
    return {name: {one.arg: ast.literal_eval(one.value) for one in call.keywords if one.arg} for name, call in calls}


LIMITS = _limits()


@dataclass(frozen=True)
class StressedMethod:
    """A method on a scene, with and without stress."""

    preset: str
    runs: Mapping[Stress, DataFrame]  # a run a seed
    reference: DataFrame  # runs without stress
    missing: Set[Stress] = frozenset()  # stress that other methods of the scene were run under, and this was not

    @cached_property
    def robustness(self) -> dict[Stress, Cell]:
        """Robustness under each condition and level, with the status of failed runs."""
        above, found = (self.reference[QUALITY] - self.reference[ONE_COLOR]).set_axis(self.reference["seed"]), {}
        for stress, runs in self.runs.items():
            without = runs["seed"].map(above).fillna(above.mean())  # without a reference the mean of the other seeds
            shares = ((runs[QUALITY] - runs[ONE_COLOR]) / without).clip(0, 1).where(runs["ok"], 0.0)
            found[stress] = mean_cell(shares[without > 0].tolist(), failures(runs))  # else there is nothing to keep
        return found

    def levels(self, condition: str) -> dict[int, Cell]:
        """Return level -> robustness under a condition."""
        return {level: cell for (name, level), cell in sorted(self.robustness.items()) if name == condition}

    def breakdown(self, condition: str) -> int | None:
        """Return the first level below `HALF` or with a failed run; None if there is none."""
        kept = ((n, HALF if cell.value is None else cell.value) for n, cell in self.levels(condition).items())
        return next((n for n, value in kept if value < HALF or self.levels(condition)[n].status), None)

    @property
    def means(self) -> list[float]:
        """Mean robustness over the levels of each condition, the worst first; empty if any stress is missing."""
        conditions = {condition for condition, _ in self._scored}
        cells = ([one for one in self.levels(of).values() if one.value is not None or one.status] for of in conditions)
        return sorted(math.fsum(cell.value or 0.0 for cell in of) / len(of) for of in cells if of)

    @property
    def stability_score(self) -> float | None:
        """Mean over the conditions."""
        return mean_cell(self.means).value

    @property
    def worst_quartile(self) -> float | None:
        """Mean over the worst quarter of the conditions, at least one."""
        return mean_cell(self.means[: max(1, len(self.means) // 4)]).value

    @property
    def failure_rate(self) -> float | None:
        """Share of failed runs under scored conditions; None if any stress is missing."""
        return float(1 - pd.concat([runs["ok"] for runs in self._scored.values()]).mean()) if self._scored else None

    @property
    def _scored(self) -> dict[Stress, DataFrame]:
        return {} if self.missing else {of: runs for of, runs in self.runs.items() if of[0] not in NOT_SCORED}


def stressed_methods(run_set: RunSet) -> dict[str, list[StressedMethod]]:
    """Return title of a scene -> methods run with and without stress, by worst quartile, incomplete ones last."""
    runs, found = run_set.of_experiments("stress"), {}
    if not {CONDITION, QUALITY, ONE_COLOR} <= {*runs}:
        return found
    stress = zip(runs[CONDITION], runs[LEVEL], strict=True)
    names = ["" if condition is None else f"{condition} {level}" for condition, level in stress]
    runs = runs.loc[runs["variant"] == names]  # other variants were stopped by hand, or are rows of an ablation
    for title, own in by_conditions(runs, "resolution").items():
        refuse_mixture(own, run_set.request, title, SHARED)
        made = [one for preset in methods.ordered(own["preset"]) if (one := _stressed_method(own, preset, title))]
        gone = own[CONDITION].notna() & ~own["preset"].isin([one.preset for one in made])
        for preset in own.loc[gone, "preset"].unique():
            run_set.warnings.append(f"{title}: {methods.title(preset)} is left out, for it has no run without stress")
        if made:
            every = {stress for one in made for stress in one.runs if stress[0] not in NOT_SCORED}
            made = [replace(one, missing=every - one.runs.keys()) for one in made]
            found[title] = sorted(made, key=lambda one: math.inf if one.missing else -(one.worst_quartile or 0.0))
    return found


def all_stress(stressed: Sequence[StressedMethod]) -> list[Stress]:
    """Return the conditions and levels of some methods, each once, the levels of a condition together."""
    conditions = [condition for one in stressed for condition, _ in one.runs]
    return sorted({stress for one in stressed for stress in one.runs}, key=lambda s: (conditions.index(s[0]), s[1]))


def stability(run_set: RunSet) -> list[Table | Chart]:
    """Return a table with three blocks for each scene, and a heat map for each."""
    found = stressed_methods(run_set)
    presets = list(dict.fromkeys(one.preset for those in found.values() for one in those))
    blocks = []
    for title, those in found.items():
        row = partial(_row, presets, those)
        scores = [row(of.replace("_", " "), lambda one, of=of: Cell(getattr(one, of), count=0)) for of in SCORES]
        rows = [row(f"unstressed: {of}", partial(_unstressed, columns)) for of, columns in UNSTRESSED.items()]
        known = [made for made in rows if any(cell.value is not None for cell in made.cells)]
        kept = [row(f"{of[0]} {of[1]}", lambda one, of=of: one.robustness.get(of, Cell())) for of in all_stress(those)]
        conditions = dict.fromkeys(condition for condition, _ in all_stress(those))
        breaks = [row(of, lambda one, of=of: Cell(status=str(one.breakdown(of) or ""))) for of in conditions]
        blocks += [Block(title, (*scores, *known)), Block(f"Robustness, {title}", tuple(kept))]
        blocks.append(Block(f"Breaks at level, {title}", tuple(breaks)))
    columns = tuple(Column(methods.title(preset), 2) for preset in presets)
    notes = (*_footnotes(run_set, found), *STABILITY_NOTES)
    table = Table("stability", "Robustness of methods under stress", "Condition", columns, tuple(blocks), notes)
    return [table, *(heat_map(*one) for one in found.items())]


def limits(run_set: RunSet) -> Table:
    """Return what methods lose under stress beside what is allowed, for scenes of the limits' size and length."""
    found = {}
    for title, those in stressed_methods(run_set).items():
        kinds = [{*zip(one.reference["resolution"], one.reference["iterations"], strict=True)} for one in those]
        if limited := [one for one, of in zip(those, kinds, strict=True) if of == {LIMITS_ARE_FOR}]:
            found[title] = limited
    presets = list(dict.fromkeys(one.preset for those in found.values() for one in those))
    blocks = []
    for title, those in found.items():
        row, rows = partial(_row, presets, those), []
        for condition, level in all_stress(those):
            limit = LIMITS.get(condition, {})
            metric, levels = limit.get("metric", "ws_psnr"), limit.get("allowed", ())
            allowed = levels[level - 1] if level <= len(levels) else None
            words = f"{condition} {level}, {UNITS[metric]}"
            lost = row(words, partial(_lost, (condition, level), metric, allowed))
            rows.append(Row(words, (Cell(allowed, count=0), *lost.cells)))
        blocks.append(Block(title, tuple(rows)))
    columns = (Column("allowed", 2), *(Column(methods.title(preset), 2) for preset in presets))
    notes = (*_footnotes(run_set, found), *LIMITS_NOTES)
    return Table("limits", "Losses of methods under stress, and their limits", "Condition", columns, (*blocks,), notes)


@styled()
def heat_map(title: str, stressed: Sequence[StressedMethod]) -> Chart:
    """Return a row per condition at `SHOWN_LEVEL` and a column per method that was run under all of them.

    Robustness is shown as colour, failures as letters. Without a run at that level, the mildest one is shown; if no
    method is complete, all are.
    """
    import matplotlib

    levels = {level for _, level in all_stress(stressed)}
    level = SHOWN_LEVEL if SHOWN_LEVEL in levels else min(levels)
    stresses = [stress for stress in all_stress(stressed) if stress[1] == level]
    complete = [one for one in stressed if not {*stresses} & one.missing]
    shown = complete or [one for one in stressed if {*stresses} & one.runs.keys()]
    width = min(WIDTH, (WIDEST - BORDER[0]) / len(shown))
    made, axes = figure(1, 1, max(BORDER[0] + width * len(shown), NARROWEST), BORDER[1] + HEIGHT * len(stresses))
    panel, statuses = axes[0, 0], set[str]()
    for row, stress in enumerate(stresses):
        for column, one in enumerate(shown):
            if (cell := one.robustness.get(stress)) is not None:
                value = cell.value or 0.0
                statuses |= {*cell.status.split()}
                color, corners = matplotlib.colormaps[COLORS](value), ([column + 0.03, column + 0.97], row + 0.04)
                panel.fill_between(*corners, row + 0.96, color=color, linewidth=0)
                letters = "".join(STATUS_LETTERS[status] for status in cell.status.split())
                look = {"color": DARK if value > 0.55 else LIGHT, "fontweight": "bold" if letters else "normal"}
                text = letters or f"{value:.2f}".lstrip("0")
                panel.text(column + 0.5, row + 0.5, text, ha="center", va="center_baseline", fontsize=10, **look)
    titles = [methods.short(methods.title(one.preset), one.preset) for one in shown]
    panel.set(xlim=(0, len(shown)), ylim=(len(stresses), 0))
    panel.set_xticks([n + 0.5 for n in range(len(shown))], titles, rotation=40, ha="left")
    panel.xaxis.tick_top()
    panel.set_yticks([n + 0.5 for n in range(len(stresses))], [name for name, _ in stresses])
    panel.tick_params(length=0)
    panel.grid(False)
    panel.spines[:].set_visible(False)
    known = [f"{letter} {status}" for status, letter in STATUS_LETTERS.items() if status in statuses]
    panel.set_xlabel("; ".join(["1: keeps everything, 0: one colour", *([", ".join(known)] if known else [])]))
    lay_out(made, f"What methods keep under stress of level {level}\n{title}")
    notes = ["Each cell: the distance to one colour, as a share of the method's own without stress."]
    if left_out := [methods.title(one.preset) for one in stressed if one not in shown]:
        notes.append(f"Not run under all conditions, and so left out: {', '.join(left_out)}.")
    first = stressed[0].reference.iloc[0]
    return Chart(file_name(f"stability-{first['place'].stem}-{first['resolution']}"), title, made, tuple(notes))


def _row(presets: Sequence[str], stressed: Sequence[StressedMethod], title: str, cell: Callable[..., Cell]) -> Row:
    cells = {one.preset: cell(one) for one in stressed}
    return Row(title, tuple(cells.get(preset, Cell()) for preset in presets))


def _footnotes(run_set: RunSet, found: Mapping[str, Sequence[StressedMethod]]) -> list[str]:
    rows = {title: sorted(i for one in those for i in one.reference.index) for title, those in found.items()}
    return footnotes({f"{title}, without stress": run_set.runs.loc[own] for title, own in rows.items()}, PROTOCOL)


def _stressed_method(runs: DataFrame, preset: str, where: str) -> StressedMethod | None:
    own, where = runs.loc[runs["preset"] == preset], f"{where}, {methods.title(preset)}"
    refuse_differences(own.drop(columns=[CONDITION, LEVEL]), where)
    reference, stressed = own.loc[own[CONDITION].isna() & own["ok"]], own.loc[own[CONDITION].notna()]
    groups = grouped(stressed, CONDITION, LEVEL)
    cells = {(name, int(level)): one_setting(own, f"{where}, {name} {level}") for (name, level), own in groups}
    return StressedMethod(preset, cells, one_setting(reference, where)) if cells and len(reference) else None


def _unstressed(columns: Sequence[str], one: StressedMethod) -> Cell:
    name, *others = columns
    if not {*columns} <= {*one.reference}:
        return Cell()
    return mean_cell((one.reference[name] - one.reference[others].sum(axis=1, skipna=False)).dropna().tolist())


def _lost(stress: Stress, metric: str, allowed: float | None, one: StressedMethod) -> Cell:
    """Return the mean over seeds, with the status of failed runs, and `BEYOND` if it is more than allowed."""
    runs, column = one.runs.get(stress), f"{PROTOCOL}/{metric}"
    if runs is None:
        return Cell()
    if column not in runs or column not in one.reference:
        return Cell(status=failures(runs))
    ok, reference = runs.loc[runs["ok"]], one.reference.set_index("seed")[column]
    values = ok[column].astype(float)
    if "psnr" in metric:  # others are errors, and no loss
        values = ok["seed"].map(reference).fillna(reference.mean()).astype(float) - values
    cell = mean_cell(values.dropna().tolist(), failures(runs))
    over = allowed is not None and cell.value is not None and cell.value > allowed
    return replace(cell, status=" ".join(filter(None, (cell.status, BEYOND if over else ""))))
