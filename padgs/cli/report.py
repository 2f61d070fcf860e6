"""`padgs report`: read result files, make tables, write them down."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from padgs import results
from padgs.registry import lookup
from reports import TABLES, WRITERS
from reports.request import Request
from reports.table import ReportError, Table

ALL = "all"


def report(
    what: Annotated[str, typer.Argument(help=f"{', '.join(TABLES)}, or {ALL}")],
    runs: Annotated[str, typer.Argument(help="folder of run folders")] = "runs",
    out: Annotated[str, typer.Option(help="where the files go; RUNS/reports if not given")] = "",
    protocol: Annotated[str, typer.Option(help="which scores: paper or sphere")] = "paper",
    experiment: Annotated[str, typer.Option(help="only runs of this experiment or sweep, e.g. tau@cpu")] = "",
    where: Annotated[list[str] | None, typer.Option(help="only runs with KEY=VALUE; repeatable")] = None,
    mix: Annotated[bool, typer.Option(help="let other rules, sizes, run lengths and machines stand together")] = False,
    strict: Annotated[bool, typer.Option(help="exit code 1 if a result file cannot be used")] = False,
) -> None:
    """Make tables from result files, as Markdown, LaTeX and CSV."""
    folder = Path(runs)
    if not folder.is_dir():
        raise _refused(f"there is no folder {folder}; give the folder of the runs after the name of the table")
    found, broken = results.read_all(folder)
    for error in broken:
        print(f"left out: {error}", file=sys.stderr)
    try:
        request = Request(protocol, mix, experiment, dict(_pair(setting) for setting in where or []))
        wanted = {name: lookup(TABLES, name, "report") for name in (TABLES if what == ALL else [what])}
    except ValueError as error:
        raise _refused(f"{error}, {ALL}") from error
    refused = False
    for build in wanted.values():
        try:
            made: Table = build(found, request)
        except ReportError as error:
            refused = True
            print(f"error: {error}", file=sys.stderr)
            continue
        text = _write(made, Path(out) if out else folder / "reports")
        if what != ALL:
            print(text)
    print(f"{len(found)} results, {len(broken)} left out", file=sys.stderr)
    if refused or (strict and broken):
        raise typer.Exit(1)


def _write(table: Table, folder: Path) -> str:
    """The table in all formats; returns the Markdown."""
    texts = {extension: lookup(WRITERS, extension, "format")(table) for extension in WRITERS}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for extension, text in texts.items():
            results.replace_file(folder / f"{table.name}.{extension}", text.encode())
    except OSError as error:
        raise _refused(f"cannot write to {folder}: {error.strerror}; name another folder with --out") from error
    print(f"written: {', '.join(f'{folder / table.name}.{extension}' for extension in texts)}", file=sys.stderr)
    return texts["md"]


def _pair(setting: str) -> tuple[str, str]:
    key, equals, value = setting.partition("=")
    if not equals:
        raise ReportError(f"--where {setting} is not KEY=VALUE, e.g. --where train.iterations=3000")
    return key, value


def _refused(message: str) -> typer.Exit:
    print(f"error: {message}", file=sys.stderr)
    return typer.Exit(1)
