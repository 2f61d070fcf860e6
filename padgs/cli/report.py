"""`padgs report`: read finished runs, make tables, charts and the page, write them down."""

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from padgs.cli.errors import name_place, show
from padgs.files import write_atomically
from padgs.reports import REPORTS, store
from padgs.reports.table import ReportError
from padgs.results import FILE_NAME, STOP_REQUESTED

ALL = "all"


def report(
    what: Annotated[str, typer.Argument(help=f"{', '.join(REPORTS)}, or {ALL}")],
    runs: Annotated[str, typer.Argument(help="folder of run folders, or a results.jsonl")] = "runs",
    out: Annotated[str, typer.Option(help="folder of the files; default: reports in or beside RUNS")] = "",
    protocol: Annotated[str, typer.Option(help="rules of scoring: paper or sphere")] = "paper",
    experiment: Annotated[str, typer.Option(help="only runs of this experiment or sweep, e.g. tau@cpu")] = "",
    metric: Annotated[list[str] | None, typer.Option(help="only these of the protocol, e.g. psnr; repeatable")] = None,
    method: Annotated[list[str] | None, typer.Option(help="only these methods, e.g. odgs,padgs*; repeatable")] = None,
    scene: Annotated[list[str] | None, typer.Option(help="only these scenes or data sets, as a,b; repeatable")] = None,
    where: Annotated[list[str] | None, typer.Option(help="only runs with KEY=VALUE; repeatable")] = None,
    mix: Annotated[bool, typer.Option(help="compare runs of different rules, sizes, lengths and machines")] = False,
    collect: Annotated[bool, typer.Option(help="add the runs to OUT/results.jsonl first, report on all in it")] = False,
    svg: Annotated[bool, typer.Option(help="write charts as SVG, too")] = False,
    strict: Annotated[bool, typer.Option(help="exit code 1 for unusable files or runs that do not compare")] = False,
) -> None:
    """Make tables (Markdown, LaTeX, CSV), charts (PNG, CSV) and a page (HTML) from result files."""
    if what not in (*REPORTS, ALL):
        raise ReportError(f"unknown report {what!r}; known: {', '.join(sorted(REPORTS))}, {ALL}")
    source = Path(runs)
    if not (source.is_dir() or source.is_file()):  # nor a device, which may have no end
        raise ReportError(f"there is no folder {source}; give the folder of the runs after the name of the report")
    target = Path(out) if out else (source if source.is_dir() else source.parent) / "reports"
    from padgs.reports.frame import frame
    from padgs.reports.selection import Request, RunSet, names_of
    from padgs.reports.writers import files  # imports pandas, so not at the top

    names = {"metrics": names_of(metric), "methods": names_of(method), "scenes": names_of(scene)}
    request = Request(protocol, mix, strict, experiment=experiment, where=_pairs(where), **names)
    found, broken = store.read(source)
    if collect:
        with name_place(target, "--out"):
            target.mkdir(parents=True, exist_ok=True)
            found = store.add(found, target / store.FILE_NAME)  # only runs in `source` have pictures
    for error in broken:
        show(f"left out: {error}", sys.stderr)
    if not found:
        single_run = (source / FILE_NAME).is_file()
        hint = f"{source} is one run: give {source.resolve().parent}" if single_run else "give a folder of run folders"
        raise ReportError(f"no result that can be used is in {source}; {hint}")
    run_set = RunSet(frame(found), request, tuple(map(str, broken)))
    if early := [run.result.run for run in found if run.result.ended == STOP_REQUESTED]:
        run_set.warnings.append(f"stopped by request, and only in the table `runs`: {', '.join(early)}")
    refused = 0
    single = what != ALL
    for name in [what] if single else REPORTS:
        try:
            texts = dict(files(run_set.report(name), svg))
        except ReportError as error:
            refused += 1
            show(f"{'error' if single or strict else 'left out'}: {name}: {error}", sys.stderr)
            if single:
                raise typer.Exit(1) from error
            texts = {}
        if what == name and not texts:
            raise ReportError(f"nothing to show for {name}; no run or experiment in {source} is of that kind")
        # Of tables only: the user may have a chart.csv or gallery.md.
        is_table = not REPORTS[name].function.endswith(("charts", ":html"))
        with name_place(target, "--out"):
            for ending in ("md", "tex", "csv") if is_table and f"{name}.md" not in texts else ():
                (target / f"{name}.{ending}").unlink(missing_ok=True)  # an old table must not lie beside new ones
            for file, content in texts.items():
                target.mkdir(parents=True, exist_ok=True)
                write_atomically(target / file, content)
        if what == name and f"{name}.md" in texts:
            show(texts[f"{name}.md"].decode())
    without = f", and {refused} reports without a table" if refused else ""
    show(f"{len(found)} results, {len(broken)} left out{without}; see {target}", sys.stderr)
    command = shlex.join(["padgs", "report", "html", runs, *(["--out", out] if out else [])])
    opened = f"open {target / 'report.html'} in a browser"
    show(f"next: {opened if what in ('html', ALL) else command}", sys.stderr)
    for warning in dict.fromkeys(run_set.warnings):
        show(f"warning: {warning}", sys.stderr)
    if (refused and (single or strict)) or (strict and broken):
        raise typer.Exit(1)


def _pairs(settings: list[str] | None) -> dict[str, str]:
    pairs = {}
    for setting in settings or ():
        key, equals, value = setting.partition("=")
        if not equals:
            raise ReportError(f"--where {setting} is not KEY=VALUE, e.g. --where train.iterations=3000")
        if pairs.setdefault(key, value) != value:
            raise ReportError(f"--where {key} is {pairs[key]} and {value}; give one value of each key")
    return pairs
