"""Where Hydra's launchers need help: which package each comes in, and not giving up on many jobs because of one."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from padgs.checks import install_command

PACKAGES = {  # choice of conf/launcher -> module of its plugin, extra of pyproject.toml
    "local": ("hydra_plugins.hydra_joblib_launcher", "launchers"),
    "slurm": ("hydra_plugins.hydra_submitit_launcher", "launchers"),
    "submitit": ("hydra_plugins.hydra_submitit_launcher", "launchers"),
    "ray": ("hydra_plugins.hydra_ray_launcher", "ray"),
}


def missing_plugin(arguments: Sequence[str]) -> str | None:
    """What to install for the launcher that a command line asks for; None where nothing is missing.

    >>> missing_plugin(["method=padgs", "seed=0,1"])
    """
    for name in (argument.partition("=")[2] for argument in arguments if argument.startswith("launcher=")):
        module, extra = PACKAGES.get(name, ("padgs", ""))
        try:
            found = importlib.util.find_spec(module) is not None
        except ModuleNotFoundError:  # there are no plugins at all
            found = False
        if not found:
            return f"launcher={name} needs {module.partition('.')[2]}: {install_command(extra)}"
    return None


@contextmanager
def patient() -> Iterator[None]:
    """While this lasts, submitit's launcher waits for all jobs, even if the process of one has died.

    As it is, the first one found dead is raised, and the others run on unobserved. Hydra's launcher keeps the jobs
    that it submits to itself, and what submitit itself can be extended by are entry points of installed packages, so
    for the time being its jobs are told that having no results is one, too; the board says how they ended.
    """
    try:
        from submitit import Job
    except ImportError:
        yield
        return
    results = Job.results

    def results_if_any(self: Any) -> list[Any]:
        try:
            return results(self)
        except Exception:
            return [None]

    Job.results = results_if_any
    try:
        yield
    finally:
        Job.results = results
