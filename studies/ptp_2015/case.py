"""A condition of the comparison: how noisy its fields are, and which algorithms see them."""

from dataclasses import dataclass

from service.simulate.scenes import Conditions

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
