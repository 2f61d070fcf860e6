"""`padgs render`: a video, or images, along a camera path through a run."""

from typing import Annotated

import typer

from padgs.cli.errors import DataPath, Device, Model, Rays, Transform, check_range, name_place, show

MAX_SIDE = 16384  # larger images fill the memory


def render(
    run: Model,
    to: Annotated[str, typer.Option(help="an .mp4, or a folder for PNGs; default: video.mp4 in the run's folder")] = "",
    path: Annotated[str | None, typer.Option(help="cameras (default), orbit, dolly, or a JSON of a path")] = None,
    camera: Annotated[str, typer.Option(help="panorama or perspective")] = "panorama",
    fov: Annotated[float | None, typer.Option(help="horizontal degrees of a perspective image; default 90")] = None,
    width: Annotated[int, typer.Option(help="width in pixels; 0: about the run's, half in perspective")] = 0,
    height: Annotated[int | None, typer.Option(help="height of a perspective image; default 9/16 of the width")] = None,
    seconds: Annotated[float | None, typer.Option(help="length of the video; default 10, or that of the path")] = None,
    fps: Annotated[float, typer.Option(help="frames per second")] = 30.0,
    depth: Annotated[bool, typer.Option("--depth", help="also write depth")] = False,
    data: DataPath = None,
    rays: Rays = "exact",
    transform: Transform = "",
    device: Device = "auto",
) -> None:
    """Write a video or PNGs along a camera path: 360-degree, which players recognise, or in perspective."""
    import os
    from pathlib import Path

    from rich.console import Console

    from padgs.apps.camera_path_video import depth_unit, free_name, views_along, write_video
    from padgs.apps.external import open_model
    from padgs.data.formats.path_file import MAX_FRAMES

    if camera not in ("panorama", "perspective"):
        raise ValueError(f"unknown camera {camera!r}; known: panorama, perspective")
    if camera == "panorama" and (fov is not None or height is not None):
        raise ValueError("--fov and --height belong to perspective images: add --camera perspective")
    check_range(0.01, 1000, fps=fps)
    check_range(0.1, 179.9, fov=fov)
    check_range(2, MAX_SIDE, width=width or None)
    check_range(1, MAX_SIDE, height=height)
    if camera == "panorama" and width % 2:
        raise ValueError(f"--width is {width}; a panorama is 2:1, so it must be even")
    if seconds is not None and not 0 < seconds * fps <= MAX_FRAMES:
        raise ValueError(
            f"--seconds is {seconds:g}, which makes {seconds * fps:g} frames at --fps {fps:g}; it must be above 0 and "
            f"at most {MAX_FRAMES / fps:g}"
        )
    with Console().status("opening the run") as status:
        found = open_model(run, data, rays, transform, device)
        for note in found.notes:  # they may say that the frames would show nothing
            show(f"  {note}")
        shape = None if camera == "panorama" else (height, 90.0 if fov is None else fov)
        views = views_along(found, path, seconds, fps, width, shape)
        lens = views[0].camera
        output = Path(os.path.abspath(to)) if to else free_name(found.folder / "video.mp4")
        with name_place(output):
            outputs = write_video(
                output,
                views,
                found.through(lens).render,
                fps=fps,
                scene_scale=found.scene.scale,
                depth=depth,
                origin=found.scene.origin,
                spherical=camera == "panorama",
                progress=lambda done: status.update(f"frame {done} of {len(views)}"),
            )
    for written in outputs:
        show(f"{written}: {len(views)} frames of {lens.width}x{lens.height}")
    if depth:
        show(f"  {depth_unit(output, found.scene.scale)}")
