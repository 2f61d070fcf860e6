"""`padgs report`: read result files, make a table, write it down."""

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


def report(
    table: Annotated[str, typer.Argument(help="table3 or another table; `padgs report list` names all")],
    runs: Annotated[str, typer.Option(help="folder of run folders")] = "runs",
    out: Annotated[str, typer.Option(help="where the files go; RUNS/tables if not given")] = "",
    protocol: Annotated[str, typer.Option(help="which scores: paper or sphere")] = "paper",
    where: Annotated[list[str] | None, typer.Option(help="only runs with KEY=VALUE; repeatable")] = None,
    mix: Annotated[bool, typer.Option(help="let other rules, sizes and run lengths stand together")] = False,
    strict: Annotated[bool, typer.Option(help="exit code 1 if a result file cannot be used")] = False,
) -> None:
    """Make a table from result files, as Markdown and LaTeX, and show it."""
    if table == "list":
        print("\n".join(TABLES))
        return
    folder = Path(runs)
    if not folder.is_dir():
        raise _refused(f"there is no folder {folder}; name the folder of the runs with --runs")
    found, broken = results.read_all(folder)
    for error in broken:
        print(f"left out: {error}", file=sys.stderr)
    try:
        request = Request(protocol, mix, dict(_pair(setting) for setting in where or []))
        made: Table = lookup(TABLES, table, "table")(found, request)
    except ValueError as error:
        raise _refused(str(error)) from error
    target = Path(out) if out else folder / "tables"
    texts = {extension: lookup(WRITERS, extension, "format")(made) for extension in WRITERS}
    try:
        target.mkdir(parents=True, exist_ok=True)
        for extension, text in texts.items():
            results.replace_file(target / f"{made.name}.{extension}", text.encode())
    except OSError as error:
        raise _refused(f"cannot write to {target}: {error.strerror}; name another folder with --out") from error
    print(texts["md"])
    print(f"{len(found)} results; written: {', '.join(f'{target / made.name}.{e}' for e in texts)}", file=sys.stderr)
    if strict and broken:
        raise typer.Exit(1)


def _pair(setting: str) -> tuple[str, str]:
    key, equals, value = setting.partition("=")
    if not equals:
        raise ReportError(f"--where {setting} is not KEY=VALUE, e.g. --where train.iterations=3000")
    return key, value


def _refused(message: str) -> typer.Exit:
    print(f"error: {message}", file=sys.stderr)
    return typer.Exit(1)
