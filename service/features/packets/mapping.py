"""Mapping of a mission's table `[packets]` to XTCE parameters for every field of a batch."""

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from service.errors import BadInput, Fault, shown_value
from service.features.packets.clock import misfits, names_of
from service.features.packets.definition import PacketDefinition, ParameterKind
from service.missions.mission import Mission
from service.missions.packets import (
    PacketGyroBlocks,
    PacketMeasurement,
    Packets,
    PacketTime,
    PacketTracker,
    element_names,
)

DEG_OF_UNIT = {"deg": 1.0, "arcmin": 1.0 / 60.0, "arcsec": 1.0 / 3600.0, "rad": 180.0 / math.pi}


@dataclass(frozen=True)
class TrackerColumns:
    """Packet parameters of one tracker's stars, one name per slot; None: not sent."""

    tracker: str
    slots: int
    directions: tuple[tuple[str, ...], ...]
    """Parameter names of two columns (h and v), or three (components of a vector)."""
    scale: float
    """Factor from the unit of h and v to degrees."""
    magnitude: tuple[str, ...] | None
    time_offset_s: tuple[str, ...] | None
    sigma_arcsec: tuple[str, ...] | None
    valid: tuple[str, ...] | None
    valid_labels: tuple[str, ...] | None
    count: str | None

    @property
    def first(self) -> str:
        """Parameter whose presence shows that a packet has this tracker's stars."""
        return self.directions[0][0]


@dataclass(frozen=True)
class MeasurementColumns:
    """Packet parameters of an attitude measured by a tracker."""

    table: PacketMeasurement
    valid_labels: tuple[str, ...] | None
    quaternion: tuple[str, ...]
    sigma: tuple[str, ...]
    covariance: tuple[str, ...]
    arcsec: float
    """Factor from the unit of `sigma` to arcseconds."""


@dataclass(frozen=True)
class PacketMap:
    """Packet parameters for all batch fields, with arrays and patterns expanded."""

    table: Packets
    trackers: tuple[TrackerColumns, ...]
    measurements: tuple[MeasurementColumns, ...]
    quaternion: tuple[str, ...]
    rates: tuple[str, ...]
    gyro: tuple[str, ...]
    gyro_values: tuple[tuple[str, ...], ...]
    """Parameter names of a gyro block's samples, for each axis."""
    gyro_offsets: tuple[str, ...]
    velocity: tuple[str, ...]
    position: tuple[str, ...]


def packet_map(table: Packets, definition: PacketDefinition) -> PacketMap:
    """Map a mission's table to parameters; raises `BadInput` naming each missing parameter.

    The message names the key of the table and the XTCE file.
    """
    prior = table.prior
    found = PacketMap(
        table=table,
        trackers=tuple(_columns(each) for each in table.trackers),
        measurements=tuple(_measurement(each) for each in table.measurements),
        quaternion=element_names(prior.quaternion, 4) if prior and prior.quaternion else (),
        rates=element_names(table.rates.components, 3) if table.rates else (),
        gyro=element_names(table.gyro.counts, 3) if table.gyro else (),
        gyro_values=_gyro_columns(table.gyro_blocks, "values"),
        gyro_offsets=next(iter(_gyro_columns(table.gyro_blocks, "time_offset_s")), ()),
        velocity=element_names(table.velocity.components, 3) if table.velocity else (),
        position=element_names(table.position.components, 3) if table.position else (),
    )
    faults = []
    for key, names in _keys(found):
        labels = _labels_of(key, found)
        for name in names:
            kind = definition.parameters.get(name)
            message = _missing(name, definition) if kind is None else _misfit(key, kind, labels)
            if message:
                faults.append(Fault(f"packets.{key}", message, shown_value(name)))
    for key, time in _times(found):
        for name, message in misfits(time, definition.parameters):
            faults.append(Fault(f"packets.{key}", message, shown_value(name)))
    if faults:
        raise BadInput(faults[:20])
    return _with_digits(found, definition)


