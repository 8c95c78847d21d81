"""`python -m service.backend LINE FILES`, which `service.backend.start` calls."""

import sys

from service.backend.process import run

run(int(sys.argv[1]), int(sys.argv[2]))
