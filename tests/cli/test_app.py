import subprocess
import sys

import pytest

STOPPED = """
import signal, sys
import {program}

class CtrlC:
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, CtrlC())
{program}.main()
"""


@pytest.mark.parametrize(
    ("program", "module"),
    [
        ("padgs.cli.app", "padgs.cli.commands"),
        ("padgs.cli.app", "padgs.cli.view"),
        ("padgs.multirun.run", "padgs.multirun.finished"),
        ("padgs.multirun.run", "hydra"),
    ],
)
def test_ctrl_c_is_answered_while_the_program_starts(root, program, module):
    command = [sys.executable, "-c", STOPPED.format(program=program, module=module), "report", "all", "nowhere"]
    process = subprocess.run(command, capture_output=True, text=True, cwd=root, timeout=100)
    assert process.returncode == 130 and "Traceback" not in process.stderr
