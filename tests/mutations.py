"""A process that reads mutated files, and may hold only so much memory.

    python -m tests.mutations READER COUNT SEED

Every reader must read a file or refuse it as its documentation says; anything
else, also a lack of memory, ends the process with the file that did it.
"""

import io
import json
import random
import resource
import sys
import tempfile
from pathlib import Path

from service.errors import BadConfiguration, BadInput
from service.missions.mission import SHIPPED_FOLDER, load_missions
from service.observe.csv_rows import write_csv
from service.observe.formats import read_lines
from service.observe.wire import BatchIn, submission_from_json
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.sky.catalog import import_csv, load, load_embedded, save
from service.sky.shelf import Shelf
from service.sky.view import Sky

MORE_MEMORY = 1 << 30
"""What a reader may take beyond what the process holds already."""

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


def pass_lines():
    sky = Sky(load_embedded(), Shelf(64 << 20))
    drawn = list(draw_pass(load_missions()["XTE"], sky, Pass(batches=3, seed=1)))
    return [each.batch for each in drawn]


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


class Readers:
    """By name: a good file, and what reads it."""

    def __init__(self, folder):
        self._folder = folder

    def ndjson(self):
        good = "\n".join(json.dumps(each) for each in pass_lines()).encode()
        return good, lambda data: read_telemetry(data, "ndjson")

    def csv(self):
        file = self._folder / "pass.csv"
        with file.open("w", newline="") as text:
            write_csv([BatchIn.model_validate(each) for each in pass_lines()], text)
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
        return good, self._file("own.toml", lambda path: load_missions(path.parent))

    def _file(self, name, read):
        # A folder of its own: a folder of missions is read whole.
        path = self._folder / name.replace(".", "-") / name
        path.parent.mkdir(exist_ok=True)

        def write_and_read(data):
            path.write_bytes(data)
            read(path)

        return write_and_read


NAMES = tuple(name for name in vars(Readers) if not name.startswith("_"))


def main(name, count, seed):
    draw = random.Random(int(seed))
    with tempfile.TemporaryDirectory() as folder:
        good, read = getattr(Readers(Path(folder)), name)()
        read(good)
        held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + MORE_MEMORY, resource.RLIM_INFINITY))
        refused = 0
        for _ in range(int(count)):
            data = mutated(good, draw)
            try:
                read(data)
            except (BadInput, BadConfiguration):
                refused += 1
            except BaseException:
                sys.stderr.write(f"{name}: {data!r}\n"[:4000])
                raise
    print(refused)


if __name__ == "__main__":
    main(*sys.argv[1:])
