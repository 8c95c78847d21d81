"""The definitive attitude of an open app: days that are recorded, jobs, and the live filter."""

from service.app.factory import App
from service.features.definitive.days import DefinitiveDays
from service.features.definitive.jobs import DefinitiveJobs
from service.features.definitive.live_filter import LiveFilter


class Definitive:
    """Filters and smooths recorded attitudes, and keeps the filters of live data up."""

    def __init__(self, app: App) -> None:
        self.days = DefinitiveDays(app.context)
        self.jobs = DefinitiveJobs(app.context, self.days, app.kernels)
        self.live_filter = LiveFilter(app.context, app.kernels)

    def close(self) -> None:
        """End the jobs and the threads."""
        self.live_filter.stop()
        self.jobs.close()


def open_part(app: App) -> Definitive:
    """The definitive attitude of an open app."""
    return Definitive(app)
