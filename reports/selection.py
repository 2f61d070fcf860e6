"""Runs for a report: the request, the settings among the runs, and what happens to runs that must not be mixed."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from itertools import chain
from pkgutil import resolve_name
from typing import Any

import pandas as pd
from pandas import DataFrame

from padgs.reports import REPORTS, methods
from padgs.reports.frame import CONFIG, decides, grouped
from padgs.reports.measures import metrics
from padgs.reports.published import Place
from padgs.reports.table import ReportError
from padgs.results import AD_HOC

LABELS = {"learning_rates": "learning rates ", "data": "data "}  # for columns whose values need one


class Mixture(ReportError):
    """Runs of one cell or block differ in what they should share."""

    def __init__(self, what: str, advice: str, runs: DataFrame, columns: Sequence[str], apart_in: str = "place"):
        """Keep the runs and the columns of the frame in which they differ.

        `what` is the difference and `advice` the way out, in words; `apart_in` is the column that can separate the
        runs: place for blocks of their own, preset for rows.
        """
        super().__init__(f"{what}; {advice}")
        self.what, self.runs, self.columns, self.apart_in = what, runs, list(columns), apart_in


@dataclass(frozen=True)
class Request:
    """Options of `padgs report`."""

    protocol: str = "paper"
    mix: bool = False  # allow different rules, sizes and run lengths in one block
    strict: bool = False  # refuse mixtures; otherwise they are separated
    metrics: tuple[str, ...] = ()  # of the curves of sweeps; empty: those of the protocol, and costs
    experiment: str = ""  # only runs of this experiment or sweep, with or without its scale
    where: Mapping[str, str] = field(default_factory=dict)  # dotted configuration key -> value
    methods: tuple[str, ...] = ()  # names or patterns of presets; empty: all
    scenes: tuple[str, ...] = ()  # names or patterns of scenes or data sets; empty: all

    def matches(self, name: str) -> bool:
        """Return whether an experiment of this name is requested.

        >>> Request(experiment="tau").matches("tau@cpu"), Request(experiment="tau@full").matches("tau@cpu")
        (True, False)
        """
        return self.experiment in (name, experiment_of(name))


@dataclass(frozen=True)
class RunSet:
    """Finished runs and a request. Reports are made once and kept; everything raises ReportError if refused."""

    runs: DataFrame  # see `padgs.reports.frame`
    request: Request = Request()
    left_out: Sequence[str] = ()  # reasons why result files could not be used
    warnings: list[str] = field(default_factory=list)  # of the reports made so far
    _made: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse unknown protocols, experiments and keys at once."""
        metrics(self.request.protocol)
        select(self.runs, self.request)

    @property
    def requested(self) -> DataFrame:
        """Runs that the request selects."""
        return select(self.runs, self.request)

    def report(self, name: str) -> Any:
        """Return a report; runs that must not be mixed are separated, unless the request is strict."""
        function, *arguments = REPORTS[name].function.split()
        run_set, warnings = self, dict[str, None]()
        while name not in self._made:
            try:
                self._made[name] = resolve_name(function)(run_set, *arguments)
                self.warnings.extend(warnings)
            except Mixture as mixture:
                if self.request.strict:
                    raise
                warnings[f"{name}: {mixture.what}; they are separated, and --where chooses"] = None
                run_set = replace(run_set, runs=separate(run_set.runs, mixture), _made={})
        return self._made[name]

    def chosen(self, name: str) -> DataFrame:
        """Return the runs for a report: of the requested experiment, else scene by scene of the report's own
        experiments, else ad hoc runs, else all; models of other programs always.

        A folder may hold sweeps and trials, which would otherwise compete for the cells of the table.
        """
        runs = self.requested
        if self.request.experiment:
            return runs
        own = self.of_experiments(*REPORTS[name].experiments)
        external = runs["preset"].str.startswith(methods.EXTERNAL)
        ad_hoc = runs["experiments"].map(lambda of: AD_HOC in of)
        free = runs.loc[~runs.index.isin(own.index) & ad_hoc & (external | ~runs["place"].isin(own["place"]))]
        return runs.loc[[*own.index, *free.index]] if len(own) + len(free) else runs

    def of_experiments(self, *names: str) -> DataFrame:
        """Return the runs of some experiments or sweeps, at any scale."""
        runs = self.requested
        return runs.loc[[not set(names).isdisjoint(map(experiment_of, of)) for of in runs["experiments"]]]


