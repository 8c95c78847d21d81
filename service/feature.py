"""Features: subjects that the service can do without, each a folder of its own.

Nothing outside the folder of a feature imports it.  Its package holds a `Feature` under the name
`FEATURE`, which says which modules the feature brings; the rest of the service asks for these:

- `tables`: importing it declares its tables of the database; they stay where the feature is off.
  A table whose rows the record's chain binds says so in its `info` (`storage.sql.columns.BOUND`).
  Another package also lists its tables as `TABLES`: they are made where the database lacks them,
  while those of the service are made by its migrations.
- `archive`: `open_archive(folder)` reads batches that left the database
  (`storage.archived.Archive`), and `forget_archived` removes some (`storage.upkeep.forget`).
- `kernels`: `compile_kernels()` compiles the feature's own; a module or a package, which holds all
  its compiled code and all of the feature that this imports (`compiled.cache.SOURCES`).
- `projection`: `apply(connection, results)` is called with results in the order of the record,
  in the transaction that notes how far projections have come: each once, while the feature is on.
  `wants(connection, run)` tells if it needs the results of a reprocessed run, which come in order
  of time and without answers.
- `state`: `active_alarms(connection, run, now)` gives what the overview and the badges of pages
  show as alarms, the one that is worst now first.
- `shares`: `evaluate_day(connection, mission, day)` is called with a quantity of a smoothed day
  (`trends.limits.SampledDay`), in the transaction that records the day.
- `part`: `open_part(app)` makes what the feature adds to an open `App`, which has it by its class
  (`App.part`) and closes it by its `close()`.
- `command`: `add(commands)` declares its commands, as a module of `service.cli.commands` does.
- `formats`: `INPUT_FORMATS`, input formats by name (`service.observations.input_formats`).
- `serving`: `serving(app, metrics)`, an asynchronous context manager entered while the service
  serves; `check(settings)` raises `BadConfiguration` before anything is opened.
- `routes`: `ROUTERS` are its routes of the API; their examples are the file `examples.json` of
  the package, which `python -m service.web.examples` writes from the handlers' decorators
  `Example` and from `send(walk)` of a module `examples`.
- `pages`: importing it registers its pages of the console; its templates and scripts lie in the
  folders `templates` and `static` of the package.  `PANELS`, if it is there, is what it adds to
  pages of others: functions of the `PageContext` by name of the page, which says what it takes.
- `metrics`: `reads(app)`, functions by name that are called together at each scrape, with a
  deadline; `collect(app, found)` makes metrics of what they returned in time.
- `telemetry`: reads an input format whose files hold no lines, by its name `FORMAT`.
  `opened_upload(file, missions, spacecraft)` reads an upload
  (`ingest.running_replay.CountedLines`); `add_options(parser)` declares options of `acquire
  replay`, and `files_of(parsed)` are the files that they name (`replay.items.OtherFiles`).

Another package brings a feature by an entry point of the group `acquire.features` that names its
`Feature`.  Of features that `ACQUIRE_FEATURES_OFF` names, nothing but their package and `tables` is
imported.  Results that are projected while a feature is off are not projected by it later.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType

from service.errors import BadConfiguration, shown_value

_FOLDER = str(Path(__file__).with_name("features"))
SHIPPED = tuple(sorted(each.name for each in iter_modules([_FOLDER])))
"""Names of the features in this package, in the order of their routes and commands."""

KINDS = (
    "tables",
    "archive",
    "kernels",
    "projection",
    "state",
    "shares",
    "part",
    "command",
    "formats",
    "serving",
    "routes",
    "pages",
    "metrics",
    "telemetry",
)
"""Names of the modules that a feature may have."""

SETTING = "ACQUIRE_FEATURES_OFF"


@dataclass(frozen=True)
class Feature:
    """Declaration of a feature and its modules.

    `name` is its name in `ACQUIRE_FEATURES_OFF`; `package` is the package that holds the modules
    named in `brings`.
    """

    name: str
    package: str
    brings: tuple[str, ...]

    def __post_init__(self) -> None:
        if unknown := set(self.brings) - set(KINDS):
            raise ValueError(f"{self.name}: a feature cannot bring {', '.join(sorted(unknown))}")


@cache
def known_features() -> Mapping[str, Feature]:
    """All installed features by name: those of `SHIPPED`, then those of entry points."""
    shipped = [import_module(f"service.features.{name}").FEATURE for name in SHIPPED]
    brought = [entry.load() for entry in entry_points(group="acquire.features")]
    return {feature.name: feature for feature in (*shipped, *brought)}


def features_on(off: str) -> list[Feature]:
    """Features that are on, given a list of those off, such as `follow,tracks`.

    Raises `BadConfiguration` for an unknown name.
    """
    known = known_features()
    names_off = {name.strip() for name in off.split(",")} - {""}
    for name in sorted(names_off - known.keys()):
        raise BadConfiguration(
            f"{SETTING}: must be features of {', '.join(known)} (got {shown_value(name)})"
        )
    return [feature for name, feature in known.items() if name not in names_off]


def feature_modules(kind: str, off: str) -> list[ModuleType]:
    """Import the modules of a kind from every feature that is not in the list `off`."""
    return [
        import_module(f"{feature.package}.{kind}")
        for feature in features_on(off)
        if kind in feature.brings
    ]


def brought_modules(kind: str) -> list[ModuleType]:
    """Import the modules of a kind from every feature of another package."""
    brought = (each for name, each in known_features().items() if name not in SHIPPED)
    return [import_module(f"{each.package}.{kind}") for each in brought if kind in each.brings]


def feature_folders(name: str) -> list[str]:
    """Packages of all features that have a folder of a given name, such as `templates`."""
    return [
        feature.package
        for feature in known_features().values()
        if files(feature.package).joinpath(name).is_dir()
    ]
