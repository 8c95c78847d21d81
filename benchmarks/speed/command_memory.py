"""Runs a command of the service, and prints its seconds and its greatest memory in MB.

python -m benchmarks.speed.command_memory export batches --spacecraft XTE --output xte.csv
"""

import re
import sys
import time
from pathlib import Path

from service.cli import main

if __name__ == "__main__":
    started = time.perf_counter()
    if code := main(sys.argv[1:]):
        sys.exit(code)
    seconds = time.perf_counter() - started
    # Not getrusage: its peak is that of the process which started this one, if that was larger.
    (peak,) = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    print(seconds, int(peak) / 1024)
