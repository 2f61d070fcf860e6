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
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # schedulers send it; it is no crash
    try:
        sys.exit(_run(arguments))
    except KeyboardInterrupt as stopped:
        from padgs.runs.console import printable

        advice = f"{str(stopped) or 'stopped'}; to go on: {shlex.join(['padgs-run', *arguments])}"
        print(printable(advice), file=sys.stderr)
        sys.exit(INTERRUPTED)


def _run(arguments: Sequence[str]) -> int:
    """Return the exit code. Slow modules are imported here, so that Ctrl-C is answered from the beginning."""
    import padgs

    if "--version" in arguments:
        print(f"padgs {padgs.__version__}")
        return 0
    from datetime import datetime

    from hydra.errors import HydraException

    from padgs.baselines import clash
    from padgs.multirun import job
    from padgs.multirun.board import OK
    from padgs.multirun.composition import composing, multirun, single_run
    from padgs.multirun.finished import FOLDER
    from padgs.multirun.manual import manual
    from padgs.multirun.overrides import missing_plugin, problem
    from padgs.multirun.sweep import sweep

    try:
        if {"--help", "-h"} & {*arguments}:
            print(manual(arguments))
            return 0
        if error := problem(arguments) or missing_plugin(arguments) or clash():
            job.complain(error)
            return 1
        if any(argument.startswith("-") and argument not in ("-m", "--multirun") for argument in arguments):
            _let_hydra_answer(arguments)
            return 0
        with composing() as loader:
            start = f"{datetime.now():%Y%m%d-%H%M%S}-{os.getpid()}"
            if config := multirun(arguments, f"hydra.sweep.dir=${{run.folder}}/{FOLDER}/{start}"):
                ends = {*sweep(config, loader)}
            else:
                ends = {job.only_job(*single_run(arguments))}
    except HydraException as error:
        job.complain("\n".join(map(str, filter(None, (error, error.__cause__)))))
        return 1
    return 0 if ends <= {OK} else 1


def _let_hydra_answer(arguments: Sequence[str]) -> None:
    """Answer options of Hydra such as --cfg job, which run nothing."""
    import hydra

    from padgs.multirun.composition import register_choices
    from padgs.multirun.overrides import lenient, options_first, quoted, root

    def refuse(_: object) -> None:
        raise SystemExit("this option of Hydra is not supported by padgs-run; see padgs-run --help")

    os.environ.setdefault("PADGS_ROOT", str(root()))
    register_choices()
    if not {"-sc", "--shell_completion"} & {*arguments}:
        sys.argv[1:] = options_first(lenient(quoted(arguments)))
    hydra.main(version_base="1.3", config_path=str(root() / "conf"), config_name="config")(refuse)()


if __name__ == "__main__":
    main()
