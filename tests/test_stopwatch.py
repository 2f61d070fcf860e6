import signal
import subprocess
import sys
import time

WORK = """
import time
from padgs.stopwatch import Lap, notice_stops
notice_stops(), notice_stops()
lap = Lap()
print("begun", flush=True)
while time.process_time() < 1.5:
    pass
print(*lap.seconds())
"""


def test_the_time_that_a_process_is_stopped_does_not_count(root):
    process = subprocess.Popen([sys.executable, "-c", WORK], stdout=subprocess.PIPE, text=True, cwd=root)
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    began = time.perf_counter()
    process.send_signal(signal.SIGSTOP)
    time.sleep(1.0)
    process.send_signal(signal.SIGCONT)
    wall, cpu = map(float, process.communicate(timeout=60)[0].split())
    assert time.perf_counter() - began > 1.0 + cpu
    assert abs(wall - cpu) < 0.01
