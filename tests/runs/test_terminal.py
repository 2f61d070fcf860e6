import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from support.composed import composed
from support.made_up import result
from support.tiny_scene import tiny_scene

from padgs.runs.console import introduce, say, show_result

TEXT = "[bold]a[/b] [/x] \x1b[2J \x1b]0;t\x07 \udce9"
SHOWN = r"[bold]a[/b] [/x] \x1b[2J \x1b]0;t\x07 \udce9"


@pytest.mark.parametrize(
    "write",
    [
        lambda console: say(console, TEXT),
        lambda console: introduce(replace(composed(), variant=TEXT), tiny_scene(), Path("x"), console),
        lambda console: introduce(composed(), replace(tiny_scene(), name=TEXT), Path("x"), console),
        lambda console: introduce(composed(), replace(tiny_scene(), notes=(TEXT,)), Path("x"), console),
        lambda console: introduce(composed(), tiny_scene(), Path(TEXT), console),
        lambda console: show_result(replace(result(), status="nan", reason=TEXT), Path("x"), console),
    ],
)
def test_names_are_neither_markup_nor_obeyed(write):
    out = io.StringIO()
    write(Console(file=out, width=400, force_terminal=True, color_system=None))
    assert SHOWN in out.getvalue() and "\x1b" not in out.getvalue()
