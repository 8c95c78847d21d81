"""THE registry of identifiers: one entry makes an identifier known everywhere.

The types that check options and mission files, the OpenAPI schema, the console's
form and the command's choices are derived from it.  The registry stands below the
identifiers, so an entry may name its function as `module:function`, which is
imported when it is first used.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pkgutil import resolve_name
from typing import Any


@dataclass(frozen=True)
class IdentifierEntry:
    """One identifier: its name, its function, and what the pipeline needs to know of it.

    `function` takes a `Sighting` and returns an `Identification`; with `by_columns` it takes many
    sightings, and writes what it finds, as `identify_by_votes` does.
    """

    name: str
    function: str | Callable[..., Any]
    description: str
    by_columns: bool = False
    weighs_hypotheses: bool = False
    """It tells the likeliest hypothesis, so that two groups of stars can be told apart."""
    uses_prior: bool = True
    """It searches about the a priori attitude where there is one."""
    falls_back: bool = False
    """The whole sky is searched where it finds nothing good about the a priori attitude."""
    needs_guide: bool = False
    """It searches the whole sky by itself, with the guide database of triangles."""
    uses: frozenset[str] | None = None
    """The tests and tolerances that change what it finds; None: all of them.

    Others may still change the votes that it shows beside its result.
    """

    @cached_property
    def identify(self) -> Callable[..., Any]:
        """The function itself."""
        function = self.function
        return resolve_name(function) if isinstance(function, str) else function

    @property
    def searches_zone(self) -> bool:
        """True if the identifier searches only the zone about an a priori attitude."""
        return self.uses_prior and not self.needs_guide


IDENTIFIERS: dict[str, IdentifierEntry] = {}
"""The entries by name, in the order in which they are shown."""


def register(entry: IdentifierEntry) -> None:
    """Add an identifier; before `missions.mission`, which derives types, is imported.

    Raises `ValueError` where there is one of that name.
    """
    if entry.name in IDENTIFIERS:
        raise ValueError(f"there is an identifier {entry.name} already")
    IDENTIFIERS[entry.name] = entry


register(
    IdentifierEntry(
        "starid",
        "service.identify.voting.starid:identify_by_votes",
        "the votes of star pairs, Fink & Shoup's steps 1 to 10",
        by_columns=True,
    )
)
register(
    IdentifierEntry(
        "verified",
        "service.identify.hypotheses.verified:identify_verified",
        "a probability for every star, from weighed hypotheses of all of them",
        by_columns=True,
        weighs_hypotheses=True,
        falls_back=True,
        uses=frozenset({"pair_separation_max_deg"}),
    )
)
register(
    IdentifierEntry(
        "ptp",
        "service.identify.triangles.ptp:identify_ptp",
        "planar triangles in the whole sky; uses neither prior nor magnitudes",
        needs_guide=True,
        uses=frozenset(),
    )
)
register(
    IdentifierEntry(
        "lost_in_space",
        "service.identify.hypotheses.verified:identify_verified",
        "as verified, about an attitude that is found in the whole sky",
        by_columns=True,
        weighs_hypotheses=True,
        uses_prior=False,
        uses=frozenset({"pair_separation_max_deg"}),
    )
)
