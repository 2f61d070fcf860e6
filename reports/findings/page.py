"""The findings as one page of Markdown."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pandas import DataFrame, Series

from padgs.reports import published
from padgs.reports.conditions import footnotes
from padgs.reports.findings.claims import CLAIMS
from padgs.reports.findings.judging import NEGLIGIBLE, Claim, Judgement, Line, Verdict, in_the_paper, judge
from padgs.reports.gathered import Gathered, of_a_table
from padgs.reports.request import experiment_of
from padgs.reports.scenes import BUILT_IN
from padgs.reports.tables.ranking import CONFIDENCE
from padgs.reports.tables.table import MISSING

INTRODUCTION = f"""# Findings

What the paper claims, and what runs say of it. The command

    padgs report findings RUNS --out docs

makes this page, for the project itself of `reports/measured/results.jsonl`: verdicts, and the numbers beside them,
follow from rules (`reports/findings`). The words are written by hand, with the few numbers in them, which are of the
project's own runs.

Every number says by how much the side that the claim favours is better than the best of the others: a difference, or
for costs a quotient (×). Behind ours stands the half-width of its {CONFIDENCE:.0%} interval: Student's t over pairs of
runs with the same seed, corrected for the number of others and of scenes (Bonferroni). The longest runs of a scene
that can be compared are shown; the spread is pooled over all scenes and lengths of a claim, as shorter runs have more
seeds. A claim *holds* where a scene is beyond its interval on the claim's side and none on the other, *does not hold*
where it is the reverse, and *depends on the scene* where both are. Where none is beyond, it is a *tie* if no interval
is wider than the paper's difference ({NEGLIGIBLE:g} dB where it names none), and *undecided* if one is.

All methods train with rates that fit the length of a run (`train.learning_rates=run`). On `bedroom` at 256x128 PaD-GS
and SPaGS gain by that after 400, 1600 and 6400 iterations; OmniGS gains after 400, and loses 0.55 dB after 6400
(`reports/measured/learning_rates.md`): claims that set PaD-GS against OmniGS, and perhaps against ODGS and OP43DGS,
lean towards PaD-GS by that much.

Of what the paper says, one thing is no comparison of runs: that OP43DGS runs out of memory outdoors. Its extents grow
with the distance, as `docs/methods.md` has it with numbers, and a test keeps.
"""


HEADINGS = "| claim | in the paper | here | verdict | why | measured by |\n| --- | --- | --- | --- | --- | --- |"


@dataclass(frozen=True)
class Page:
    """A text that is written as it is."""

    name: str  # of the file
    text: str


def findings(gathered: Gathered) -> Page:
    """Every claim with its verdict, numbers, reason and the experiments that measured it; then their commands.

    Raises:
        ReportError: results that must not stand together.
    """
    paper, rows = published.load(), []
    weighed: dict[str, set[int]] = {}  # experiment -> index of its runs that some claim rests on
    for claim in CLAIMS:
        theirs = in_the_paper(claim, paper)
        negligible = min(map(abs, theirs.values()), default=NEGLIGIBLE)
        judgement = judge(claim, gathered, negligible)
        names = _experiments(claim, judgement)
        for name in names:
            own = judgement.runs.loc[[name in of for of in judgement.runs["experiments"]]]
            weighed.setdefault(name, set()).update(own.index.to_list())
        cells = (
            f"{claim.text} ({claim.place}; {claim.measure.column.title})",
            "<br>".join(f"{where}: {_number(claim, value)}" for where, value in theirs.items()) or MISSING,
            "<br>".join(_line(claim, line) for line in judgement.lines) or MISSING,
            f"**{judgement.verdict.value}**",
            _reason(claim, judgement, negligible),
            ", ".join(f"`{name}`" for name in names),
        )
        rows.append(f"| {' | '.join(cells)} |")
    commands = []
    for name in sorted(weighed):
        own = gathered.runs.loc[sorted(weighed[name])]
        conditions = footnotes({name: own}, gathered.request.protocol)[0].removeprefix(f"{name}: ")
        commands.append(f"- `{name}`: `{_command(name, own)}`; {conditions}")
    return Page("findings.md", "\n".join([INTRODUCTION, HEADINGS, *rows, "", "## Commands", "", *commands]) + "\n")


def _number(claim: Claim, value: float, half_width: float | None = None) -> str:
    if not claim.quotient:
        half = "" if half_width is None else f" ± {half_width:.{claim.measure.column.decimals}f}"
        return f"{value:+.{claim.measure.column.decimals}f}{half}"
    ends = "" if half_width is None else f" ({math.exp(value - half_width):.2f} to {math.exp(value + half_width):.2f})"
    return f"× {math.exp(value):.2f}{ends}"


def _line(claim: Claim, line: Line) -> str:
    against = "" if line.rivals == 1 and line.against in claim.text else f" over {line.against}"
    return f"{line.where}: {_number(claim, line.advantage.value or 0.0, line.half_width)}{against}"


def _reason(claim: Claim, judgement: Judgement, negligible: float) -> str:
    """Ours, where there is one for the verdict; else what the numbers themselves say."""
    if judgement.verdict in claim.reasons:
        return claim.reasons[judgement.verdict]
    if judgement.verdict is not Verdict.UNDECIDED:
        return MISSING
    if all(line.half_width is None for line in judgement.lines):
        return "Too few seeds for an interval."
    return f"Too few seeds: intervals are wider than {_number(claim, negligible).lstrip('+')}."


def _experiments(claim: Claim, judgement: Judgement) -> list[str]:
    """Those whose runs were weighed, with their scale; what to run where there are none."""
    names = {name for of in judgement.runs["experiments"] for name in of}
    return sorted(name for name in names if experiment_of(name) in claim.experiments) or [claim.experiments[0]]


def _command(name: str, runs: DataFrame) -> str:
    """What ran an experiment or sweep, as far as results tell."""
    experiment, _, scale = name.partition("@")
    table = of_a_table(name)
    words = ["padgs-run", f"{'+experiment' if table else '+sweep'}={experiment}"]
    if scale:
        words.append(f"{'scale' if table else '+scale'}={scale}")
    if len(runs):
        words.append(f"seed={','.join(map(str, sorted(runs['seed'].unique())))}")
        if runs["length"].nunique() == 1:
            words += _length(runs.iloc[0])
        captures, generated = runs.loc[runs["dataset"] == ""], runs.loc[runs["dataset"] == BUILT_IN]
        words += ["data.path=FOLDER", *_width("data.width", captures)] if len(captures) else []
        words += _width("data.generator.width", generated)
    return " ".join(words)


def _width(key: str, runs: DataFrame) -> list[str]:
    """The setting of how wide panoramas were, whatever a scale says."""
    widths = sorted({int(resolution.partition("x")[0]) for resolution in runs["resolution"]})
    return [f"{key}={','.join(map(str, widths))}"] if widths else []


def _length(run: Series) -> list[str]:
    """The settings that say how long a run was."""
    if run.get("config.budget.seconds") is None:
        return [f"train.iterations={run['iterations']}"]
    return [f"{key}={run[f'config.{key}']}" for key in ("budget.seconds", "budget.clock")]
