"""`padgs report`: read result files, make a table, write it down."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from padgs import results
from padgs.registry import lookup
from reports import TABLES, WRITERS
from reports.request import Request
from reports.table import ReportError


def write_report(
    table: str, runs: str, out: str, protocol: str, where: Sequence[str], *, mix: bool, strict: bool
) -> int:
    """Write a table in all formats and print the Markdown; returns the exit code."""
    if table == "list":
        print("\n".join(TABLES))
        return 0
    folder = Path(runs)
    if not folder.is_dir():
        return _refuse(f"there is no folder {folder}; name the folder of the runs with --runs")
    found, broken = results.read_all(folder)
    for error in broken:
        print(f"left out: {error}", file=sys.stderr)
    try:
        request = Request(protocol, mix, dict(_pair(setting) for setting in where))
        made = lookup(TABLES, table, "table")(found, request)
    except ValueError as error:
        return _refuse(str(error))
    target = Path(out) if out else folder / "tables"
    try:
        target.mkdir(parents=True, exist_ok=True)
        for extension in WRITERS:
            text = lookup(WRITERS, extension, "format")(made)
            results.replace_file(target / f"{made.name}.{extension}", text.encode())
            if extension == "md":
                print(text)
    except OSError as error:
        return _refuse(f"cannot write to {target}: {error.strerror}; name another folder with --out")
    print(f"{len(found)} results; written: {', '.join(f'{target / made.name}.{e}' for e in WRITERS)}", file=sys.stderr)
    return 1 if strict and broken else 0


def _pair(setting: str) -> tuple[str, str]:
    key, equals, value = setting.partition("=")
    if not equals:
        raise ReportError(f"--where {setting} is not KEY=VALUE, e.g. --where train.iterations=3000")
    return key, value


def _refuse(message: str) -> int:
    print(f"error: {message}", file=sys.stderr)
    return 1
