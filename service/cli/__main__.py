"""`python -m service.cli` is `acquire`."""

import sys

from service.cli import main

sys.exit(main())
