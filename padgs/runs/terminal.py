"""Text on a terminal: whatever names and messages hold is shown, and neither obeyed by it nor taken for markup."""

from __future__ import annotations

from rich.console import Console
from rich.text import Text


def say(console: Console, text: object, style: str = "") -> None:
    """Print lines as they are, of any length."""
    console.print(Text(printable(str(text)), style), soft_wrap=True)


def printable(text: str) -> str:
    r"""The text with escapes for what a terminal would obey, and for what no encoding has.

    >>> printable("caf\u00e9 \x1b[2J \udce9")
    'café \\x1b[2J \\udce9'
    """
    shown = "".join(c if c.isprintable() or c in "\n\t" or ord(c) > 0xFF else f"\\x{ord(c):02x}" for c in text)
    return shown.encode("utf-8", "backslashreplace").decode()