@dataclass(frozen=True)
class Setting:
    """Runs of a preset that differ in nothing but the seed."""

    preset: str
    variant: str
    changed: Mapping[str, Any]  # dotted key -> value, of the keys in which the settings of this preset differ
    runs: DataFrame

    @property
    def title(self) -> str:
        """Title of the preset, variant, and changed keys."""
        return ", ".join([methods.title(self.preset), *self.apart])

    @property
    def apart(self) -> list[str]:
        """Variant, if any, and changed keys."""
        return [*filter(None, [self.variant]), *self.words(self.changed)]

    def words(self, keys: Iterable[str]) -> list[str]:
        """Return the names and values of some changed keys."""
        return [f"{key.rpartition('.')[2]} {self.changed[key]}" for key in keys]


def names_of(values: Iterable[str] | None) -> tuple[str, ...]:
    """Return the names in texts that are lists; a text with ", " is also one name, as scenes may have.

    >>> names_of(["odgs,padgs*", "Flat, old"])
    ('odgs', 'padgs*', 'Flat', 'old', 'Flat, old')
    """
    parts = (part.strip() for value in values or () for part in (*value.split(","), value if ", " in value else ""))
    return tuple(dict.fromkeys(filter(None, parts)))


def _is_value(stored: Any, text: str) -> bool:
    """Return whether a text means a stored value."""
    if stored is None or stored != stored:
        return text.casefold() in ("null", "none")
    with suppress(ValueError):
        if isinstance(stored, (int, float)) and not isinstance(stored, bool):
            return float(text) == stored
    return str(stored).casefold().replace(" ", "") == text.casefold().replace(" ", "")


def select(runs: DataFrame, request: Request) -> DataFrame:
    """Return the runs that a request selects; if none has its experiment or a key, a ReportError lists the known."""
    every = runs
    if request.experiment:
        known = sorted(set(runs["experiments"].explode().dropna()))
        if not any(map(request.matches, known)):
            raise ReportError(f"unknown experiment {request.experiment!r}; known: {', '.join(known) or 'none'}")
        runs = runs.loc[[any(map(request.matches, of)) for of in runs["experiments"]]]
    where = dict(request.where)
    patterns_of = (request.methods, request.scenes, *(names_of([where.pop(name, "")]) for name in ("method", "scene")))
    chosen = zip((["preset", "method"], ["scene", "dataset"]) * 2, patterns_of, strict=True)
    for columns, patterns in chosen if len(every) else ():
        if patterns:
            own = [_is_one_of(names, patterns) for names in runs[columns].itertuples(index=False)]
            if lost := _unmatched(every[columns], patterns) or ([] if any(own) else patterns):
                known = ", ".join(sorted(every[columns[0]].unique()))
                name = columns[0].replace("preset", "method")
                raise ReportError(f"no run has {name} {', '.join(lost)}; runs have {known}")
            runs = runs.loc[own]
    for key, value in where.items() if len(every) else ():
        column = f"{CONFIG}{key}"
        if column not in every:
            first = every.iloc[0]
            keys = [name.removeprefix(CONFIG) for name in first.index[first.notna()] if name.startswith(CONFIG)]
            raise ReportError(f"unknown key {key!r}; known in run {first['run']}: {', '.join(keys)}")
        runs = runs.loc[[_is_value(stored, value) for stored in runs[column]]]
        if runs.empty:
            known = sorted({"null" if of != of or of is None else str(of) for of in every[column]})
            raise ReportError(f"no run has {key}={value}; runs have {', '.join(known)}")
    return runs


def _unmatched(names: DataFrame, patterns: Iterable[str]) -> list[str]:
    """Return the patterns that no row of names fits; a name with commas may be given whole and in its parts."""
    rows = [*names.drop_duplicates().itertuples(index=False)]
    matching = [pattern for pattern in patterns if any(_is_one_of(row, [pattern]) for row in rows)]
    return [pattern for pattern in patterns if "," not in pattern and not any(pattern in known for known in matching)]


def _is_one_of(names: Collection[str], patterns: Iterable[str]) -> bool:
    """Return whether a name fits a pattern; - and _ are alike, because `padgs-run` has scenes with _."""
    plain = [name.replace("_", "-") for name in names]
    wanted = [pattern.replace("_", "-") for pattern in patterns]
    return any(name == pattern or fnmatchcase(name, pattern) for name in plain for pattern in wanted)


