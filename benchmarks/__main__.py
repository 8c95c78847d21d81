"""The benchmarks, each with its answers checked.

    python -m benchmarks                       those of speed, 15 minutes: `make bench`
    python -m benchmarks --all                 those of answers as well
    python -m benchmarks pipeline --quick      one, on a small sample

The exit code is 1 where a result is out of its bounds.
"""

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence

from benchmarks.record import SERVICE, record_of
from benchmarks.report import Report
from benchmarks.speed import (
    chain,
    clone_to_table,
    columns,
    compiling,
    exports,
    first_posts,
    kernels,
    live_filter,
    packets,
    performance,
    pipeline,
    posts,
    reprocessing,
    scale,
    soak,
    stored,
    tracker_calibration,
    verified_cost,
)
from benchmarks.validation import (
    aberration,
    attitude_against_svd,
    calibration,
    centroids,
    consistency,
    covariance,
    crossed_frames,
    deep_fields,
    filtering,
    frames,
    imaging_claims,
    paper_runs,
    plain_reference,
    ptp,
    spurious,
    tracker_sigmas,
    two_groups,
    whole_sky,
    zone_counts,
)
from benchmarks.validation.lost_in_space import measure as lost_in_space
from benchmarks.validation.pictures import blind, calibrations, offsets

BENCHMARKS: dict[str, Callable[[bool, int], Report]] = {
    "zone_counts": zone_counts.run,
    "pipeline": pipeline.run,
    "aberration": aberration.run,
    "covariance": covariance.run,
    "consistency": consistency.run,
    "attitude_against_svd": attitude_against_svd.run,
    "plain_reference": plain_reference.run,
    "paper_runs": paper_runs.run,
    "calibration": calibration.run,
    "spurious": spurious.run,
    "two_groups": two_groups.run,
    "whole_sky": whole_sky.run,
    "deep_fields": deep_fields.run,
    "verified_cost": verified_cost.run,
    "filtering": filtering.run,
    "frames": frames.run,
    "crossed_frames": crossed_frames.run,
    "centroids": centroids.run,
    "imaging_claims": imaging_claims.run,
    "ptp": ptp.run,
    "kernels": kernels.run,
    "columns": columns.run,
    "posts": posts.run,
    "first_posts": first_posts.run,
    "compiling": compiling.run,
    "clone_to_table": clone_to_table.run,
    "live_filter": live_filter.run,
    "stored": stored.run,
    "chain": chain.run,
    "scale": scale.run,
    "soak": soak.run,
    "packets": packets.run,
    "reprocessing": reprocessing.run,
    "exports": exports.run,
    "lost_in_space": lost_in_space.run,
    "pictures": blind.run,
    "picture_offsets": offsets.run,
    "camera_calibrations": calibrations.run,
    "tracker_calibration": tracker_calibration.run,
    "tracker_sigmas": tracker_sigmas.run,
}
OF_SPEED = tuple(performance.TITLES)
BY_NAME_ALONE = ("clone_to_table", "scale", "soak")
"""These take up to an hour, or install packages."""
DEFAULT_SEED = 19941026


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="name", help=", ".join(BENCHMARKS))
    parser.add_argument("--quick", action="store_true", help="a small sample of each")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED)
    parser.add_argument("--all", action="store_true", help="not those of speed alone")
    parser.add_argument(
        "--write", action="store_true", help="keep the figures of speed, and write them as a page"
    )
    asked = parser.parse_args(arguments)
    if unknown := set(asked.names) - set(BENCHMARKS):
        parser.error(f"no such benchmark: {', '.join(sorted(unknown))}")
    reports = []
    by_default = [
        name for name in (BENCHMARKS if asked.all else OF_SPEED) if name not in BY_NAME_ALONE
    ]
    code = {}
    for name in asked.names or by_default:
        # Before the measurement, which takes minutes: the code may be edited meanwhile.
        code[name] = str(record_of(SERVICE))
        report = BENCHMARKS[name](asked.quick, asked.seed)
        print(report.text(), flush=True)
        reports.append(report)
    if asked.write:
        _keep([each for each in reports if each.name in OF_SPEED], asked.seed, asked.quick, code)
        performance.write()
    return 0 if all(report.passed for report in reports) else 1


def _keep(reports: Sequence[Report], seed: int, quick: bool, code: Mapping[str, str]) -> None:
    """Put figures into the results beside those of the other benchmarks."""
    path = performance.RESULTS
    kept = json.loads(path.read_text("utf-8")) if path.exists() else {"benchmarks": {}}
    kept["record"] = performance.record(seed, quick)
    for each in reports:
        kept["benchmarks"][each.name] = {
            "within_bounds": each.passed,
            "bounds": [bound.as_json() for bound in each.bounds],
            "figures": dict(each.figures),
            "curves": dict(each.curves),
            "record": kept["record"],
            "code": code[each.name],
        }
    path.write_text(json.dumps(kept, indent=2, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    sys.exit(main())
