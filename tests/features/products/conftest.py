"""Other programs that read what the service writes."""

from tests.ephemerides.conftest import orekit

__all__ = ["orekit"]
