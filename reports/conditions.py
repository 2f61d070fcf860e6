"""Conditions under which numbers were made: shared within a block, named below a table, and decisive for ranking."""

from collections.abc import Iterable, Iterator, Mapping

import pandas as pd
from pandas import DataFrame

from padgs.files import file_name
from padgs.reports.frame import CONFIG, PUBLISHED_ITERATIONS, by_conditions, grouped
from padgs.reports.measures import PROTOCOL_METRICS
from padgs.reports.methods import name, title
from padgs.reports.selection import Mixture, Request
from padgs.reports.table import UNRANKED

# Columns of the frame; "protocol" means the rules of all protocols, since tables show numbers of several.
OF_A_DATA_SET = ("protocol", "resolution", "length", "learning_rates")  # scenes may differ, rules may not
CONDITIONS = (*OF_A_DATA_SET, "data")
OF_TIMES = (*CONDITIONS, "machine")
RULES = tuple(f"{protocol} rules" for protocol in PROTOCOL_METRICS)
OF_PARTS = tuple(what for what in OF_TIMES if what != "learning_rates")  # an ablation may change the rates
OF_A_SWEEP = ("protocol", "machine")  # all else shows as a changed key
OF_A_POINT = ("data",)  # the folder of the data is no part of a setting
OF_A_CHART = ("protocol", "resolution", "learning_rates", "data", "machine")
OF_A_MEAN = (*OF_A_DATA_SET, "machine")  # of one setting over the scenes of a data set
PUBLISHED_LENGTHS = {"egonerf": 100_000}  # iterations; other methods have 30 000
PUBLISHED_WIDTH = 1920  # pixels; the narrowest panoramas of the paper
PUBLISHED_PIXELS = {  # preset -> constant in pixels that means something else in narrower panoramas
    "op43dgs_release": "has a low-pass of 0.12 square pixels at a width of 2048, and of 0.0076 at 512",
    "odgs_release": "draws half a pixel off, which is 0.09 degrees at a width of 2048, and 0.35 at 512",
}
LEAST_SHARE = 0.5  # of the images that another method of the block has seen, for a method to be ranked
CALIBRATES = {  # method -> keys of data.generator for the errors that it corrects; in photographs they are unknown
    "sc_omnigs": ("pose_noise_translation", "pose_noise_rotation"),
    "seam360gs": ("lens_gap", "lens_k1"),
}
FEWER_IMAGES = "for it saw less than half as many training pixels as another method of its table"
NOTHING_TO_CORRECT = (
    "for it follows an abstract, and the errors that it corrects (noise of the training poses; two lenses apart) are "
    "not known here; +experiment=calibration compares it where they are"
)


def refuse_mixture(runs: DataFrame, request: Request, where: str, conditions: Iterable[str] = CONDITIONS) -> None:
    """Raise Mixture if runs of one block differ in a condition, unless the request allows it."""
    shared = (of for what in conditions for of in (RULES if what == "protocol" else (what,)))
    for what in () if request.mix else shared:
        values = _values(runs, what).drop_duplicates()
        if len(values) > 1:
            named = zip(values, runs["run"][values.index], strict=True)
            difference = f"{where}: results differ in {what} ({'; '.join(f'{value} in {run}' for value, run in named)})"
            raise Mixture(difference, "choose with --where, or compare them anyway with --mix", runs, [what])


def sheets(runs: DataFrame, request: Request, kind: str, shared: Iterable[str]) -> Iterator[tuple[str, str, DataFrame]]:
    """Yield file name, title and runs of each scene, resolution and length; `shared`: see `refuse_mixture`."""
    for where, own in by_conditions(runs, "resolution", "length").items():
        refuse_mixture(own, request, where, shared)
        first = own.iloc[0]
        yield file_name(f"{kind}_{first['place'].stem}_{first['resolution']}_{first['length']}"), where, own


def as_published(runs: DataFrame) -> bool:
    """Return whether runs have the size, length and rows of the paper, without which numbers cannot be compared."""
    kinds = {*zip(runs["method"], runs["resolution"], runs["length"], strict=True)}
    is_long = all(length == f"{PUBLISHED_LENGTHS.get(of, PUBLISHED_ITERATIONS)} iterations" for of, _, length in kinds)
    wide = all(int(size.partition("x")[0]) >= PUBLISHED_WIDTH for _, size, _ in kinds)
    rules = _values(runs, "paper rules").astype(str)
    cropped = rules.str.contains("without the last 6.3", regex=False)  # the robot of 360Roam
    return bool(kinds) and is_long and wide and cropped.eq(runs["dataset"][rules.index] == "roam360").all()


