"""The benchmarks, each with its answers checked.

    python -m benchmarks                       all of them
    python -m benchmarks staircase --quick     one, on a small sample

The exit code is 1 where a result is out of its bounds.
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks import (
    aberration,
    attitude_against_svd,
    calibration,
    centroids,
    covariance,
    frames,
    imaging_claims,
    plain_reference,
    ptp,
    spurious,
    staircase,
    verified_cost,
    whole_sky,
    zone_counts,
)
from benchmarks.report import Report

BENCHMARKS: dict[str, Callable[[bool, int], Report]] = {
    "zone_counts": zone_counts.run,
    "staircase": staircase.run,
    "aberration": aberration.run,
    "covariance": covariance.run,
    "attitude_against_svd": attitude_against_svd.run,
    "plain_reference": plain_reference.run,
    "calibration": calibration.run,
    "spurious": spurious.run,
    "whole_sky": whole_sky.run,
    "verified_cost": verified_cost.run,
    "frames": frames.run,
    "centroids": centroids.run,
    "imaging_claims": imaging_claims.run,
    "ptp": ptp.run,
}
DEFAULT_SEED = 19941026
RESULTS = Path(__file__).parent / "results.json"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="name", help=", ".join(BENCHMARKS))
    parser.add_argument("--quick", action="store_true", help="a small sample of each")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED)
    parser.add_argument("--write", action="store_true", help=f"write {RESULTS.name}")
    asked = parser.parse_args(arguments)
    if unknown := set(asked.names) - set(BENCHMARKS):
        parser.error(f"no such benchmark: {', '.join(sorted(unknown))}")
    reports = []
    for name in asked.names or BENCHMARKS:
        report = BENCHMARKS[name](asked.quick, asked.seed)
        print(report.text(), flush=True)
        reports.append(report)
    if asked.write:
        written = {r.name: {"passed": r.passed, **r.figures} for r in reports}
        RESULTS.write_text(json.dumps(written, indent=2, ensure_ascii=False) + "\n", "utf-8")
    return 0 if all(report.passed for report in reports) else 1


if __name__ == "__main__":
    sys.exit(main())
