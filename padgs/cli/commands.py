"""The commands of `padgs`. A command imports slow modules when it is called."""

from typing import Annotated

import typer

import padgs
from padgs.cli.bench import bench
from padgs.cli.blocks import merge, split
from padgs.cli.check import check
from padgs.cli.convert import convert
from padgs.cli.errors import without_traceback
from padgs.cli.export import export
from padgs.cli.finished import smallest, track
from padgs.cli.prepare import prepare
from padgs.cli.render import render
from padgs.cli.report import report
from padgs.cli.score import score
from padgs.cli.view import view

app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown")  # which joins the lines of a paragraph


def show_version(requested: bool) -> None:
    """Print the version and exit if requested."""
    if requested:
        typer.echo(f"padgs {padgs.__version__}")
        raise typer.Exit


@app.callback()
def commands(
    version: Annotated[bool, typer.Option("--version", callback=show_version, is_eager=True, help="show it")] = False,
) -> None:
    """Panoramic Gaussian splatting, measured fairly."""


for command in (bench, check, convert, export, merge, prepare, render, report, score, smallest, split, track, view):
    app.command()(without_traceback(command))
