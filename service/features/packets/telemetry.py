"""Space packets as telemetry: uploaded archives with their XTCE file, and replays."""

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from service.cli.arguments import settings_of
from service.errors import BadInput, Fault, shown_value

if TYPE_CHECKING:
    from service.features.packets.reader import PacketLines, PacketReader
    from service.missions.mission import Mission
    from service.replay.items import Item

FORMAT = "packets"


def opened_upload(
    file: IO[bytes], missions: Mapping[str, "Mission"], spacecraft: str | None
) -> "PacketLines":
    """Lines of telemetry from an uploaded archive; see `PacketLines`."""
    from service.features.packets.reader import PacketLines

    return PacketLines(file, missions, spacecraft)


def add_options(parser: ArgumentParser) -> None:
    """Declare the packet options of `acquire replay`."""
    parser.add_argument(
        "--packets",
        nargs="+",
        type=Path,
        default=[],
        metavar="FILE",
        help="files of CCSDS space packets, in place of FILE; the mission's table [packets] says "
        "which parameters fill a batch",
    )
    parser.add_argument(
        "--xtce", type=Path, metavar="FILE", help="the XTCE file that describes the packets"
    )
    parser.add_argument(
        "--spacecraft",
        metavar="NAME",
        help="the mission of the packets; default: the only one with a table [packets]",
    )


def files_of(parsed: Namespace) -> "PacketFiles | None":
    """Packet files that a replay should send; None without packet options.

    Raises `BadInput` for options that contradict each other.
    """
    if bool(parsed.packets) != (parsed.xtce is not None):
        raise BadInput(Fault("--xtce", "goes with --packets, and --packets needs it"))
    if parsed.spacecraft is not None and not parsed.packets:
        message = "goes with --packets; a batch names its own spacecraft"
        raise BadInput(Fault("--spacecraft", message, shown_value(parsed.spacecraft)))
    return PacketFiles(parsed) if parsed.packets else None


class PacketFiles:
    """Packet files with their XTCE file, parsed in this process or sent as an archive."""

    def __init__(self, parsed: Namespace) -> None:
        self.files: Sequence[Path] = parsed.packets
        self.spacecraft: str | None = parsed.spacecraft
        self._parsed = parsed
        self._reader: PacketReader | None = None

    def items(self, run: str) -> Iterator["Item"]:
        """All batches and gyro blocks in the packets, parsed with the missions of the settings."""
        from service.features.packets.reader import file_lines
        from service.replay.items import item_of

        self._reader = reader = self._opened()
        return (item_of(file, line, run) for file, line in file_lines(reader, self.files))

    def _opened(self) -> "PacketReader":
        from service.features.packets.definition import read_definition
        from service.features.packets.mapping import packet_mission
        from service.features.packets.reader import PacketReader
        from service.missions.mission import load_missions

        settings = settings_of(self._parsed)
        missions = load_missions(*settings.mission_places, shipped=settings.ships_missions)
        mission = packet_mission(missions, self.spacecraft)
        assert mission.packets is not None
        definition = read_definition(self._parsed.xtce, mission.packets.root_container)
        return PacketReader(mission, definition)

    def counts(self) -> dict[str, Any] | None:
        """Counts of the packets parsed in this process; None if none were."""
        from msgspec import to_builtins

        return None if self._reader is None else to_builtins(self._reader.totals())

    def __iter__(self) -> Iterator[bytes]:
        from service.features.packets.reader import archive_of

        return archive_of([self._parsed.xtce, *self.files])

    def item(self, number: int) -> "Item":
        """Place of a refused batch or block, by its number and the first of the files."""
        from service.replay.items import Item

        return Item(self.files[0], number, None)
