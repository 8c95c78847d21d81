"""A process that reads mutated files, and may hold only so much memory.

    python -m tests.mutations BLACK_BOX

Takes lines "READER COUNT SEED" from its input.  Every reader must read a file or refuse it
as its documentation says; anything else, also a lack of memory, ends the process.  Prints
one JSON line for each: how many were read, how many refused, and the most memory held.

The file BLACK_BOX holds what is being read, so that it is known after a crash: `BlackBox.read`.
"""

import faulthandler
import gzip
import importlib.util
import io
import json
import mmap
import random
import re
import resource
import struct
import sys
import tempfile
import zlib
from functools import cache
from pathlib import Path

import numpy as np
import zstandard
from PIL import Image

from service.ephemerides.aem import read_aem
from service.ephemerides.oem import read_oem
from service.ephemerides.tle import read_tle
from service.errors import BadConfiguration, BadInput
from service.features.packets.definition import PacketDefinition
from service.features.packets.reader import PacketLines, PacketReader, archive_of
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.fits import write_fits
from service.features.pictures.frames.frame import FrameLimits
from service.missions.mission import SHIPPED_FOLDER, load_missions, read_mission
from service.observations.csv_rows import write_batches_csv
from service.observations.decompress import MAX_LINE_BYTES, unpacked_lines
from service.observations.schema import BatchIn, submission_from_json
from service.observations.telemetry import read_lines
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import import_csv, import_sky2000, load, load_embedded, save
from service.sky.model import SkyModel
from service.times import parse_utc
from tests.ephemerides.orbits import ISS, oem_text, with_checksum
from tests.features.packets.packing import mission_of_pass, packed, xtce
from tests.features.pictures.colour_files import colours, dng, png_of_16_bits, tiff_of_16_bits
from tests.features.products.series import GOLDEN, rows, slew
from tests.features.products.series import written as aem_file
from tests.sky.sky2000_records import SIRIUS, written

AEM_EXAMPLES = Path(__file__).parent / "ephemerides" / "adm-examples"
MORE_MEMORY = 1 << 30
"""What a reader may take beyond what the process holds already."""
FRAME_LIMITS = FrameLimits(max_pixels=1_000_000)
MEMORY = Path("/dev/shm")
"""To write each file to a disk would take most of the time."""
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"

HERMITE = {"INTERPOLATION": "HERMITE", "INTERPOLATION_DEGREE": 7}
OEM_ELEMENTS = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
AMONG_STATES = parse_utc("2022-01-17T12:00:02.5Z")
TOKENS = (
    b'"', b",", b"{", b"}", b"[", b"]", b"\n", b"\r", b"\0", b"\xff\xfe", b"NaN", b"1e999", b"-",
    b"9" * 400, b"null", b"true", b"\\ud800", b"=", b"#", b"'", b"\xf0\x9f", b"{" * 200, b"[" * 200,
)  # fmt: skip


