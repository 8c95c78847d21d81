"""Run catalogs and sightings of a handful of stars, for cases that are counted by hand."""

import numpy as np

from service.identify.sighting import Sighting
from service.identify.voting.starid import identify_by_votes
from service.missions.mission import Tests, Tolerances, rules_of
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.zones import SearchRegion, build_zone
from service.vectors import from_ra_dec, to_ra_dec, unit
from tests.reference.sightings import identified

TOLERANCES = Tolerances(
    pair_separation_max_deg=8.0,
    separation_deg=0.0066,
    magnitude_mag=0.6,
    magnitude_order_mag=0.5,
    cross_product_deg=90.0,
)
ALL_OFF = Tests(magnitude=False, cross_product=False, pole=False)


def run_catalog(directions, magnitudes):
    """Stars named by their place in the arguments, brightest first as in every run catalog."""
    order = np.argsort(magnitudes, kind="stable")
    ra_deg, dec_deg = to_ra_dec(unit(directions)[order])
    return RunCatalog(
        epoch_year=2000.0,
        ra_deg=ra_deg,
        dec_deg=dec_deg,
        magnitude_mag=np.array(magnitudes, float)[order],
        catalog_row=order,
        motion=np.zeros((len(order), 3)),
        parallax_rad=np.zeros(len(order)),
        star_id=tuple(f"STAR {k}" for k in order),
        rejected=(),
        digest=f"sha256:{hash(np.asarray(directions, float).tobytes())}",
    )


def at(*places):
    """Unit vectors at (right ascension, declination) in degrees."""
    return from_ra_dec([p[0] for p in places], [p[1] for p in places])


def cap(axis=(1.0, 0.0, 0.0), radius_deg=10.66):
    return SearchRegion("cap", unit(axis), 0.0, radius_deg)


def band(axis=(0.0, 0.0, 1.0), coelevation_deg=90.0, half_width_deg=5.0):
    return SearchRegion(
        "band", unit(axis), coelevation_deg - half_width_deg, coelevation_deg + half_width_deg
    )


def sighting(observed, magnitudes, region, zone, tests, limits=TOLERANCES):
    """What the identifier is given of inertial vectors; the presumed attitude is known whole."""
    aside = np.eye(3)[int(np.argmin(np.abs(region.axis)))]
    across = np.cross(region.axis, aside)
    return Sighting(
        direction=np.ascontiguousarray(observed),
        magnitude_mag=np.array([np.nan if m is None else m for m in magnitudes], float),
        sigma_rad=np.full(len(observed), 1e-5),
        known_axis=None,
        velocity_c=np.zeros(3),
        boresight=region.axis if region.kind == "cap" else across / np.linalg.norm(across),
        region=region,
        zone=zone,
        rules=rules_of(limits, tests),
    )


def identify(catalog, observed, magnitudes, region=None, tests=None, **tolerances):
    """The identification of inertial vectors in the exact zone."""
    region = region or cap()
    limits = TOLERANCES.model_copy(update=tolerances)
    zone = build_zone("SMALL", catalog, region, limits.pair_separation_max_deg)
    tests = tests or Tests(pole=region.kind == "band")
    seen = sighting(observed, magnitudes, region, zone, tests, limits)
    return identified(identify_by_votes, seen, weighs=False)


def named(identification, catalog):
    """Per star: outcome, identity or rivals, votes, runner-up."""
    return [
        (
            ("unmatched", "unique", "ambiguous")[int(outcome)],
            catalog.star_id[star]
            if star >= 0
            else tuple(catalog.star_id[r] for r in rivals) or None,
            int(votes),
            int(runner_up),
        )
        for outcome, star, votes, runner_up, rivals in zip(
            identification.outcome,
            identification.star,
            identification.votes,
            identification.runner_up,
            identification.rivals,
            strict=True,
        )
    ]
