"""Packets to attitudes that trackers measured themselves: a batch for each quaternion."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from service.observations.faults import faults_of
from service.observations.schema import BatchIn, checked_from_model
from service.packets.carried import quaternion_in
from service.packets.clock import moment_of, names_of
from service.packets.definition import PacketFault
from service.packets.mapping import MeasurementColumns, PacketMap
from service.packets.stream import SpacePacket
from service.packets.values import finite_all, number


@dataclass(frozen=True)
class MeasuredBatch:
    """A measured attitude of a packet; `body` is None where the packet says that there is none."""

    packet: SpacePacket
    columns: MeasurementColumns
    body: dict[str, Any] | None


class MeasurementMaker:
    """Makes batches of measured attitudes of one spacecraft from the values of packets."""

    def __init__(self, spacecraft: str, mapped: PacketMap) -> None:
        self._spacecraft = spacecraft
        self._mapped = mapped

    def add(self, packet: SpacePacket, values: Mapping[str, Any]) -> Iterator[MeasuredBatch]:
        """The measured attitudes of a packet; raises `PacketFault`."""
        for columns in self._mapped.measurements:
            if columns.quaternion[0] in values:
                yield MeasuredBatch(packet, columns, self._body(columns, packet, values))

    def json_of(self, batch: MeasuredBatch) -> bytes:
        """A batch as canonical JSON; raises `PacketFault` naming the parameters of a fault.

        The checks are those of every batch.
        """
        try:
            model = BatchIn.model_validate(batch.body)
        except ValidationError as error:
            fault = faults_of(error)[0]
            columns = batch.columns
            names = columns.quaternion
            if fault.field.startswith(("measurement.sigma", "measurement.covariance")):
                names = columns.sigma or columns.covariance or names
            elif fault.field == "time":
                names = names_of(columns.table.time or self._mapped.table.time)
            message = f"{fault.field}: {fault.message}"
            raise PacketFault(", ".join(names), message, fault.value) from None
        return checked_from_model(model).text.encode()

    def _body(
        self, columns: MeasurementColumns, packet: SpacePacket, values: Mapping[str, Any]
    ) -> dict[str, Any] | None:
        table = columns.table
        if table.valid is not None and not number(values, table.valid):
            return None
        quaternion = quaternion_in(values, columns.quaternion, table)
        if quaternion is None:
            return None
        moment = moment_of(table.time or self._mapped.table.time, values)
        measured: dict[str, Any] = {"quaternion": quaternion, "frame": table.frame}
        if table.tracker is not None:
            measured["tracker"] = table.tracker
        if columns.covariance:
            scale = columns.arcsec**2
            p11, p12, p13, p22, p23, p33 = finite_all(values, columns.covariance, scale)
            rows = [[p11, p12, p13], [p12, p22, p23], [p13, p23, p33]]
            measured["covariance_arcsec2"] = rows
        else:
            measured["sigma_arcsec"] = table.sigma_arcsec or finite_all(
                values, columns.sigma, columns.arcsec
            )
        axes = table.tracker or "body"
        return {
            "spacecraft": self._spacecraft,
            "batch": f"{packet.apid}-{moment.text}-{packet.sequence_count}-{axes}",
            "time": moment.text,
            "a_priori": None,
            "measurement": measured,
        }
