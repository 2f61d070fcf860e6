"""`padgs-run`: one run, or a multirun of many, composed by Hydra from `conf/`."""

from __future__ import annotations

import os
import shlex
import signal
import sys
from collections.abc import Sequence

from padgs.runs.interrupt import INTERRUPTED


def main() -> None:
    """Entry point of `padgs-run`; exit code 0, 1 if any run failed, 130 if stopped by Ctrl-C."""
    arguments = sys.argv[1:]
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # what schedulers send is told apart from a crash
    try:
        sys.exit(_run(arguments))
    except KeyboardInterrupt as stopped:
        from padgs.runs.console import printable

        advice = f"{str(stopped) or 'stopped'}; to go on: {shlex.join(['padgs-run', *arguments])}"
        print(printable(advice), file=sys.stderr)
        sys.exit(INTERRUPTED)


def _run(arguments: Sequence[str]) -> int:
    """Exit code. What takes time to import is imported here, so that Ctrl-C is answered from the beginning."""
    import padgs
    from padgs import results
    from padgs.multirun.finished import FOLDER, only_run

    if "--version" in arguments:
        print(f"padgs {padgs.__version__}")
        return 0
    if folder := only_run(arguments):
        from rich.console import Console

        from padgs.runs.console import show_result

        console = Console()
        console.print("finished before, nothing to do")
        show_result(results.read(folder / results.FILE_NAME), folder, console)
        return 0
    from datetime import datetime

    import hydra
    from hydra.errors import HydraException

    from padgs.baselines import clash
    from padgs.multirun import job, sweeper
    from padgs.multirun.board import OK
    from padgs.multirun.choices import register_choices
    from padgs.multirun.launchers import missing_plugin
    from padgs.multirun.manual import manual
    from padgs.multirun.overrides import conflict, lenient, options_first, quoted, root

    if {"--help", "-h"} & {*arguments}:
        try:
            print(manual(arguments))
        except HydraException as error:
            job.complain(str(error))
            return 1
        return 0
    os.environ.setdefault("PADGS_ROOT", str(root()))
    if problem := conflict(arguments) or missing_plugin(arguments) or clash():
        job.complain(problem)
        return 1
    register_choices()
    sweeper.register()
    completing = {"-sc", "--shell_completion"} & {*arguments}
    job.ARGUMENTS[:] = arguments
    start = f"{datetime.now():%Y%m%d-%H%M%S}-{os.getpid()}"
    if not completing:
        sys.argv[1:] = [*options_first(lenient(quoted(arguments))), f"hydra.sweep.dir=${{run.folder}}/{FOLDER}/{start}"]
    hydra.main(version_base="1.3", config_path=str(root() / "conf"), config_name="config")(job.only_job)()
    return 0 if {*job.ENDS, *sweeper.ENDS} <= {OK} else 1


if __name__ == "__main__":
    main()
