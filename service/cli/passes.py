"""A pass of sample telemetry as arguments of the command."""

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from service.cli.checks import count
from service.errors import BadInput, Fault, shown_value

if TYPE_CHECKING:
    from service.observe.batch import Aberration
    from service.simulate.stretches import Pass

MISSION = "XTE, SWAS, SOHO, or one of your own"


def add_pass_arguments(parser: ArgumentParser) -> None:
    """Let a parser take what `pass_of` needs."""
    add = parser.add_argument
    add("output", type=Path, metavar="OUT.ndjson")
    add("--spacecraft", required=True, metavar="NAME", help=MISSION)
    add("--batches", required=True, type=count, metavar="N")
    add("--seed", type=int, default=1, metavar="S", help="default 1")
    add("--start", metavar="UTC", help="of the first batch; default 1999-03-01, bands 1996-04-16")
    add("--cadence", type=float, metavar="S", help="seconds between batches; default 30, bands 300")
    add("--stars", type=count, default=5, metavar="N", help="most stars a tracker; default 5")
    add(
        "--prior",
        choices=("quaternion", "direction", "mixed"),
        default="quaternion",
        help="a priori attitude: whole, boresight or sun_pointed only, or either",
    )
    add(
        "--angles",
        type=float,
        default=0.25,
        metavar="SHARE",
        help="sent as h_deg, v_deg; default 0.25",
    )
    add(
        "--aberration",
        default="to_correct",
        metavar="WORD[=SHARE],...",
        help="to_correct, applied_upstream, ignore; default to_correct",
    )
    serious = parser.add_argument_group(
        "stretches of errors",
        "shares of the pass, from 0 to 1, and how large; all else is nominal",
    )
    preset = serious.add_mutually_exclusive_group()
    preset.add_argument("--nominal", action="store_true", help="none at all")
    preset.add_argument("--serious", action="store_true", help="a tenth of the pass for each kind")
    for flag, unit, share, size, text in (
        ("attitude-error", "DEG", "0.1", "10, bands 5", "growing a priori attitude error"),
        ("spurious", "N", "0.1", "1", "false stars in the place of real ones"),
        ("magnitude-error", "MAG", "0", "0.5", "standard deviation of magnitudes"),
        ("position-error", "ARCSEC", "0", "12", "standard deviation per tangent axis"),
    ):
        name = f"--{flag}-share"
        serious.add_argument(name, type=float, metavar="SHARE", help=f"{text}; default {share}")
        kind: Any = count if unit == "N" else float
        name = f"--{flag}-{'stars' if unit == 'N' else unit.lower()}"
        serious.add_argument(name, type=kind, metavar=unit, help=f"default {size}")


_SIZES = {
    "attitude_error": "attitude_error_deg",
    "spurious": "spurious_stars",
    "magnitude_error": "magnitude_error_mag",
    "position_error": "position_error_arcsec",
}
_SERIOUS_SHARE = 0.1


def pass_of(parsed: Namespace) -> "Pass":
    """The pass that was asked for; raises `BadInput` for one that cannot be."""
    from service.simulate.stretches import Pass, Trouble, Troubles

    troubles = {}
    for kind, size_name in _SIZES.items():
        usual: Trouble = getattr(Troubles(), kind)
        size, share = getattr(parsed, size_name), getattr(parsed, f"{kind}_share")
        if share is None:
            # A size alone asks for the stretch, too.
            asked = parsed.serious or size is not None
            share = 0.0 if parsed.nominal else max(usual.share, _SERIOUS_SHARE * asked)
        troubles[kind] = Trouble(share, usual.size if size is None else size)
    return Pass(
        batches=parsed.batches,
        seed=parsed.seed,
        start=parsed.start,
        cadence_s=parsed.cadence,
        stars=parsed.stars,
        prior=parsed.prior,
        angles_share=parsed.angles,
        aberration=_shares(parsed.aberration),
        troubles=Troubles(**troubles),
    )


def _shares(text: str) -> "dict[Aberration, float]":
    """Words with their shares, as in `to_correct=0.5,ignore=0.5`; a word alone has all."""
    shares: dict[str, float] = {}
    for part in text.split(","):
        word, _, share = part.partition("=")
        try:
            shares[word.strip()] = float(share) if share else 1.0
        except ValueError:
            message = "must be a word, or words with shares such as to_correct=0.5,ignore=0.5"
            raise BadInput(Fault("--aberration", message, shown_value(text))) from None
    return cast("dict[Aberration, float]", shares)