def footnotes(blocks: Mapping[str, DataFrame], *protocols: str) -> list[str]:
    """Return a sentence with the conditions of the runs, for all blocks that share them."""
    titles: dict[str, list[str]] = {}
    for block, runs in blocks.items():
        titles.setdefault(_sentence(runs, protocols), []).append(block)
    notes = [f"{'; '.join(of)}: {sentence}" for sentence, of in titles.items()]
    for block, runs in blocks.items():
        same = grouped(runs, "preset", "variant", "setting")
        if mixed := sorted({title(of[0]) for of, own in same if own["code_version"].nunique() > 1}):
            notes.append(f"{block}: seeds of {', '.join(mixed)} are of several versions of padgs.")
    made = {(of, by) for own in blocks.values() for of, by in zip(own["preset"], own["external"], strict=True) if by}
    notes += [f"{title(of)}: made by {by}, and only scored by padgs." for of, by in sorted(made)]
    for method, length in PUBLISHED_LENGTHS.items():
        if any(((runs["method"] == method) & (runs["iterations"] < length)).any() for runs in blocks.values()):
            notes.append(f"{name(method)} is published with {length} iterations.")
    for preset, constant in PUBLISHED_PIXELS.items():
        sizes = (size for runs in blocks.values() for size in runs["resolution"][runs["preset"] == preset])
        if any(int(size.partition("x")[0]) < PUBLISHED_WIDTH for size in sizes):
            notes.append(f"{title(preset)} {constant}.")
    return notes


def _sentence(runs: DataFrame, protocols: Iterable[str]) -> str:
    if runs.empty:
        return "not run."
    columns = [_values(runs, f"{protocol} rules") for protocol in protocols]
    columns += [runs[what].dropna() for what in (*OF_A_DATA_SET[1:], "code_version", "hardware")]
    columns.append(runs["seed"].sort_values())
    words = (" / ".join(map(str, values.unique())) or "none" for values in columns)
    *rules, sizes, lengths, rates, versions, machines, seeds = words
    tested = " / ".join(runs["cameras"].dropna().unique())
    views = f" test views: {tested}," if tested else ""  # all others are panoramas
    made = f"{sizes},{views} {lengths}, learning rates {rates}, seeds {seeds}, padgs {versions}, {machines}."
    return f"protocol {'; '.join(rules)}, {made}"


def _values(runs: DataFrame, what: str) -> pd.Series:
    """Return a condition of each run that has it; a run without scores under a protocol contradicts no rule."""
    return runs[what].dropna() if what in runs else pd.Series(dtype=object)


def unranked(runs: DataFrame) -> dict[str, tuple[str, str]]:
    """Return preset -> (reason, numbers) of those not to be ranked; after equal time no number of images is too few."""
    found: dict[str, tuple[str, str]] = {}
    timed = runs.reindex(columns=[f"{CONFIG}budget.seconds"]).notna().any(axis=None)
    seen = runs.loc[runs["ok"]].groupby("preset")["images"].mean()
    for preset, images in seen[seen < LEAST_SHARE * seen.max()].items() if not timed else ():
        found[str(preset)] = FEWER_IMAGES, f"{images:.0f} of {seen.max():.0f} images"
    for method, keys in CALIBRATES.items():
        if (own := runs.loc[runs["method"] == method]).empty:
            continue
        errors = own.reindex(columns=[f"{CONFIG}data.generator.{key}" for key in keys]).fillna(0).astype(bool)
        corrected = errors.any(axis=1) & (own["dataset"] == "synthetic")  # other data ignore the generator's keys
        found |= dict.fromkeys(own.loc[~corrected, "preset"], (NOTHING_TO_CORRECT, ""))
    return found


def unranked_notes(blocks: Iterable[Mapping[str, tuple[str, str]]]) -> list[str]:
    """Return a sentence for each reason, with the titles of all presets concerned."""
    concerned: dict[str, dict[str, dict[str, None]]] = {}
    for preset, (why, numbers) in (pair for block in blocks for pair in block.items()):
        concerned.setdefault(why, {}).setdefault(title(preset), {})[numbers] = None
    found = []
    for why, titles in sorted(concerned.items()):
        named = [f"{name} ({', '.join(numbers)})" if any(numbers) else name for name, numbers in titles.items()]
        found.append(f"{UNRANKED} Not ranked: {'; '.join(named)}: {why}.")
    return found