def mutated(data, draw):
    """The data with a few things done to it that happen to files, or that somebody may do."""
    data = bytearray(data)
    for _ in range(draw.choice((1, 1, 1, 2, 3, 8))):
        at = draw.randrange(len(data) + 1)
        to = min(len(data), at + draw.choice((1, 1, 2, 4, 40, 400)))
        kind = draw.randrange(7)
        if kind == 0 and at < len(data):
            data[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del data[at:to]
        elif kind == 2:
            data[at:at] = draw.choice(TOKENS)
        elif kind == 3:
            data[at:to] = draw.choice(TOKENS)
        elif kind == 4:
            data[at:at] = data[at:to]
        elif kind == 5:
            del data[at:]
        else:
            data[at:to] = draw.randbytes(to - at)
    return bytes(data)


def with_right_sums(data):
    """A PNG file whose chunks have the checksums of what they hold, so that more of it is read."""
    data, at = bytearray(data), len(PNG_MAGIC)
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        if end + 4 > len(data):
            break
        data[end : end + 4] = struct.pack(">L", zlib.crc32(data[at + 4 : end]))
        at = end + 4
    return bytes(data)


@cache
def pass_lines():
    sky = SkyModel(load_embedded(), LruCache(64 << 20))
    drawn = list(draw_pass(load_missions()["XTE"], sky, Pass(batches=3, seed=1)))
    return [each.batch for each in drawn]


def pass_with_angles():
    """One batch in the form that the test's packets have."""
    stars = [{"h_deg": 0.1 * k, "v_deg": -0.2 * k, "magnitude": 5.0 + k} for k in range(4)]
    (batch, *_) = pass_lines()
    return [batch | {"observations": [{"tracker": "STARTRACKER_1", "stars": stars}]}]


def read_telemetry(data, form):
    """Every line; raises the first fault at the end, so that it counts as refused."""
    faults = []
    for line in read_lines(io.BytesIO(data), form):
        if line.body is None:
            faults.append(line.fault)
            continue
        try:
            submission_from_json(line.body)
        except BadInput as error:
            faults += error.faults
    if faults:
        raise BadInput(faults)


def require_no_faults(lines):
    """Every line; raises the faults at the end, so that they count as refused."""
    faults = [line.fault for line in lines if line.fault is not None]
    if faults:
        raise BadInput(faults)


def read_packed(data, coding):
    """Every line of a compressed body, as a replay over HTTP takes them."""
    lines = list(unpacked_lines(io.BytesIO(data), coding, MAX_LINE_BYTES))
    read_telemetry(b"".join(lines), "ndjson")


def frame_counts():
    counts = np.random.default_rng(5).integers(0, 65536, (12, 20))
    return counts.astype(np.uint16)


def picture(file_format, dtype=np.uint16, **options):
    file = io.BytesIO()
    values = frame_counts()
    image = Image.fromarray(values if dtype is np.uint16 else (values >> 8).astype(dtype))
    image.save(file, file_format, **options)
    return file.getvalue()


def color_picture(file_format, **options):
    file = io.BytesIO()
    values = np.random.default_rng(6).integers(0, 256, (12, 20, 3)).astype(np.uint8)
    Image.fromarray(values).save(file, file_format, **options)
    return file.getvalue()


def exif():
    told = Image.Exif()
    told.get_ifd(0x8769).update({33434: 0.5, 36867: "2026:03:01 00:00:00", 36881: "+01:00"})
    return told


def read_frame_of(data):
    read_frame(io.BytesIO(data), FRAME_LIMITS)


def with_right_sum(line):
    """A line of elements with its own checksum, so that more of it is read."""
    return with_checksum(line) if len(line) == 69 and line.isascii() else line


def states_of(read):
    """Reads an ephemeris, and takes a state of it."""

    def read_one(data):
        read("x", io.BytesIO(data)).at(AMONG_STATES)

    return read_one


class Readers:
    """By name: good files, and what reads them."""

    def __init__(self, folder):
        self._folder = folder

    def ndjson(self):
        good = "\n".join(json.dumps(each) for each in pass_lines()).encode()
        return good, lambda data: read_telemetry(data, "ndjson")

    def csv(self):
        file = self._folder / "pass.csv"
        with file.open("w", newline="") as text:
            write_batches_csv([BatchIn.model_validate(each) for each in pass_lines()], text)
        return file.read_bytes(), lambda data: read_telemetry(data, "csv")

    def catalog_csv(self):
        rows = [f"S{i},{i * 3.7 % 360},{i * 1.3 % 90},{i % 9}.5,{i}" for i in range(30)]
        good = "\n".join(["id,ra_deg,dec_deg,magnitude,parallax_mas", *rows]).encode()
        return good, self._file("site.csv", import_csv)

    def catalog(self):
        source, packed = self._folder / "s.csv", self._folder / "s.npz"
        source.write_bytes(self.catalog_csv()[0])
        save(import_csv(source), packed)
        return packed.read_bytes(), self._file("site.npz", load)

    def mission(self):
        good = (SHIPPED_FOLDER / "xte.toml").read_bytes()
        return good, self._file("own.toml", read_mission)

    def ndjson_gzip(self):
        return gzip.compress(self.ndjson()[0], mtime=0), lambda data: read_packed(data, "gzip")

    def ndjson_zstd(self):
        packed = zstandard.ZstdCompressor(write_checksum=False).compress(self.ndjson()[0])
        return packed, lambda data: read_packed(data, "zstd")

    def sky2000(self):
        stars = [SIRIUS | {"ID": 6450085 + i, "RAh": i, "HD": 48915 + i} for i in range(3)]
        good = "".join(written(**star) + "\n" for star in stars).encode("latin-1")
        return good, self._file("sky2kv4.dat", import_sky2000)

    def sky2000_gzip(self):
        return gzip.compress(self.sky2000()[0], mtime=0), self.sky2000()[1]

    def aem(self):
        good = aem_file("aem", rows(slew(3)), rows([GOLDEN], "1996-01-11T00:00:00Z"))
        return good, lambda data: read_aem("x.aem", io.BytesIO(data))

    def aem_of_version_1(self):
        good = (AEM_EXAMPLES / "aem-AEMExample04.txt").read_bytes()
        return good, lambda data: read_aem("x.aem", io.BytesIO(data))

    def aem_xml(self):
        good = aem_file("aem-xml", rows(slew(2)), rows([GOLDEN], "1996-01-11T00:00:00Z"))
        return good, lambda data: read_aem("x.aem", io.BytesIO(data))

    def oem(self):
        covariance = ["COVARIANCE_START", "EPOCH = 2022-01-17T12:00:00", "1e-4", "COVARIANCE_STOP"]
        good = oem_text(np.arange(0.0, 301.0, 60.0), extra=covariance, **HERMITE).encode()
        return good, states_of(read_oem)

    def oem_xml(self):
        states = "".join(
            "<stateVector>"
            f"<EPOCH>2022-01-17T12:00:0{second}</EPOCH>"
            + "".join(f"<{name}>{second + 7000}.5</{name}>" for name in OEM_ELEMENTS[:3])
            + "".join(f"<{name}>1.0</{name}>" for name in OEM_ELEMENTS[3:])
            + "</stateVector>"
            for second in range(4)
        )
        keys = oem_text([0.0, 3.0], **HERMITE).split("META_START\n")[1].split("META_STOP")[0]
        pairs = [line.split(" = ") for line in keys.splitlines()]
        metadata = "".join(f"<{name}>{value}</{name}>" for name, value in pairs)
        good = (
            '<oem id="CCSDS_OEM_VERS" version="2.0">'
            "<header><ORIGINATOR>NASA</ORIGINATOR></header><body><segment>"
            f"<metadata>{metadata}</metadata><data>{states}</data></segment></body></oem>"
        )
        return good.encode(), states_of(read_oem)

    def tle(self):
        later = [with_checksum(ISS[0].replace("22017", "22018")), ISS[1]]
        good = "\n".join(["ISS", *ISS, *later]).encode()
        return good, states_of(lambda name, file: read_tle(name, file, "FILE"))

    def tle_with_right_sums(self):
        good, read = self.tle()

        def read_with_sums(data):
            lines = data.decode("latin-1").split("\n")
            read("\n".join(map(with_right_sum, lines)).encode("latin-1"))

        return good, read_with_sums

    def fits(self):
        file = io.BytesIO()
        cards = {"DATE-OBS": "2026-03-01T00:00:00", "EXPTIME": 0.5, "OBSERVER": "D'Arcy"}
        write_fits(file, frame_counts(), cards)
        return file.getvalue(), read_frame_of

    def tiff(self):
        return picture("TIFF"), read_frame_of

    def tiff_packed(self):
        return picture("TIFF", np.uint8, compression="tiff_adobe_deflate"), read_frame_of

    def png(self):
        return picture("PNG"), read_frame_of

    def png_with_right_sums(self):
        return picture("PNG", np.uint8), lambda data: read_frame_of(with_right_sums(data))

    def png_in_colour(self):
        return color_picture("PNG"), lambda data: read_frame_of(with_right_sums(data))

    def jpeg(self):
        return picture("JPEG", np.uint8, quality=90), read_frame_of

    def jpeg_in_colour(self):
        return color_picture("JPEG", progressive=True, exif=exif()), read_frame_of

    def bmp(self):
        return picture("BMP", np.uint8), read_frame_of

    def bmp_in_colour(self):
        return color_picture("BMP"), read_frame_of

    def png_of_16_bits_in_colour(self):
        good = png_of_16_bits(colours(np.random.default_rng(7), 12, 20))
        return good, lambda data: read_frame_of(with_right_sums(data))

    def tiff_of_16_bits_in_colour(self):
        good = tiff_of_16_bits(colours(np.random.default_rng(7), 12, 20))
        return good, read_frame_of

    def packets(self):
        """Packets of a pass, as a replay reads them."""
        mission, definition = mission_of_pass(), PacketDefinition(xtce(), "x", "CCSDSPacket")

        def read(data):
            reader = PacketReader(mission, definition)
            require_no_faults(reader.lines(io.BytesIO(data), "pass.dat"))

        return packed(pass_with_angles()), read

    def xtce(self):
        """The file that describes them."""
        data, mission = packed(pass_with_angles()), mission_of_pass()

        def read(text):
            reader = PacketReader(mission, PacketDefinition(text, "x", "CCSDSPacket"))
            require_no_faults(reader.lines(io.BytesIO(data), "pass.dat"))

        return xtce(), read

    def packet_archive(self):
        """Both, as they are uploaded."""
        files = [self._folder / "pass.dat", self._folder / "test.xml"]
        files[0].write_bytes(packed(pass_with_angles()))
        files[1].write_bytes(xtce())
        missions = {"XTE": mission_of_pass()}

        def read(data):
            require_no_faults(PacketLines(io.BytesIO(data), missions, None))

        return b"".join(archive_of(files)), read

    def raw(self):
        good = dng(np.random.default_rng(8).integers(0, 4000, (64, 96)).astype(np.uint16))
        return good, read_frame_of

    def npy(self):
        file = io.BytesIO()
        np.save(file, frame_counts())
        return file.getvalue(), read_frame_of

    def _file(self, name, read):
        path = self._folder / name

        def write_and_read(data):
            path.write_bytes(data)
            read(path)

        return write_and_read


NEEDS = {"raw": "rawpy"}
"""Packages without which a reader refuses every file."""
NAMES = tuple(
    name
    for name in vars(Readers)
    if not name.startswith("_") and (name not in NEEDS or importlib.util.find_spec(NEEDS[name]))
)


class BlackBox:
    """A file in memory with the reader and the bytes at work; it outlives the process."""

    SIZE = 4 << 20
    LENGTHS = struct.Struct("<II")

    def __init__(self, path):
        with path.open("w+b") as file:
            file.truncate(self.SIZE)
            self._held = mmap.mmap(file.fileno(), self.SIZE)

    def hold(self, name, data):
        """Note what is read next."""
        start = self.LENGTHS.size
        self._held[: start + len(name) + len(data)] = (
            self.LENGTHS.pack(len(name), len(data)) + name + data
        )

    @classmethod
    def read(cls, path):
        """The name of the reader and the bytes of a process that has ended; empty before both."""
        content = path.read_bytes() if path.exists() else b""
        if not content:
            return "", b""
        name, data = cls.LENGTHS.unpack_from(content)
        start = cls.LENGTHS.size
        return content[start : start + name].decode(), content[start + name :][:data]


def read_mutations(name, count, seed, box, folder):
    """Read so many mutated files; how many were read and refused, and the most memory held."""
    draw = random.Random(seed)
    good, read = getattr(Readers(folder), name)()
    read(good)
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MORE_MEMORY, resource.RLIM_INFINITY))
    # The readers before have left their peak.
    Path("/proc/self/clear_refs").write_text("5")
    refused, encoded = 0, name.encode()
    for _ in range(count):
        data = mutated(good, draw)
        box.hold(encoded, data)
        try:
            read(data)
        except (BadInput, BadConfiguration):
            refused += 1
    # Not getrusage: its peak is that of the process which started this one, if that was larger.
    (peak,) = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    return {"read": count - refused, "refused": refused, "most_mb": int(peak) // 1024}


def main(box):
    faulthandler.enable()
    held = BlackBox(Path(box))
    with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
        for line in sys.stdin:
            name, count, seed = line.split()
            counted = read_mutations(name, int(count), int(seed), held, Path(folder))
            print(json.dumps(counted), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
