import signal
import subprocess
import sys
import time

import pytest


@pytest.mark.parametrize("delay", [0.0, 0.05])
def test_ctrl_c_is_answered_while_the_program_starts(root, delay):
    start = "import padgs.cli.app as app; print('begun', flush=True); app.main()"
    command = [sys.executable, "-c", start, "report", "all", "nowhere"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=root)
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=100)
    assert process.returncode == 130 and "Traceback" not in error
