"""The outcome of the fields of one condition under one algorithm, and the rates of it."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from service.simulate.scenes import Conditions

COLUMNS = ("stars", "named", "named_right", "unique", "unique_right", "own_us", "check_us")
"""Counts of a field: stars, those that the algorithm names, those named rightly; the last two
after the check; microseconds of the algorithm, of the check."""
SIGMAS_95 = 1.959964

Fields = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class FieldShare:
    """A share of fields in percent with its 95 % interval (Wilson)."""

    count: int
    of: int

    @property
    def percent(self) -> float:
        """The share; NaN of no fields."""
        return 100.0 * self.count / self.of if self.of else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Least and greatest share that the count agrees with."""
        if not self.of:
            return math.nan, math.nan
        z2, share = SIGMAS_95**2 / self.of, self.count / self.of
        middle = (share + z2 / 2) / (1 + z2)
        half = math.sqrt(share * (1 - share) * z2 + z2**2 / 4) / (1 + z2)
        return 100.0 * (middle - half), 100.0 * (middle + half)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.percent:.2f} ({low:.2f}-{high:.2f})"


LIMIT_MAG = 6.0


@dataclass(frozen=True)
class Case:
    """One condition and the algorithms that see its fields.

    `adds`: noise of magnitude lifts stars fainter than the limit into the field
    as well as it drops brighter ones; without it the sky ends at the limit.
    """

    name: str
    algorithms: tuple[str, ...]
    position_px: float
    magnitude_sigma_mag: float = 0.0
    adds: bool = True
    fewest: int = 6

    @property
    def conditions(self) -> Conditions:
        """The same for the simulator."""
        return Conditions(
            position_px=self.position_px,
            magnitude_sigma_mag=self.magnitude_sigma_mag,
            limit_mag=LIMIT_MAG,
            fewest=self.fewest,
        )


@dataclass(frozen=True, eq=False)
class Tally:
    """Rows (fields, columns) of one case and algorithm; see `COLUMNS`.

    The paper never says when a field counts as identified.  *strict*: three
    stars or more are named, all rightly; *loose*: two or more, most of them
    rightly; *checked*: three or more after the attitude check, all rightly;
    *wrong*: after the check some star has a name that is not its own.
    """

    case: Case
    algorithm: str
    rows: npt.NDArray[np.int64]

    def _column(self, name: str) -> npt.NDArray[np.int64]:
        return np.asarray(self.rows[:, COLUMNS.index(name)])

    @cached_property
    def strict(self) -> FieldShare:
        """All named stars rightly named, three at least."""
        named, right = self._column("named"), self._column("named_right")
        return self._rate((named >= 3) & (right == named))

    @cached_property
    def loose(self) -> FieldShare:
        """Most named stars rightly named, two at least."""
        named, right = self._column("named"), self._column("named_right")
        return self._rate((named >= 2) & (2 * right > named))

    @cached_property
    def checked(self) -> FieldShare:
        """The same as strict after the attitude check."""
        unique, right = self._column("unique"), self._column("unique_right")
        return self._rate((unique >= 3) & (right == unique))

    @cached_property
    def wrong(self) -> FieldShare:
        """The share of fields in which a star is misnamed after the attitude check."""
        return self._rate(self._column("unique_right") < self._column("unique"))

    @property
    def rates(self) -> tuple[FieldShare, ...]:
        """Strict, loose, checked and wrong."""
        return self.strict, self.loose, self.checked, self.wrong

    @cached_property
    def median_ms(self) -> tuple[float, float]:
        """Median milliseconds of a field: of the algorithm itself, and with the check."""
        own, check = self._column("own_us"), self._column("check_us")
        return float(np.median(own)) / 1000.0, float(np.median(own + check)) / 1000.0

    @cached_property
    def mean_ms(self) -> tuple[float, float]:
        """Average milliseconds of a field, likewise; what the paper prints."""
        own, check = self._column("own_us"), self._column("check_us")
        return float(np.mean(own)) / 1000.0, float(np.mean(own + check)) / 1000.0

    @property
    def times(self) -> str:
        """Median and average of the algorithm itself, and with the check, as the tables show."""
        pairs = zip(self.median_ms, self.mean_ms, strict=True)
        return " / ".join(f"{median:.2f} ({mean:.2f})" for median, mean in pairs)

    def of_fields_with(self, least: int, most: int) -> "Tally":
        """The fields that hold so many stars."""
        stars = self._column("stars")
        return Tally(self.case, self.algorithm, self.rows[(stars >= least) & (stars <= most)])

    def _rate(self, fields: Fields) -> FieldShare:
        return FieldShare(int(fields.sum()), len(self.rows))

    def row(self) -> dict[str, Any]:
        """The tally as a JSON object."""
        own_ms, checked_ms = self.median_ms
        return {
            "table": self.case.name,
            "algorithm": self.algorithm,
            "position_px": self.case.position_px,
            "magnitude_sigma_mag": self.case.magnitude_sigma_mag,
            "noise_adds_stars": self.case.adds,
            "scenes": len(self.rows),
            "strict": self.strict.count,
            "loose": self.loose.count,
            "checked": self.checked.count,
            "wrong": self.wrong.count,
            "median_ms": own_ms,
            "median_checked_ms": checked_ms,
            "mean_ms": self.mean_ms[0],
            "mean_checked_ms": self.mean_ms[1],
        }