def _with_digits(found: PacketMap, definition: PacketDefinition) -> PacketMap:
    """The map with digits in place of the labels of booleans, whose values have none."""

    def digits(names: Iterable[str], labels: tuple[str, ...] | None) -> tuple[str, ...] | None:
        kinds = [definition.parameters[name] for name in names]
        if labels is None or not any(each.kind == "boolean" for each in kinds):
            return labels
        return tuple(str(kinds[0].labels[label]) for label in labels)

    trackers = tuple(
        replace(each, valid_labels=digits(each.valid or (), each.valid_labels))
        for each in found.trackers
    )
    measurements = []
    for each in found.measurements:
        labels = digits(filter(None, [each.table.valid]), each.table.valid_labels)
        measurements.append(replace(each, valid_labels=labels))
    return replace(found, trackers=trackers, measurements=tuple(measurements))


def _labels_of(key: str, found: PacketMap) -> tuple[str, ...] | None:
    table, index, word = (*key.split("."), "", "")[:3]
    if word != "valid":
        return None
    if table == "trackers":
        return found.trackers[int(index)].valid_labels
    return found.measurements[int(index)].valid_labels


_NO = frozenset(
    (
        *("invalid", "not_valid", "notvalid", "false", "no", "none", "nok", "not_ok", "bad", "off"),
        *("fail", "failed", "error", "fault", "lost", "inactive", "disabled", "unused", "empty"),
        "absent",
    )
)
_YES = frozenset(
    (
        *("valid", "true", "yes", "ok", "good", "on", "active", "enabled", "used", "present"),
        *("nominal", "locked", "tracking", "tracked"),
    )
)
"""Words in enumeration labels that mean present or valid."""


def _misfit(key: str, kind: ParameterKind, labels: tuple[str, ...] | None) -> str | None:
    """Reason why a kind of parameter does not fit a key of the table; None if it fits."""
    if key == "batch":
        is_many = kind.kind in ("number", "text")
        return None if is_many else f"{_said(kind)}; a number or a text is needed"
    if not key.endswith(".valid"):
        return None if kind.kind == "number" else f"{_said(kind)}; a number is needed"
    if labels is None:
        if kind.labels:
            return _unclear_labels(kind)
        return None if kind.kind in ("number", "boolean") else f"{_said(kind)}; give valid_labels"
    if kind.labels:
        unknown = [label for label in labels if label not in kind.labels]
        known = ", ".join(list(kind.labels)[:20])
        return f"has no label {unknown[0]!r} of valid_labels; it has {known}" if unknown else None
    return None if kind.kind == "text" else f"{_said(kind)} and has no labels; drop valid_labels"


def _said(kind: ParameterKind) -> str:
    return f"is {'an' if kind.kind == 'enumerated' else 'a'} {kind.kind} parameter"


def _unclear_labels(kind: ParameterKind) -> str | None:
    """Reason why the numbers of labels do not show which of them mean valid; None if they do."""
    labels = kind.labels
    words = {label: label.strip().lower().replace(" ", "_").replace("-", "_") for label in labels}
    set_labels = [label for label, raw in labels.items() if raw != 0]
    wrong = [label for label in set_labels if labels[label] is None or words[label] in _NO]
    wrong += [label for label, raw in labels.items() if raw == 0 and words[label] in _YES]
    if len(set_labels) > 1:
        wrong += [label for label in set_labels if words[label] not in _YES]
    if not wrong:
        return None
    shown = ", ".join(
        label if raw is None else f"{label} = {raw}" for label, raw in list(labels.items())[:20]
    )
    word = "a boolean" if kind.kind == "boolean" else "enumerated"
    return f"is {word}, {shown}: give valid_labels, the labels that mean that it holds one"


def packet_mission(missions: Mapping[str, Mission], name: str | None) -> Mission:
    """Mission whose packets are read: the named one, or the only one with a table.

    Raises `BadInput` naming `spacecraft` if there is none, or several without a name.
    """
    able = [each for each in missions.values() if each.packets is not None]
    known = ", ".join(each.name for each in able) or "none"
    if name is not None:
        found = [each for each in able if each.name == name]
        if not found:
            message = f"must be a mission with a table [packets]; there is {known}"
            raise BadInput(Fault("spacecraft", message, shown_value(name)))
        return found[0]
    if len(able) != 1:
        why = "is missing: " + ("no mission has" if not able else "several missions have")
        raise BadInput(Fault("spacecraft", f"{why} a table [packets]; there is {known}"))
    return able[0]


