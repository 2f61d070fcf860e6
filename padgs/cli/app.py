"""`padgs`: everything beside running. Commands live in files of their own and are imported when they are called."""

from __future__ import annotations

from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, add_completion=False)


@app.callback()
def commands() -> None:
    """Panoramic Gaussian splatting, measured fairly."""


@app.command()
def report(
    table: str = typer.Argument(help="a table, e.g. table3, or runs; `padgs report list` names all"),
    runs: str = typer.Option("runs", help="folder of run folders"),
    out: str = typer.Option("", help="where the files go; RUNS/tables if not given"),
    protocol: str = typer.Option("paper", help="which marks: paper or sphere"),
    where: Annotated[list[str] | None, typer.Option(help="only runs with KEY=VALUE, repeatable")] = None,
    mix: bool = typer.Option(False, help="let different rules, sizes and run lengths stand together"),
    strict: bool = typer.Option(False, help="fail if a result file cannot be used"),
) -> None:
    """Make a table from result files, as Markdown and LaTeX."""
    from padgs.cli.report import write_report

    raise typer.Exit(write_report(table, runs, out, protocol, where or [], mix=mix, strict=strict))


def main() -> None:
    """Entry point of `padgs`."""
    app()


if __name__ == "__main__":
    main()
