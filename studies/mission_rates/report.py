"""The rates of a sweep as a table, as plain values, and the settings that meet a wanted rate."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from service.advice.intervals import Interval
from studies.documents import markdown
from studies.mission_rates.settings import sigobs_arcsec
from studies.mission_rates.simulation import OUTCOMES, Plan, Rates

TITLES = {name: name.replace("_", " ") for name in OUTCOMES}


def meeting(rates: Sequence[Rates], at_most_ambiguous: float) -> list[Rates]:
    """The settings whose share of ambiguous stars is at most a share with 95 % confidence.

    Those with the most stars identified rightly come first.
    """
    found = [each for each in rates if each.ambiguous.high <= at_most_ambiguous]
    return sorted(found, key=lambda each: -each.unique_right.value)


def report_text(plan: Plan, rates: Sequence[Rates], at_most_ambiguous: float | None) -> str:
    """The report for people."""
    lines = [*heading(plan), "", _table(rates)]
    if at_most_ambiguous is not None:
        lines += ["", *met(rates, at_most_ambiguous)]
    return "\n".join(lines)


def heading(plan: Plan) -> list[str]:
    """The description of the simulation, in lines."""
    first = plan.settings[0]
    mission, errors = first.mission, first.errors
    where = "the whole sky"
    if plan.direction_deg is not None:
        ra_deg, dec_deg = plan.direction_deg
        where = f"{plan.within_deg:g} deg about RA {ra_deg:g}, Dec {dec_deg:g} deg"
    statements = {
        "phi_deg": f"phi {errors.phi_deg:g} deg",
        "theta_deg": f"theta {errors.theta_deg:g} deg",
        "psi_deg": f"psi {errors.psi_deg:g} deg",
        "off_axis_deg": f"off axis to {errors.off_axis_deg:g} deg",
        "position_error_arcsec": (
            f"position {errors.position_error_arcsec:.4g} arcsec per axis "
            f"(SIGOBS {sigobs_arcsec(errors):.4g})"
        ),
        "magnitude_error_mag": f"magnitude {errors.magnitude_error_mag:g} mag",
    }
    unswept = [text for name, text in statements.items() if name not in first.values]
    switched = [f"{name} {'on' if is_on else 'off'}" for name, is_on in plan.tests.items()]
    lines = [
        (
            f"{mission.name}, {mission.trackers[0].name}, by {plan.identifier}: {plan.zones} zones "
            f"of {where}, {plan.views} views each, at most {plan.most_stars} stars a view, "
            f"seed {plan.seed}"
        ),
        "Errors that are not swept: " + ("; ".join(unswept) or "none"),
    ]
    return [*lines, "Tests: " + ", ".join(switched)] if switched else lines


def _table(rates: Sequence[Rates]) -> str:
    names = list(rates[0].setting.values)
    header = [*names, "stars", *(f"{title} %" for title in TITLES.values())]
    rows = []
    for each in rates:
        values = [f"{each.setting.values[name]:g}" for name in names]
        shares = [_percent(getattr(each, name)) for name in OUTCOMES]
        rows.append([*values, str(each.stars), *shares])
    return markdown(header, rows) + "\nIn brackets: 95 % intervals."


def _percent(share: Interval) -> str:
    return f"{100 * share.value:.2f} ({100 * share.low:.2f} to {100 * share.high:.2f})"


def met(rates: Sequence[Rates], at_most_ambiguous: float) -> list[str]:
    """The settings that keep ambiguous stars below a share, in lines."""
    wanted = f"At most {100 * at_most_ambiguous:g} % ambiguous"
    found = meeting(rates, at_most_ambiguous)
    if found:
        lines = [f"{wanted}, with 95 % confidence, most rightly identified stars first:"]
        lines += [
            f"  {_values(each)}: {_percent(each.ambiguous)} % ambiguous, "
            f"{_percent(each.unique_right)} % unique and right"
            for each in found
        ]
    else:
        lines = [f"{wanted}: no setting, with 95 % confidence."]
    open_ = [
        each for each in rates if each.ambiguous.value <= at_most_ambiguous < each.ambiguous.high
    ]
    if open_:
        settings = "; ".join(_values(each) for each in open_)
        lines.append(f"Not decided by so few stars (raise --stars): {settings}")
    return lines


def _values(each: Rates) -> str:
    values = each.setting.values.items()
    return ", ".join(f"{name}={value:g}" for name, value in values) or "the mission's settings"


def report_json(
    plan: Plan, rates: Sequence[Rates], at_most_ambiguous: float | None
) -> dict[str, Any]:
    """The report as plain values; rates are shares from 0 to 1 with 95 % intervals."""
    first = plan.settings[0]
    mission = first.mission
    met = None if at_most_ambiguous is None else meeting(rates, at_most_ambiguous)
    return {
        "mission": mission.name,
        "tracker": mission.trackers[0].name,
        "identifier": plan.identifier,
        "tests": first.mission.tests.model_dump(),
        "direction_deg": plan.direction_deg,
        "within_deg": plan.within_deg,
        "zones": plan.zones,
        "views": plan.views,
        "most_stars": plan.most_stars,
        "seed": plan.seed,
        "settings": [_setting_json(each) for each in rates],
        "at_most_ambiguous": at_most_ambiguous,
        "meeting": None if met is None else [dict(each.setting.values) for each in met],
    }


def _setting_json(each: Rates) -> dict[str, Any]:
    return {
        "swept": dict(each.setting.values),
        "errors": asdict(each.setting.errors),
        "tolerances": each.setting.mission.tolerances.model_dump(),
        "stars": each.stars,
        **{name: asdict(getattr(each, name)) for name in OUTCOMES},
    }
