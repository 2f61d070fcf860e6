"""Entry point of `padgs`; imports slow modules only once it answers Ctrl-C."""

from padgs.runs.interrupt import ending_by_signals


def main() -> None:
    """Entry point of `padgs`."""
    with ending_by_signals():
        from padgs.cli.commands import app

        app()


if __name__ == "__main__":
    main()
