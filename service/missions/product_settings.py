"""Settings of attitude files for a spacecraft: its identifiers, its clock, its largest gap."""

import re
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, PlainSerializer, ValidationInfo, field_validator, model_validator

from service.missions.strict import Strict

DEFAULT_LARGEST_GAP_S = 60.0
MAX_LARGEST_GAP_S = 86_400.0
DEFAULT_NAIF_ID = -999
MIN_NAIF_ID = -2_000_000
"""Least NAIF id of a spacecraft: instrument ids add three digits and must fit into 32 bits."""
OBJECT_ID = r"[A-Za-z0-9][A-Za-z0-9 ._+/-]{0,63}"
MAX_KERNEL_BYTES = 16 << 20


class ProductSettings(Strict):
    """A mission file's table `[products]` with settings of attitude files; all have defaults."""

    largest_gap_s: float = Field(default=DEFAULT_LARGEST_GAP_S, gt=0, le=MAX_LARGEST_GAP_S)
    """Largest interval in seconds between attitudes of one segment of a file.

    By default, the value for raw attitudes follows their cadence: see the feature `products`.
    """
    object_id: str | None = Field(default=None, pattern=f"^{OBJECT_ID}$")
    """The OBJECT_ID of CCSDS messages; None for the name of the mission."""
    naif_id: int = Field(default=DEFAULT_NAIF_ID, ge=MIN_NAIF_ID, lt=0)
    """The NAIF id of the spacecraft; the default belongs to no spacecraft."""
    sclk_kernel: Annotated[Path, PlainSerializer(lambda path: path.name)] | None = None
    """The SPICE SCLK file of the spacecraft's clock, relative to the mission's file."""

    @property
    def names_gap(self) -> bool:
        """True if the mission file has the key `largest_gap_s`."""
        return "largest_gap_s" in self.model_fields_set

    @field_validator("sclk_kernel")
    @classmethod
    def _lies_beside_the_file(cls, path: Path | None, info: ValidationInfo) -> Path | None:
        return path if path is None or info.context is None else info.context["folder"] / path

    @model_validator(mode="after")
    def _clock_is_the_spacecraft_s(self) -> Self:
        if self.sclk_kernel is None:
            return self
        if "naif_id" not in self.model_fields_set:
            raise ValueError("sclk_kernel needs naif_id, the spacecraft whose clock it is")
        text = _text_of_kernel(self.sclk_kernel)
        if not re.search(rf"^\s*SCLK_DATA_TYPE_{-self.naif_id}\b", text, re.MULTILINE):
            raise ValueError(
                f"sclk_kernel: {self.sclk_kernel} describes no clock of {self.naif_id}: "
                f"it has no SCLK_DATA_TYPE_{-self.naif_id}"
            )
        return self


def beside(file: str) -> dict[str, Path]:
    """A validation context in which paths are relative to the folder of a file."""
    return {"folder": Path(file).parent}


def _text_of_kernel(path: Path) -> str:
    """The text of a SPICE clock kernel; raises `ValueError` naming the file."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_KERNEL_BYTES + 1)
    except OSError as error:
        raise ValueError(f"sclk_kernel: {path}: cannot be read: {error.strerror}") from None
    if len(data) > MAX_KERNEL_BYTES:
        raise ValueError(f"sclk_kernel: {path}: larger than {MAX_KERNEL_BYTES >> 20} MiB")
    if not data.startswith(b"KPL/SCLK"):
        raise ValueError(f"sclk_kernel: {path}: not a clock kernel: it must begin with KPL/SCLK")
    return data.decode(errors="replace")


DEFAULT_PRODUCTS = ProductSettings()
