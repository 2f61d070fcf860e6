"""`padgs score`: Gaussians or renders of another program, scored like a run."""

import shlex
import sys
from typing import Annotated

import typer

from padgs.cli.errors import Cameras, Depth, Format, Images, Mask, Points, Rays, Split, Transform, check_range, show


def score(
    model: Annotated[
        str, typer.Argument(help="a .ply, .spz, .sog, .splat or .ksplat, or a folder of NAME.png for each test view")
    ],
    data: Annotated[str, typer.Option(help="folder of the data set, or of a run on it")],
    label: Annotated[str, typer.Option(help="name in tables; default: the program that the file names")] = "",
    rays: Rays = "exact",
    transform: Transform = "",
    to: Annotated[str, typer.Option(help="folder of run folders, for the result")] = "runs",
    format: Format = "",
    width: Annotated[int, typer.Option(help="reduce the photographs to this width; 0: as they are")] = 0,
    mask: Mask = "",
    images: Images = "",
    points: Points = "",
    depth: Depth = "",
    cameras: Cameras = "",
    split: Split = "",
    device: Annotated[str, typer.Option(help="auto, cpu or cuda")] = "auto",
) -> None:
    """Score the test views of a data set with a model that another program made; `padgs report` shows it as a row.

    Gaussians are rendered by padgs: exactly along each ray, or (--rays ewa) as ordinary viewers do, with affine
    footprints and a low-pass of 0.3 pixel on the faces of a cube. They must be in the world of the data set; training
    views are rendered to see whether they are.
    """
    from dataclasses import replace
    from pathlib import Path

    from rich.console import Console

    from padgs.apps.export.splat_file import READ
    from padgs.apps.external import ExternalOptions, ExternalRun, Renders, config_of, is_splat_file, score_external
    from padgs.runs.config import choose_device
    from padgs.runs.console import show_result
    from padgs.runs.run import load_scene

    check_range(0, 65536, width=width)
    path, console = Path(model), Console()
    if not path.exists():
        raise FileNotFoundError(f"there is no {model}; give a file of Gaussians, or a folder of renders")
    if not path.is_dir() and not is_splat_file(model):
        raise ValueError(f"{model} is no {', '.join(READ)}, and no folder of renders")
    settings = {"format": format, "width": width, "mask": mask, "images": images, "points": points}
    settings |= {"depth": depth, "cameras": cameras, "split": split}
    with console.status("opening the data set") as status:
        config = config_of(data, device=device, **settings)
        if path.is_dir():
            if transform or rays != "exact":
                raise ValueError("--transform and --rays belong to Gaussians; renders are taken as they are")
            scene = load_scene(config, choose_device("cpu", config.render))
            renders = Renders.find(path, scene)
            scene = replace(scene, test=tuple(replace(view, load_depth=None) for view in scene.test))
            config = replace(config, options=ExternalOptions(renders.digest()))
            render, program = renders.render, ("", "")
            extra = renders.extra
            notes = [f"{len(extra)} files belong to no test view, such as {extra[0]}"] if extra else []
        else:
            opened = ExternalRun.open(path, config, rays, transform, device)
            config, scene, program, notes = opened.config, opened.scene, opened.program, [*opened.notes]
            render = opened.method.render
            status.update("comparing training views")
            fit = opened.check()
            if not fit.fits and not transform:
                raise ValueError(f"{fit}. To score it as it is, add --transform identity")
            notes.append(str(fit))
        for note in (*scene.notes, *notes):
            show(f"  {note}")
        status.update("scoring")
        label = label or " ".join(filter(None, program)) or path.name.partition(".")[0]
        result, folder = score_external(render, config, scene, label, program, Path(to))
    show_result(result, folder, console)
    if not path.is_dir():
        show(f"rendered by padgs with --rays {rays}")
    show(f"next: {shlex.join(('padgs', 'report', 'runs', to))}", sys.stdout)
