"""Command `acquire simulate`: telemetry with known truth."""

import sys
from argparse import Namespace
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from service.cli import arguments
from service.cli.arguments import mission_and_catalog
from service.errors import BadInput, Fault, shown_value

if TYPE_CHECKING:
    from collections.abc import Iterator

    from service.missions.mission import Mission
    from service.observations.batch import Aberration
    from service.simulate.stretches import Pass
    from service.simulate.telemetry import DrawnBatch, GyroWanted


def add(commands: Any) -> None:
    """Declare the command `simulate` with its subcommands."""
    group = arguments.add_group(
        commands,
        "simulate",
        "Simulate what a spacecraft sends, with known truth; with the package of studies, repeat "
        "published experiments.",
        "acquire simulate telemetry --spacecraft XTE --batches 2000 --seed 7 xte.ndjson",
    )
    _add_telemetry(group)


_SIZES = {
    "attitude_error": "attitude_error_deg",
    "spurious": "spurious_stars",
    "magnitude_error": "magnitude_error_mag",
    "position_error": "position_error_arcsec",
}
_SERIOUS_SHARE = 0.1


def _add_telemetry(group: Any) -> None:
    parser = arguments.add_command(
        group, "telemetry", _run_telemetry, first="--seed --start --cadence --nominal"
    )
    parser.add_argument("output", type=Path, metavar="OUT.ndjson", help="or OUT.csv")
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=arguments.MISSION)
    parser.add_argument(
        "--batches", required=True, type=arguments.count, metavar="N", help="number of batches"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="default 1")
    parser.add_argument(
        "--start",
        metavar="UTC",
        help="time of the first batch; default 1999-03-01T00:00:00Z, bands 1996-04-16T00:00:00Z",
    )
    parser.add_argument(
        "--cadence", type=float, metavar="S", help="seconds between batches; default 30, bands 300"
    )
    parser.add_argument(
        "--stars",
        type=arguments.count,
        metavar="N",
        help="maximum number of stars per tracker; default 5, of a camera as many as it sends",
    )
    parser.add_argument(
        "--prior",
        choices=("quaternion", "direction", "mixed", "none"),
        help="a priori attitude: full (quaternion), boresight or sun_pointed only (direction), "
        "both kinds (mixed), or none; default quaternion, or none for a mission that is lost in "
        "space",
    )
    _add_errors(parser)
    parser.add_argument(
        "--angles",
        type=float,
        default=0.25,
        metavar="SHARE",
        help="share of stars sent as h_deg, v_deg; default 0.25",
    )
    parser.add_argument(
        "--aberration",
        default="to_correct",
        metavar="WORD[=SHARE],...",
        help="to_correct, applied_upstream, ignore; default to_correct",
    )
    _add_gyro(parser)
    _add_periods(parser)


def _add_errors(parser: Any) -> None:
    errors = parser.add_argument_group("errors of every batch")
    errors.add_argument(
        "--a-priori-error",
        type=arguments.positive,
        metavar="DEG",
        help="largest error of the a priori attitude about each axis, in bands of the pole; "
        "default: the mission's",
    )
    errors.add_argument(
        "--noise",
        type=arguments.positive,
        metavar="ARCSEC",
        help="sigma of positions along each tangent axis; default: that of each tracker",
    )
    errors.add_argument(
        "--false-stars",
        type=int,
        default=0,
        metavar="N",
        help="false stars in place of real ones, per tracker and batch; default 0",
    )
    errors.add_argument(
        "--missing",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="share of the stars in the field that are not reported, from 0 to below 1; default 0",
    )


def _add_periods(parser: Any) -> None:
    serious = parser.add_argument_group(
        "periods with errors",
        "share of the pass with each error, from 0 to 1, and its size",
    )
    preset = serious.add_mutually_exclusive_group()
    preset.add_argument("--nominal", action="store_true", help="no periods with errors")
    preset.add_argument(
        "--serious", action="store_true", help="each kind of error for a tenth of the pass"
    )
    for flag, unit, share, size, text in (
        ("attitude-error", "DEG", "0.1", "10, bands 5", "growing a priori attitude error"),
        ("spurious", "N", "0.1", "1", "false stars in the place of real ones"),
        ("magnitude-error", "MAG", "0", "0.5", "noise of magnitudes (sigma)"),
        ("position-error", "ARCSEC", "0", "12", "noise of positions (sigma per tangent axis)"),
    ):
        name = f"--{flag}-share"
        serious.add_argument(name, type=float, metavar="SHARE", help=f"{text}; default {share}")
        kind: Any = arguments.count if unit == "N" else float
        name = f"--{flag}-{'stars' if unit == 'N' else unit.lower()}"
        serious.add_argument(name, type=kind, metavar=unit, help=f"default {size}")


def _add_gyro(parser: Any) -> None:
    gyro = parser.add_argument_group(
        "gyro", "blocks of gyro samples beside the batches, only in NDJSON files"
    )
    gyro.add_argument(
        "--gyro",
        type=arguments.positive,
        metavar="S",
        help="seconds between samples; the noise is that of the mission's table [gyro]",
    )
    for flag, unit, text in (
        ("gyro-quantum", "ARCSEC", "one count of the gyro"),
        ("gyro-gap", "S", "a gap, which begins after 40 %% of the pass"),
        (
            "clock-step",
            "S",
            "forward step of the trackers' and gyro's clock after 70 %% of the pass",
        ),
    ):
        gyro.add_argument(f"--{flag}", type=float, default=0.0, metavar=unit, help=text)


