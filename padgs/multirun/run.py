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
    try:  # slow modules are imported within, so that Ctrl-C is answered from the beginning
        _answer(arguments)
        from padgs.multirun.board import OK
        from padgs.multirun.composition import composing, multirun, single_run
        from padgs.multirun.job import exit_on_hydra_errors, only_job
        from padgs.multirun.sweep import sweep

        with exit_on_hydra_errors(), composing() as loader:
            config = multirun(arguments)
            ends = {*sweep(config, loader)} if config else {only_job(*single_run(arguments))}
        sys.exit(0 if ends <= {OK} else 1)
    except KeyboardInterrupt as stopped:
        from padgs.runs.console import printable

        advice = f"{str(stopped) or 'stopped'}; to go on: {shlex.join(['padgs-run', *arguments])}"
        print(printable(advice), file=sys.stderr)
        sys.exit(INTERRUPTED)


def _answer(arguments: Sequence[str]) -> None:
    """Exit after options that run nothing, and after settings that cannot be run."""
    import padgs

    if "--version" in arguments:
        print(f"padgs {padgs.__version__}")
        sys.exit()
    from padgs.baselines import clash
    from padgs.multirun.job import complain, exit_on_hydra_errors
    from padgs.multirun.manual import manual
    from padgs.multirun.overrides import missing_plugin, problem

    if {"--help", "-h"} & {*arguments}:
        with exit_on_hydra_errors():
            print(manual(arguments))
        sys.exit()
    if error := problem(arguments) or missing_plugin(arguments) or clash():
        complain(error)
        sys.exit(1)
    if any(argument.startswith("-") and argument not in ("-m", "--multirun") for argument in arguments):
        with exit_on_hydra_errors():
            _let_hydra_answer(arguments)
        sys.exit()


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