def experiment_of(name: str) -> str:
    """Return the experiment without its scale.

    >>> experiment_of("tau@cpu")
    'tau'
    """
    return name.partition("@")[0]


def settings(runs: DataFrame) -> list[Setting]:
    """Return the settings among the runs of one scene, in the order of the methods and of the changed values."""
    found = []
    for preset in methods.ordered(runs["preset"]):
        own = runs.loc[runs["preset"] == preset]
        alike = (differing_keys(runs_of) for _, runs_of in grouped(own, "variant"))
        keys = [key for key in dict.fromkeys(chain.from_iterable(alike)) if key != "variant"]
        groups = grouped(own, "variant", "setting")
        made = [Setting(preset, of, {key: its[CONFIG + key].iloc[0] for key in keys}, its) for (of, _), its in groups]
        found += sorted(made, key=lambda setting: (setting.variant, [sort_key(v) for v in setting.changed.values()]))
    return found


def one_setting(runs: DataFrame, where: str, apart_in: str = "place") -> DataFrame:
    """Return the runs of one cell, sorted by seed; `apart_in`: see `Mixture`.

    Raises a Mixture if they differ in more than the seed, and a ReportError if two have the same setting and seed.
    """
    ordered = runs.sort_values("seed", kind="stable")
    refuse_differences(ordered, where, apart_in)
    if (same := ordered.loc[ordered["seed"].duplicated(keep=False), "run"]).size:
        first, second, *_ = same
        raise ReportError(f"{where}: runs {first} and {second} are the same setting; delete one of them")
    return ordered


def refuse_differences(runs: DataFrame, where: str, apart_in: str = "place") -> None:
    """Raise Mixture if runs differ in more than the seed and keys without effect; `apart_in`: see `Mixture`."""
    every = differing_keys(runs)
    for other in range(1, len(runs)) if every else ():
        two = runs.iloc[[0, other]]
        if keys := differing_keys(two):
            what = f"{where}: runs {' and '.join(two['run'])} differ in {', '.join(keys)}"
            columns = [CONFIG + key for key in every]
            raise Mixture(what, f"choose one with --where {keys[0]}=...", runs, columns, apart_in)


def differing_keys(runs: DataFrame) -> list[str]:
    """Return the dotted keys in which configurations differ, without seeds and keys without effect."""
    if runs["setting"].nunique() < 2:
        return []
    keys = [key for name in runs if name.startswith(CONFIG) and decides(key := name.removeprefix(CONFIG))]
    values = runs[[CONFIG + key for key in keys]].to_numpy()
    return [key for key, column in zip(keys, values.T, strict=True) if any(value != column[0] for value in column)]


def separate(runs: DataFrame, mixture: Mixture) -> DataFrame:
    """Return all runs, those of a mixture with their differences in the name; raise it if these have equal words."""
    own = runs.loc[mixture.runs.index]
    words = [", ".join(of) for of in zip(*(_words(column, own[column]) for column in mixture.columns), strict=True)]
    names = [_with(name, of) for name, of in zip(own[mixture.apart_in], words, strict=True)]
    if len(set(names)) == own[mixture.apart_in].nunique():
        raise mixture
    found = runs.copy()
    found.loc[own.index, mixture.apart_in] = pd.Series(names, index=own.index, dtype=object)
    return found


def sort_key(value: Any) -> tuple[bool, float, str]:
    """Return a key that sorts numbers by size, then everything else by name."""
    return (not is_number(value), float(value) if is_number(value) else 0.0, "" if is_number(value) else str(value))


def is_number(value: Any) -> bool:
    """Return whether a value has a position on an axis; True and False have none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _words(column: str, values: pd.Series) -> pd.Series:
    """Return the words for each run; a missing condition gets the most frequent words, for it contradicts none."""
    if column.startswith(CONFIG):
        return values.map(lambda value: f"{column.rpartition('.')[2]} {'not set' if value is None else value}")
    words = values.map(lambda value: f"{LABELS.get(column, '')}{value}", na_action="ignore")
    return words.fillna(words.mode().iloc[0])


def _with(name: Place | str, words: str) -> Place | str:
    if isinstance(name, Place):
        return replace(name, apart=", ".join(filter(None, (name.apart, words))))
    return f"{name}_{words}"
