"""The base class of a mission file's tables: no unknown keys, no NaN, no infinity."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict

Components = tuple[float, float, float]


def _has_direction(vector: Components) -> Components:
    if math.hypot(*vector) <= 1e-6:
        raise ValueError("has no direction: give a unit vector")
    return vector


Direction = Annotated[Components, AfterValidator(_has_direction)]


AXIS_NAMES = ("x_axis_body", "y_axis_body", "z_axis_body")


def require_right_handed(*axes: Components) -> None:
    """Raise `ValueError` unless an instrument's axes X, Y, Z are right-handed and orthonormal."""
    matrix = np.column_stack(axes)
    products = matrix.T @ matrix
    if np.allclose(products, np.eye(3), atol=1e-4) and np.linalg.det(matrix) > 0:
        return
    norms = np.sqrt(np.diag(products))
    for first, second in (0, 2), (0, 1), (1, 2):
        cosine = products[first, second] / max(norms[first] * norms[second], 1e-12)
        if norms.min() > 0.0 and abs(cosine) > 1e-4:
            angle_deg = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
            raise ValueError(
                f"{AXIS_NAMES[first]} and {AXIS_NAMES[second]} must be at right angles, not at "
                f"{angle_deg:.4g} deg, such as [1.0, 0.0, 0.0] and [0.0, 0.0, 1.0]"
            )
    for name, norm in zip(AXIS_NAMES, norms.tolist(), strict=True):
        if abs(norm - 1.0) > 5e-5:
            example = "must be a unit vector, such as [1.0, 0.0, 0.0]"
            raise ValueError(f"{name} {example}; its norm is {norm:.6g}")
    raise ValueError(
        "the three axes must be right-handed: y_axis_body must be the cross product of z_axis_body "
        "and x_axis_body"
    )


class Strict(BaseModel):
    """An immutable table of settings that refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=False)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """A copy with some values replaced, without values cached from the old ones."""
        copied = super().model_copy(update=update, deep=deep)
        for name in vars(copied).keys() - type(self).model_fields.keys():
            del vars(copied)[name]
        return copied

    def __getstate__(self) -> dict[Any, Any]:
        """The pickled state: the table's values, without values cached from them.

        A cached array would become writable in another process, and kernels would compile anew for
        it.
        """
        state = super().__getstate__()
        fields = type(self).model_fields
        own = {name: value for name, value in state["__dict__"].items() if name in fields}
        return state | {"__dict__": own}


def is_missing(table: object) -> bool:
    """True if a table was left out of the file; it is then no part of the mission's digest."""
    return table is None
