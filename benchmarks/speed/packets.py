"""Speed of reading packets, against space-packet-parser: `python -m benchmarks packets`.

Real packets of JPSS-1, 7,200 in two hours, in turns so that both meet the same load.
"""

import io
import time
from collections.abc import Callable
from pathlib import Path

from space_packet_parser import ccsds_generator, load_xtce

from benchmarks.bounds import at_least, equal
from benchmarks.report import Report
from service.features.packets.definition import read_definition
from service.features.packets.reader import PacketReader
from service.missions.mission import SHIPPED_FOLDER, parse_mission

JPSS1 = Path(__file__).parents[2] / "tests" / "features" / "packets" / "jpss1"
PACKETS = JPSS1 / "J01_G011_LZ_2021-04-09T00-00-00Z_V01.DAT1"
XTCE = JPSS1 / "jpss1_geolocation_xtce_v1.xml"
TABLE = """
[packets.time]
kind = "cds"
day = "ADAET2DAY"
millisecond = "ADAET2MS"
microsecond = "ADAET2US"
[packets.prior]
quaternion = ["ADCFAQ1", "ADCFAQ2", "ADCFAQ3", "ADCFAQ4"]
"""
ROUNDS, QUICK_ROUNDS = 7, 2
LEAST = 0.6


def run(quick: bool, seed: int) -> Report:
    content = PACKETS.read_bytes()
    text = (SHIPPED_FOLDER / "xte.toml").read_text(encoding="utf-8")
    mission = parse_mission(text + TABLE, "xte.toml")
    definition, theirs = read_definition(XTCE, "CCSDSPacket"), load_xtce(XTCE)

    def alone() -> int:
        return sum(1 for each in ccsds_generator(content) if theirs.parse_bytes(each))

    def attitudes() -> int:
        reader = PacketReader(mission, definition)
        return sum(1 for _ in reader.attitudes(io.BytesIO(content)))

    def lines() -> int:
        reader = PacketReader(mission, definition)
        assert not list(reader.lines(io.BytesIO(content), "packets"))
        return reader.totals().packets

    ways = {"space-packet-parser alone": alone, "attitudes": attitudes, "replay": lines}
    best = dict.fromkeys(ways, 0.0)
    for _ in range(QUICK_ROUNDS if quick else ROUNDS):
        for name, way in ways.items():
            best[name] = max(best[name], _rate(way))
    theirs_alone = best["space-packet-parser alone"]
    figures = {f"{name}, packets/s": rate for name, rate in best.items()}
    bounds = [
        equal("attitudes of 7,200 packets", attitudes(), 7_200),
        *(
            at_least(
                f"{name} beside space-packet-parser", best[name] / theirs_alone, LEAST, "times"
            )
            for name in ("attitudes", "replay")
        ),
    ]
    return Report("packets", figures, bounds)


def _rate(way: Callable[[], int]) -> float:
    start = time.perf_counter()
    count = way()
    return count / (time.perf_counter() - start)
