"""`padgs check`: check that a data set is ready for training."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from padgs.cli.errors import OF_DATA, Cameras, Depth, Format, Images, Mask, Points, Split, as_options, show

if TYPE_CHECKING:
    from padgs.data.check import Report


def check(
    path: Annotated[str, typer.Argument(help="folder with panoramas and poses, or the file that describes them")],
    format: Format = "auto",
    overlay: Annotated[str, typer.Option(help="file for points on a panorama, or none; default: beside the data")] = "",
    mask: Mask = "auto",
    depth: Depth = "auto",
    images: Images = "",
    points: Points = "auto",
    cameras: Cameras = "all",
    split: Split = "auto",
) -> None:
    """Check a data set and list its problems. Exit code 1 if there are any."""
    from rich.console import Console

    if overlay not in ("", "none") and Path(overlay).suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise ValueError(f"--overlay {overlay} is no .png or .jpg; choose another name, or none")
    from padgs.data.capture import DataOptions
    from padgs.data.check import check as look_through

    options = DataOptions(mask=mask, depth=depth, images=images or None, points=points, cameras=cameras, split=split)
    with Console().status("looking at the images") as status:
        report = look_through(
            Path(path),
            format=format,
            options=options,
            overlay=None if overlay == "none" else Path(overlay) if overlay else overlay_path(Path(path)),
            progress=lambda done, total: status.update(f"looking at image {done} of {total}"),
        )
    end_with(report, OF_DATA)


def overlay_path(data: Path) -> Path | None:
    """Return the default file of the overlay: beside the data, or in the working folder; None if both are read-only."""
    from padgs.data.check import OVERLAY

    folder = data if data.is_dir() else data.parent
    return next((place / OVERLAY for place in (folder, Path()) if os.access(place, os.W_OK)), None)


def end_with(report: Report, names: Iterable[str]) -> NoReturn:
    """Print the report, in which options have these names; exit code 1 if there are problems."""
    show(as_options("\n".join(lines(report)), names))
    raise typer.Exit(1 if report.problems else 0)


def lines(report: Report) -> list[str]:
    """The report as text."""
    out = [f"{report.path}"]
    if report.train:
        out += [
            f"  format         {report.format}",
            f"  views          {report.train} train, {report.test} test, {report.unused} unused; {report.resolution}",
            f"  points         {report.points}{'' if report.coloured else ', without colours of their own'}",
            f"  camera path    {report.path_length:.4g} long; median depth {report.median_depth:.4g}",
        ]
    if report.gravity is not None:
        found, text = report.gravity, "the cameras have no common up direction"
        if found.agreement > 0.5:
            text = f"up is {found.axis} within {found.off_axis:.1f} degrees; "
            text += f"cameras tilt by {found.tilt:.1f} degrees (median)"
        out.append(f"  gravity        {text}")
    if report.reprojection_median is not None:
        out.append(
            f"  reprojection   {report.reprojection_median:.2f} pixels median, {report.reprojection_95:.2f} at 95 % "
            f"({report.observations} observations)"
        )
    if report.colour_correlation is not None:
        out.append(f"  colours        points and panoramas correlate by {report.colour_correlation:.2f}")
    if report.exposure_spread is not None:
        out.append(f"  exposures      differ by a factor of {2**report.exposure_spread:.2f} (standard deviation)")
    if report.masked:
        shares = sorted(report.masked.values())
        which = f"{len(shares)} of {report.train + report.test} views"
        out.append(f"  masked         {shares[0]:.1%} to {shares[-1]:.1%} of each image, in {which}")
    if report.overlay is not None:
        out.append(f"  overlay        {report.overlay}: points on a panorama, red = near, blue = far")
    out += [f"  note           {note}" for note in report.notes]
    out += [f"  PROBLEM        {problem}" for problem in report.problems]
    if report.suggestion is not None:
        out.append(f"  SUGGESTION     the points fit if {report.suggestion}")
    out.append(f"  {len(report.problems)} problem(s)" if report.problems else "  ready for training")
    return out
