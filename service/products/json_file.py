"""Attitudes as JSON: one object whose `items` are written as they are read."""

from collections.abc import Iterator

import msgspec

from service.products.attitudes import AttitudeBlock, AttitudeSeries, Texts
from service.products.tables import number_texts, rows_of_texts
from service.vectors import Vector

_ENCODER = msgspec.json.Encoder()


def write_json(series: AttitudeSeries) -> Iterator[bytes]:
    """Write the series: `about` and its `items`, an object an attitude."""
    yield b'{"about":' + _ENCODER.encode(series.about.provenance()) + b',"items":['
    is_first = True
    for block in series.blocks:
        text = ",".join(_items(block)).encode()
        yield text if is_first else b"," + text
        is_first = False
    yield b"]}"


def _items(block: AttitudeBlock) -> Iterator[str]:
    """The attitudes of a block as objects.

    They are put together from texts: plain objects take twice the time, most of it to
    collect garbage.
    """
    members = {
        "time": _plain(block.time),
        "quaternion": _vectors(block.quaternion),
        "covariance_arcsec2": _matrices(block.covariance_arcsec2),
        "rate_deg_per_s": _vectors(block.rate_deg_per_s),
        "rate_origin": _plain(block.rate_origin),
        "status": _plain(block.status),
        "method": _plain(block.method),
        "residual_rms_arcsec": number_texts(block.residual_rms_arcsec.tolist()),
        "predicted_rms_arcsec": number_texts(block.predicted_rms_arcsec.tolist()),
        "stretch": number_texts(block.stretch.tolist()),
        "batch": _plain(block.batch),
        "id": _plain(block.id),
    }
    if len(block) and block.revision[0]:
        members |= {
            "model": _plain(block.model),
            "revision": number_texts(block.revision.tolist()),
            "bias_deg_per_h": _vectors(block.bias_deg_per_h),
            "bias_sigma_deg_per_h": _vectors(block.bias_sigma_deg_per_h),
        }
    row = ",".join(f'"{name}":%s' for name in members)
    row = f"{{{row}}}"
    return (row % values for values in zip(*members.values(), strict=True))


def _plain(values: Texts) -> list[str]:
    plain = values.tolist()
    # Many are the same.
    texts = {value: _ENCODER.encode(value).decode() for value in set(plain)}
    return [texts[value] for value in plain]


def _vectors(values: Vector) -> list[str]:
    """Arrays of the three or four numbers of each row, null where they are not known."""
    if not len(values):
        return []
    text = _ENCODER.encode(values.tolist()).decode()[1:-1].replace("],[", "]\n[")
    return text.replace("[null,null,null]", "null").split("\n")


def _matrices(covariance: Vector) -> list[str]:
    return [
        f"[[{p11},{p12},{p13}],[{p12},{p22},{p23}],[{p13},{p23},{p33}]]"
        for p11, p12, p13, p22, p23, p33 in rows_of_texts(covariance)
    ]
