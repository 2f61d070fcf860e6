"""`padgs-run`: one run, or a multirun of many, composed by Hydra from `conf/`."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from padgs.runs.interrupt import ending_by_signals


def main() -> None:
    """Entry point of `padgs-run`; exit code 0, 1 if any run failed, 128 + number of the signal that stopped it."""
    arguments = sys.argv[1:]
    advice = f"; to go on: {shlex.join(['padgs-run', *arguments])}"
    with ending_by_signals(advice):  # slow modules are imported within
        from padgs.multirun.job import exit_on_errors

        with exit_on_errors():
            _answer(arguments)
            from rich.console import Console

            from padgs.multirun.composition import composing, configuration, multirun
            from padgs.multirun.job import Status, search_smallest
            from padgs.multirun.sweep import sweep
            from padgs.runs.console import say
            from padgs.runs.run import Callback, load_scene, run, start
            from padgs.runs.tracking import Tracker

            with composing() as loader:
                if composed := multirun(arguments):
                    ends = {*sweep(composed, loader)}
                else:
                    config, console = configuration(arguments), Console()
                    runs, experiment = Path(config.run.folder), " ".join(config.labels.experiments)
                    tracker = Tracker(config.tracking, runs, experiment, lambda line: say(console, line, "dim"))
                    scene = load_scene(config, start(config))
                    result = run(config, console, scene=scene)
                    search_smallest(config, scene, result, console, Callback())
                    tracker.add(runs / result.run)
                    ends = {result.status}
        sys.exit(0 if ends <= {Status.OK} else 1)


def _answer(arguments: Sequence[str]) -> None:
    """Exit after options that run nothing; raise a ValueError for settings that cannot be run."""
    import padgs

    if "--version" in arguments:
        print(f"padgs {padgs.__version__}")
        sys.exit()
    from padgs.baselines import clash
    from padgs.multirun.composition import composed_text, composing
    from padgs.multirun.manual import manual
    from padgs.multirun.overrides import SHOW, missing_plugin, problem

    if {"--help", "-h"} & {*arguments}:
        print(manual(arguments))
        sys.exit()
    if error := problem(arguments) or missing_plugin(arguments) or clash():
        raise ValueError(error)
    if SHOW in arguments:
        settings = [*arguments]
        key = settings.pop(settings.index(SHOW) + 1)
        settings.remove(SHOW)
        with composing():
            print(composed_text(settings, key), end="")
        sys.exit()


if __name__ == "__main__":
    main()