def _gyro_columns(
    table: PacketGyroBlocks | None, key: Literal["values", "time_offset_s"]
) -> tuple[tuple[str, ...], ...]:
    if table is None:
        return ()
    named = table.values if key == "values" else (table.time_offset_s,)
    return tuple(
        element_names(names, table.samples, table.first_sample)
        for names in named
        if names is not None
    )


def _columns(table: PacketTracker) -> TrackerColumns:
    def column(names: str | tuple[str, ...] | None) -> tuple[str, ...] | None:
        return None if names is None else element_names(names, table.slots, table.first_slot)

    directions = table.vector if table.vector is not None else (table.h, table.v)
    return TrackerColumns(
        tracker=table.tracker,
        slots=table.slots,
        directions=tuple(
            element_names(names, table.slots, table.first_slot)
            for names in directions
            if names is not None
        ),
        scale=DEG_OF_UNIT[table.angle_unit],
        magnitude=column(table.magnitude),
        time_offset_s=column(table.time_offset_s),
        sigma_arcsec=column(table.sigma_arcsec),
        valid=column(table.valid),
        valid_labels=table.valid_labels,
        count=table.count,
    )


def _measurement(table: PacketMeasurement) -> MeasurementColumns:
    return MeasurementColumns(
        table=table,
        valid_labels=table.valid_labels,
        quaternion=element_names(table.quaternion, 4),
        sigma=element_names(table.sigma, 3) if table.sigma else (),
        covariance=element_names(table.covariance, 6) if table.covariance else (),
        arcsec=DEG_OF_UNIT[table.angle_unit] * 3600.0,
    )


def _times(found: PacketMap) -> Iterable[tuple[str, PacketTime]]:
    """All times of the packet table with their keys."""
    table = found.table
    yield "time", table.time
    for index, columns in enumerate(found.measurements):
        if columns.table.time:
            yield f"measurements.{index}.time", columns.table.time
    if table.prior is not None and table.prior.time is not None:
        yield "prior.time", table.prior.time
    if table.gyro_blocks is not None and table.gyro_blocks.time:
        yield "gyro_blocks.time", table.gyro_blocks.time


def _keys(found: PacketMap) -> Iterable[tuple[str, Iterable[str]]]:
    """All keys of the packet table with their parameter names."""
    table = found.table
    for key, time in _times(found):
        yield key, names_of(time)
    yield "batch", (table.batch,) if table.batch else ()
    for index, each in enumerate(found.trackers):
        at = f"trackers.{index}"
        words = ("h", "v") if len(each.directions) == 2 else ("vector.0", "vector.1", "vector.2")
        for word, names in zip(words, each.directions, strict=True):
            yield f"{at}.{word}", names
        for word in ("magnitude", "time_offset_s", "sigma_arcsec", "valid"):
            yield f"{at}.{word}", getattr(each, word) or ()
        yield f"{at}.count", (each.count,) if each.count else ()
    for index, columns in enumerate(found.measurements):
        at = f"measurements.{index}"
        for word in ("quaternion", "sigma", "covariance"):
            yield f"{at}.{word}", getattr(columns, word)
        yield f"{at}.valid", (columns.table.valid,) if columns.table.valid else ()
    yield "prior.quaternion", found.quaternion
    yield "rates.components", found.rates
    yield "gyro.counts", found.gyro
    if (blocks := table.gyro_blocks) is not None:
        for axis, names in enumerate(found.gyro_values):
            yield f"gyro_blocks.values.{axis}", names
        yield "gyro_blocks.time_offset_s", found.gyro_offsets
        yield "gyro_blocks.count", (blocks.count,) if blocks.count else ()
    yield "velocity.components", found.velocity
    yield "position.components", found.position


def _missing(name: str, definition: PacketDefinition) -> str:
    message = f"{definition.name} has no such parameter in a container"
    near = difflib.get_close_matches(name, list(definition.parameters)[:5000], 3)
    return f"{message}; near to it: {', '.join(near)}" if near else message
