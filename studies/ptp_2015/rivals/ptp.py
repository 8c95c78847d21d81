"""PTP as the comparison takes it: the service's own triangles, its sharing stars for an answer."""

from dataclasses import dataclass

from service.identify.triangles.ptp import propose
from service.simulate.scenes import Scene
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.geometry.triangles import REACH_DEG, SLAVES, TriangleIndex, build_triangles
from studies.ptp_2015.rivals.proposed import Proposed


@dataclass(frozen=True)
class Ptp:
    """The guide triangles."""

    triangles: TriangleIndex
    stars: int

    @property
    def entries(self) -> int:
        """Triangles: five of a star with four slaves."""
        return self.triangles.count

    @property
    def nbytes(self) -> int:
        """Bytes of triangles and k-vector."""
        return self.triangles.nbytes

    def identify(self, scene: Scene) -> Proposed:
        """What sharing stars validate, without the attitude check behind it."""
        proposals = propose(scene.direction, scene.sigma_rad, 0.0, self.triangles, self.stars)
        match = proposals.validated(len(scene.direction))
        return Proposed(match, proposals.image, proposals.star)


def build_ptp(stars: RunCatalog, slaves: int = SLAVES) -> Ptp:
    """The guide triangles of a star list, with so many slaves to a master."""
    return Ptp(build_triangles(stars.direction, REACH_DEG, slaves), len(stars))
