"""Entry point of `padgs`; imports slow modules only once it answers Ctrl-C."""

from __future__ import annotations

import sys

from padgs.runs.interrupt import INTERRUPTED


def main() -> None:
    """Entry point of `padgs`; exit code 130 if stopped by Ctrl-C while it starts."""
    try:
        from padgs.cli.commands import app

        app()
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
