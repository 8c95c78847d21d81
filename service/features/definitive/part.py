"""Service of an open app for definitive attitudes: recorded days, jobs, live filters."""

from service.app.factory import App
from service.features.definitive.days import DefinitiveDays
from service.features.definitive.jobs import DefinitiveJobs
from service.features.definitive.live_filter import LiveFilter


class Definitive:
    """Filters and smooths recorded attitudes, and runs the filters of live data."""

    def __init__(self, app: App) -> None:
        self.days = DefinitiveDays(app.context)
        self.jobs = DefinitiveJobs(app.context, self.days, app.kernels)
        self.live_filter = LiveFilter(app.context, app.kernels)

    def close(self) -> None:
        """Stop all jobs and threads."""
        self.live_filter.stop()
        self.jobs.close()


def open_part(app: App) -> Definitive:
    """Create the service for definitive attitudes of an open app."""
    return Definitive(app)
