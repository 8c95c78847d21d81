"""Attitudes as JSON: one object whose `items` are written as they are read."""

from collections.abc import Iterator

import msgspec
import numpy as np

from service.products.attitudes import AttitudeBlock, AttitudeSeries
from service.vectors import Vector

_ENCODER = msgspec.json.Encoder()


def write_json(series: AttitudeSeries) -> Iterator[bytes]:
    """Write the series: `about` and its `items`, an object an attitude."""
    yield b'{"about":' + _ENCODER.encode(series.about.provenance()) + b',"items":['
    is_first = True
    for block in series.blocks:
        text = _ENCODER.encode(items(block))[1:-1]
        yield text if is_first else b"," + text
        is_first = False
    yield b"]}"


def items(block: AttitudeBlock) -> list[dict[str, object]]:
    """The attitudes of a block as plain objects."""
    if len(block) and block.revision[0]:
        return _estimates(block)
    covariance = _matrices(block)
    known = ~np.isnan(block.rate_deg_per_s[:, 0])
    names = (
        "time", "quaternion", "covariance_arcsec2", "rate_deg_per_s", "rate_origin", "status",
        "method", "residual_rms_arcsec", "predicted_rms_arcsec", "stretch", "batch", "id",
    )  # fmt: skip
    rates = zip(block.rate_deg_per_s.tolist(), known.tolist(), strict=True)
    values = zip(
        block.time.tolist(),
        block.quaternion.tolist(),
        covariance.tolist(),
        [rate if is_known else None for rate, is_known in rates],
        block.rate_origin.tolist(),
        block.status.tolist(),
        block.method.tolist(),
        block.residual_rms_arcsec.tolist(),
        block.predicted_rms_arcsec.tolist(),
        block.stretch.tolist(),
        block.batch.tolist(),
        block.id.tolist(),
        strict=True,
    )
    return [dict(zip(names, row, strict=True)) for row in values]


def _estimates(block: AttitudeBlock) -> list[dict[str, object]]:
    """The filtered or smoothed attitudes of a block as plain objects."""
    has_bias = ~np.isnan(block.bias_deg_per_h[:, 0])
    biases = zip(block.bias_deg_per_h.tolist(), has_bias.tolist(), strict=True)
    columns: dict[str, list[object]] = {
        "time": block.time.tolist(),
        "quaternion": block.quaternion.tolist(),
        "covariance_arcsec2": _matrices(block).tolist(),
        "rate_deg_per_s": block.rate_deg_per_s.tolist(),
        "rate_origin": block.rate_origin.tolist(),
        "status": block.status.tolist(),
        "method": block.method.tolist(),
        "residual_rms_arcsec": [None] * len(block),
        "predicted_rms_arcsec": [None] * len(block),
        "stretch": block.stretch.tolist(),
        "batch": [None] * len(block),
        "id": block.id.tolist(),
        "model": block.model.tolist(),
        "revision": block.revision.tolist(),
        "bias_deg_per_h": [bias if known else None for bias, known in biases],
        "bias_sigma_deg_per_h": block.bias_sigma_deg_per_h.tolist(),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _matrices(block: AttitudeBlock) -> Vector:
    """The covariances (n, 3, 3) of a block."""
    places = [0, 1, 2, 1, 3, 4, 2, 4, 5]
    return np.asarray(block.covariance_arcsec2[:, places].reshape(-1, 3, 3))