def _run_telemetry(parsed: Namespace) -> int:
    """Simulate a pass with the real sky: NDJSON (or CSV if the name ends in .csv), with the truth
    in OUT.truth.ndjson.  The same arguments always give the same pass.

    acquire simulate telemetry --spacecraft XTE --batches 2000 --seed 7 xte.ndjson
    acquire simulate telemetry --spacecraft SOHO --batches 300 --seed 1 --nominal soho.csv
    acquire simulate telemetry --spacecraft SWAS --batches 500 --seed 2 --serious swas.ndjson
    acquire simulate telemetry --spacecraft XTE --batches 9 --aberration ignore xte.ndjson
    acquire simulate telemetry --spacecraft XTE --batches 240 --gyro 1 --gyro-gap 90 xte.ndjson
    """
    from service.simulate.telemetry import (
        draw_pass,
        outside_zone,
        truth_path,
        with_gyro,
        write_pass,
    )
    from service.sky.cache import LruCache
    from service.sky.model import SkyModel

    mission, catalog = mission_and_catalog(parsed.spacecraft)
    wanted = _pass_of(parsed, mission)
    gyro = _gyro_of(parsed)
    drawn = draw_pass(mission, SkyModel(catalog, LruCache(64 << 20)), wanted)
    if gyro is not None:
        duration_s = (wanted.batches - 1) * wanted.cadence_of(mission)
        drawn = with_gyro(drawn, mission, gyro, duration_s, wanted.seed)
    outside = 0

    def counted() -> "Iterator[DrawnBatch]":
        nonlocal outside
        for each in drawn:
            outside += outside_zone(mission, each)
            yield each

    written = write_pass(counted(), parsed.output)
    print(
        f"{parsed.output}: {written} batches of {mission.name}; truth: {truth_path(parsed.output)}"
    )
    print(f"drawn: {_drawn_text(wanted, mission)}")
    if outside:
        print(
            f"warning: in {100 * outside / written:.1f} % of the batches the a priori error takes "
            "a field of view beyond the mission's zone, where stars at its edge stay unmatched",
            file=sys.stderr,
        )
    return 0


def _drawn_text(wanted: "Pass", mission: "Mission") -> str:
    """Simulated errors of a pass, in one line of text."""
    if wanted.prior == "none":
        parts = ["no a priori attitude"]
    else:
        of = "the pole" if mission.zone.kind == "band" else "each axis"
        parts = [f"a priori error up to {wanted.error_deg_of(mission):.3g} deg about {of}"]
    noises = {
        (wanted.noise_arcsec or each.sigma_arcsec, each.magnitude_sigma_mag)
        for each in mission.trackers
    }
    parts += [f"noise {arcsec:.3g} arcsec and {mag:g} mag" for arcsec, mag in sorted(noises)]
    if wanted.false_stars:
        parts.append(f"{wanted.false_stars} false stars per tracker")
    if wanted.missing_share:
        parts.append(f"{100 * wanted.missing_share:g} % of the stars missing")
    kinds = Counter(each.kind for each in wanted.stretches(mission))
    for kind, count in sorted(kinds.items()):
        if kind != "nominal":
            share = 100 * count / wanted.batches
            parts.append(f"{kind.replace('_', ' ')} in {share:.0f} % (--nominal: none)")
    return ", ".join(parts)


def _gyro_of(parsed: Namespace) -> "GyroWanted | None":
    from service.observations.input_formats import NDJSON, telemetry_format
    from service.simulate.telemetry import GyroWanted

    flaws = parsed.gyro_quantum, parsed.gyro_gap, parsed.clock_step
    if parsed.gyro is None:
        if any(flaws):
            raise BadInput(Fault("--gyro", "is missing: without it there is no gyro"))
        return None
    if telemetry_format(parsed.output) != NDJSON:
        raise BadInput(Fault("--gyro", "needs NDJSON: a CSV file has batches or gyro samples"))
    return GyroWanted(parsed.gyro, *flaws)


def _pass_of(parsed: Namespace, mission: "Mission") -> "Pass":
    """Parameters of a simulated pass from the options; raises `BadInput` for impossible ones."""
    from service.simulate.stretches import Pass, Trouble, Troubles, usual_stars

    troubles = {}
    for kind, size_name in _SIZES.items():
        usual: Trouble = getattr(Troubles(), kind)
        size, share = getattr(parsed, size_name), getattr(parsed, f"{kind}_share")
        if share is None:
            # A size alone also requests the trouble.
            asked = parsed.serious or size is not None
            share = 0.0 if parsed.nominal else max(usual.share, _SERIOUS_SHARE * asked)
        troubles[kind] = Trouble(share, usual.size if size is None else size)
    return Pass(
        batches=parsed.batches,
        seed=parsed.seed,
        start=parsed.start,
        cadence_s=parsed.cadence,
        stars=parsed.stars or usual_stars(mission),
        prior=parsed.prior or ("quaternion" if mission.knows_attitude else "none"),
        a_priori_error_deg=parsed.a_priori_error,
        noise_arcsec=parsed.noise,
        false_stars=parsed.false_stars,
        missing_share=parsed.missing,
        angles_share=parsed.angles,
        aberration=_shares(parsed.aberration),
        troubles=Troubles(**troubles),
    )


def _shares(text: str) -> "dict[Aberration, float]":
    """Parse words with shares, as in `to_correct=0.5,ignore=0.5`; a single word has share 1."""
    shares: dict[str, float] = {}
    for part in text.split(","):
        word, _, share = part.partition("=")
        try:
            shares[word.strip()] = float(share) if share else 1.0
        except ValueError:
            message = "must be a word, or words with shares such as to_correct=0.5,ignore=0.5"
            raise BadInput(Fault("--aberration", message, shown_value(text))) from None
    return cast("dict[Aberration, float]", shares)
