"""The identifier `ptp`: planar triangles looked up by their principal component, without a prior.

Each observed star makes triangles with its nearest neighbours. Guide triangles are looked up by
projection, selected by sides, and their votes rank the proposed identities (Zhou & Ye 2015,
sections 2.1 and 2.2). The attitude check decides. It replaces the paper's validation by sharing
stars (2.3), which accepts a mirrored sky; `Proposals.validated` implements the paper's for
comparison.

The a priori attitude and the magnitudes are not used: observed vectors may be in any axes.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.identify.hypotheses.scene import ObservedStars, ZoneStars
from service.identify.identification import Identification, Outcome
from service.identify.sighting import Sighting
from service.identify.triangles.attitude_check import check_attitude
from service.identify.triangles.triangle_match import (
    MAX_MATCHES,
    ImageTriangles,
    count_pairs,
    guide_triangles,
    match_triangles,
    validate,
)
from service.sky.geometry.triangles import (
    TriangleIndex,
    chords,
    make_triangles,
    nearest_slaves,
    pairs_of_slaves,
)
from service.sky.whole_sky.guide import Guide
from service.vectors import ARCSEC_PER_RADIAN, Vector, locked

IN_A_MIRROR = np.array([-1.0, 1.0, 1.0])
SIGMA_FLOOR_ARCSEC = 1.0
"""Least position sigma of a star in arcsec: the guide serves a year and leaves parallax out."""

Rows = npt.NDArray[np.int32]


def identify_ptp(sighting: Sighting) -> Identification:
    """Identify the stars of one tracker by planar triangles, ignoring the a priori attitude.

    Raises `ValueError` for a sighting without a guide database.
    """
    if sighting.guide is None:
        raise ValueError("ptp needs the sighting's guide database")
    return identify_triangles(
        sighting.direction, sighting.sigma_rad, sighting.velocity_c, sighting.guide
    )


def identify_triangles(
    direction: Vector, sigma_rad: Vector, velocity_c: Vector, guide: Guide
) -> Identification:
    """Identify stars, given as unit vectors (n, 3) in any axes, by planar triangles.

    Sigma is one standard deviation per tangent axis, `velocity_c` the observer's in catalog axes,
    zero if the vectors are without aberration. If the attitude check fails, every star is
    unmatched, whatever its votes, which count distinct triangles with the same identity for the
    star.
    """
    n = len(direction)
    sigma_rad = np.maximum(sigma_rad, SIGMA_FLOOR_ARCSEC / ARCSEC_PER_RADIAN)
    speed_c = math.sqrt(float(velocity_c @ velocity_c))
    proposals = propose(direction, sigma_rad, speed_c, guide.triangles, len(guide.direction))
    match, rival = explained(
        direction, sigma_rad, velocity_c, guide, proposals.image, proposals.star
    )
    outcome = np.where(
        rival >= 0,
        int(Outcome.AMBIGUOUS),
        np.where(match >= 0, int(Outcome.UNIQUE), int(Outcome.UNMATCHED)),
    )
    highest, second = _tallies(n, proposals)
    return Identification(
        outcome=outcome,
        star=np.where(outcome == Outcome.UNIQUE, match, -1).astype(np.int64),
        votes=highest,
        runner_up=second,
        rivals=tuple(
            tuple(sorted({one, other} - {-1})) if other >= 0 else ()
            for one, other in zip(match.tolist(), rival.tolist(), strict=True)
        ),
        probability=np.full(n, np.nan),
        bounded=proposals.bounded,
    )


@dataclass(frozen=True)
class Proposals:
    """Proposed identities from triangle votes: (observed star, catalog row), most votes first.

    `held`: a sharing star validates a triangle with the identity. `searched` is the number of guide
    triangles compared; `bounded` is true if more matched than can be kept.
    """

    image: Rows
    star: Rows
    votes: Rows
    held: npt.NDArray[np.bool_]
    searched: int
    bounded: bool

    def validated(self, n: int) -> Rows:
        """Catalog row of each of n stars by the paper's sharing-star validation, -1 for none."""
        match = np.empty(n, np.int32)
        validate(self.image, self.star, self.votes, self.held, match)
        return match


