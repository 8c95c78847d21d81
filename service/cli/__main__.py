"""Entry point of `python -m service.cli`, equal to `acquire`."""

import sys

from service.cli import main

sys.exit(main())
