"""The identifier `ptp`: planar triangles found by their principal component, with no prior.

Each observed star makes triangles with its nearest neighbours.  Their
projections find guide triangles, their sides choose among these, and their
votes order the proposals (Zhou & Ye 2015, sections 2.1 and 2.2).  The attitude
check decides.  It replaces the paper's validation by sharing stars (2.3), which
accepts a mirrored sky; `Proposals.validated` gives that for comparison.

The a priori attitude is not asked: observed vectors may be in any axes.
Magnitudes are not used either.
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
"""No star is taken as better known: the catalog serves a year, and parallax is left out."""

Rows = npt.NDArray[np.int32]


def identify_ptp(sighting: Sighting) -> Identification:
    """Identify the stars of one tracker, whatever the a priori attitude says of them.

    Raises `ValueError` for a sighting that was given no guide database.
    """
    if sighting.guide is None:
        raise ValueError("ptp needs the sighting's guide database")
    return identify_triangles(
        sighting.direction, sighting.sigma_rad, sighting.velocity_c, sighting.guide
    )


def identify_triangles(
    direction: Vector, sigma_rad: Vector, velocity_c: Vector, guide: Guide
) -> Identification:
    """Identify stars given as unit vectors (n, 3) in any axes.

    Sigma is one standard deviation per tangent axis, `velocity_c` the observer's
    in catalog axes, zero where aberration is not in the vectors.  Where the
    attitude check finds nothing to believe every star is unmatched, whatever
    its votes, which are distinct triangles that name the star alike.
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
    """What triangles say: pairs of an observed star and a catalog row, the most votes first.

    `held`: a sharing star validates a triangle that says so.  `searched` is how
    many guide triangles were looked at; `bounded` that more matched than are kept.
    """

    image: Rows
    star: Rows
    votes: Rows
    held: npt.NDArray[np.bool_]
    searched: int
    bounded: bool

    def validated(self, n: int) -> Rows:
        """The row that the sharing-star validation gives each of n stars, -1 for none."""
        match = np.empty(n, np.int32)
        validate(self.image, self.star, self.votes, self.held, match)
        return match


def propose(
    direction: Vector, sigma_rad: Vector, speed_c: float, triangles: TriangleIndex, stars: int
) -> Proposals:
    """Match the triangles of observed stars, and count what their corners say.

    `speed_c` is the observer's, `stars` the length of the star list.
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
    """All stars under the attitude that proposals lead to, from any source.

    Proposals are pairs of a row of `direction` and of the guide, the likeliest
    first.  Gives each star the catalog row that it lies on and a second one that
    it might lie on as well, -1 for none; -1 throughout where no attitude is
    believed, nor one of a field that a mirror shows as well.
    """
    match, rival = np.full((2, len(direction)), -1, np.int32)
    scene = scene_of(direction, sigma_rad, velocity_c, guide)
    believed = check_attitude(*scene, guide.density, image, star, match, rival, np.empty((3, 3)))
    matched = int((match >= 0).sum())
    if believed and len(match) - matched >= 2:
        # Stars that lie alike on both sides of a line stand in a mirror too, all others do not.
        scene = scene_of(direction * IN_A_MIRROR, sigma_rad, velocity_c, guide)
        seen, other = np.full((2, len(direction)), -1, np.int32)
        if check_attitude(*scene, guide.density, image, star, seen, other, np.empty((3, 3))):
            believed = int((seen >= 0).sum()) < matched
    if not believed:
        match[:] = rival[:] = -1
    return match, rival


def observed_triangles(direction: Vector, triangles: TriangleIndex) -> tuple[Rows, Vector]:
    """The triangles of observed stars, chosen as those of the guide: rows (t, 3), sides (t, 3)."""
    near = np.empty((len(direction), triangles.slaves), np.int32)
    nearest_slaves(direction, *chords(triangles.reach_deg), near)
    most = len(direction) * len(pairs_of_slaves(triangles.slaves))
    image, side = np.empty((most, 3), np.int32), np.empty((most, 3))
    count = make_triangles(direction, near, image, side)
    return image[:count], side[:count]


def scene_of(
    direction: Vector, sigma_rad: Vector, velocity_c: Vector, guide: Guide
) -> tuple[ObservedStars, ZoneStars]:
    """Observed and guide stars as the kernels of the fit take them; no prior, no magnitudes."""
    reference_sigma = float(sigma_rad.min()) if len(sigma_rad) else 1.0
    nothing = np.empty(0)
    observed = ObservedStars(
        direction=locked(direction),
        magnitude=nothing,
        sigma_rad=locked(sigma_rad),
        weight=(reference_sigma / sigma_rad) ** 2,
        reference_sigma=reference_sigma,
        velocity=locked(velocity_c),
        prior_kind=0,
        prior_axis=np.zeros(3),
    )
    stars = ZoneStars(
        direction=guide.direction,
        magnitude=nothing,
        grid_start=guide.grid.start,
        grid_rows=guide.grid.rows,
        grid_direction=guide.grid.direction,
        voxels=np.empty((0, 0), np.uint8),
        axis=np.zeros(3),
        least=0.0,
        most=math.pi,
        polar=nothing,
        log_density=0.0,
    )
    return observed, stars


def _tallies(n: int, proposals: Proposals) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Each star's highest and second-highest tally; equal in a tie."""
    highest, second = np.zeros((2, n), np.int64)
    for k, tally in zip(proposals.image.tolist(), proposals.votes.tolist(), strict=True):
        if highest[k] == 0:
            highest[k] = tally
        elif second[k] == 0:
            second[k] = tally
    return highest, second