def propose(
    direction: Vector, sigma_rad: Vector, speed_c: float, triangles: TriangleIndex, stars: int
) -> Proposals:
    """Match triangles of observed stars to guide triangles, and count votes for star identities.

    `speed_c` is the observer's speed, `stars` the length of the star list.
    """
    image, side = observed_triangles(direction, triangles)
    matched = np.empty((2, MAX_MATCHES), np.int32)
    field = ImageTriangles(locked(direction), locked(sigma_rad), speed_c, image, side)
    count, searched, bounded = match_triangles(field, guide_triangles(triangles), *matched)
    pairs, held = np.empty((3, 3 * count), np.int32), np.empty(3 * count, np.bool_)
    kept = 0
    if count:
        triple, found = image[matched[0, :count]], triangles.star[matched[1, :count]]
        kept = count_pairs(triple, found, stars, pairs[0], pairs[1], pairs[2], held)
    named, star, votes = pairs[:, :kept]
    return Proposals(named, star, votes, held[:kept], searched, bounded)


def explained(
    direction: Vector, sigma_rad: Vector, velocity_c: Vector, guide: Guide, image: Rows, star: Rows
) -> tuple[Rows, Rows]:
    """Identities of all stars under the attitude derived from proposed identities.

    Proposals from any source are pairs of a row of `direction` and a row of the guide, most likely
    first. Returns the catalog row of each star and a second possible row, -1 for none; all are -1
    if no attitude is believed, or if the mirrored field matches as well.
    """
    match, rival = np.full((2, len(direction)), -1, np.int32)
    scene = scene_of(direction, sigma_rad, velocity_c, guide)
    believed = check_attitude(*scene, guide.density, image, star, match, rival, np.empty((3, 3)))
    matched = int((match >= 0).sum())
    if believed and len(match) - matched >= 2:
        # Stars symmetric about a line match a mirrored sky too, but all others do not.
        scene = scene_of(direction * IN_A_MIRROR, sigma_rad, velocity_c, guide)
        seen, other = np.full((2, len(direction)), -1, np.int32)
        if check_attitude(*scene, guide.density, image, star, seen, other, np.empty((3, 3))):
            believed = int((seen >= 0).sum()) < matched
    if not believed:
        match[:] = rival[:] = -1
    return match, rival


def observed_triangles(direction: Vector, triangles: TriangleIndex) -> tuple[Rows, Vector]:
    """Triangles of observed stars, built like those of the guide: rows (t, 3) and sides (t, 3)."""
    near = np.empty((len(direction), triangles.slaves), np.int32)
    nearest_slaves(direction, *chords(triangles.reach_deg), near)
    most = len(direction) * len(pairs_of_slaves(triangles.slaves))
    image, side = np.empty((most, 3), np.int32), np.empty((most, 3))
    count = make_triangles(direction, near, image, side)
    return image[:count], side[:count]


def scene_of(
    direction: Vector, sigma_rad: Vector, velocity_c: Vector, guide: Guide
) -> tuple[ObservedStars, ZoneStars]:
    """Observed and guide stars in the form of the fit's kernels, without prior or magnitudes.

    Locked are those arrays that a zone locks: the fit is compiled for that alone.
    """
    reference_sigma = float(sigma_rad.min()) if len(sigma_rad) else 1.0
    nothing = np.empty(0)
    observed = ObservedStars(
        direction=np.array(direction, order="C"),
        magnitude=nothing,
        sigma_rad=np.array(sigma_rad),
        weight=(reference_sigma / sigma_rad) ** 2,
        reference_sigma=reference_sigma,
        velocity=np.array(velocity_c),
        prior_kind=0,
        prior_axis=np.zeros(3),
    )
    stars = ZoneStars(
        direction=guide.direction,
        magnitude=locked(nothing),
        grid_start=guide.grid.start,
        grid_rows=guide.grid.rows,
        grid_direction=guide.grid.direction,
        voxels=locked(np.empty((0, 0), np.uint8)),
        axis=np.zeros(3),
        least=0.0,
        most=math.pi,
        polar=nothing,
        log_density=0.0,
    )
    return observed, stars


def _tallies(n: int, proposals: Proposals) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The highest and second-highest numbers of votes of each star; equal in a tie."""
    highest, second = np.zeros((2, n), np.int64)
    for k, tally in zip(proposals.image.tolist(), proposals.votes.tolist(), strict=True):
        if highest[k] == 0:
            highest[k] = tally
        elif second[k] == 0:
            second[k] = tally
    return highest, second
