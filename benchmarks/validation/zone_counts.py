"""Numbers of stars and pairs in the paper's zones, from the shipped catalog and the paper."""

from benchmarks.bounds import Bound, at_most
from benchmarks.record import CORE
from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from tests.reference.zone_counts import ZoneQuantity, counts


def run(quick: bool, seed: int) -> Report:
    """Benchmark of zone counts; neither the size nor the seed matters."""
    found = list(counts(SkyModel(load_embedded(), LruCache(256 << 20))))
    figures = {
        f"{c.zone}, {c.quantity}": f"{c.ours:,} (paper {c.paper:,}, {c.off:+.1%})" for c in found
    }
    return Report("zone_counts", figures, bounds_of(found))


def bounds_of(found: list[ZoneQuantity]) -> list[Bound]:
    """Bounds of the greatest differences of stars and of pairs."""
    return [
        at_most(
            f"largest difference of {quantity}, as a share",
            max(abs(c.off) for c in found if c.quantity == quantity),
            next(c.within for c in found if c.quantity == quantity),
        )
        for quantity in dict.fromkeys(c.quantity for c in found)
    ]


def write(quick: bool, seed: int) -> Written:
    """Section of the verification about zone counts; neither size nor seed matters."""
    found = list(counts(SkyModel(load_embedded(), LruCache(256 << 20))))
    rows = [
        (zone, *(cell for c in found if c.zone == zone for cell in _cells(c)))
        for zone in dict.fromkeys(c.zone for c in found)
    ]
    head = ("zone", "stars: paper", "here", "difference", "pairs: paper", "here", "difference")
    text = f"""
Stars and pairs of the zones whose counts Fink & Shoup print, from the catalog that is shipped.
Their run catalogs of 1994 are not to be had, so agreement within 8 % of the stars and 15 % of the
pairs is asked for, not equality. The bands about the Sun are those of the first of each month from
July 1995 to January 1996; of these the paper gives the fewest and the most.

{table(head, rows, numbers=6)}
"""
    return Written(text, bounds_of(found))


def _cells(count: ZoneQuantity) -> tuple[object, ...]:
    return count.paper, count.ours, f"{count.off:+.1%}"


SECTION = Section("The sky", write, (*CORE, "studies/paper_1994"))
