"""Requests of every kind for both versions, drawn with a seed.

A request may refer to an earlier answer of the same server: `{first:id}` in its path is the field
`id` of the answer to the request `first`.
"""

import gzip
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlencode

import numpy as np

from service.features.pictures.tracker.simulated import (
    FrameFormat,
    FrameSettings,
    draw_frames,
    frame_bytes,
)
from service.missions.mission import Mission, load_missions
from service.simulate.stretches import Pass, PriorKind, Trouble, Troubles
from service.simulate.telemetry import draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel

API = "/api/v1"
IDENTIFIERS = ("verified", "starid", "ptp", "lost_in_space")
PRIORS: tuple[PriorKind, PriorKind, Literal["none"]] = ("quaternion", "direction", "none")
TWIN = "TWIN"
"""Name of a generated mission with two trackers; the shipped missions have one each."""
MISSIONS = ("XTE", "SWAS", "SOHO", "IMAGER", TWIN)
YEARS = (1999, 2026)
JSON = {"Content-Type": "application/json"}
Json = dict[str, Any]


@dataclass(frozen=True)
class Request:
    """Request with its own `name`, and its `kind`, the row of the table that counts it.

    `until_ended`: the request is repeated until the answer's `state` is not `running`.
    """

    kind: str
    name: str
    method: str
    path: str
    content: bytes = b""
    headers: Mapping[str, str] = field(default_factory=dict)
    until_ended: bool = False


@dataclass(frozen=True)
class Phase:
    """Requests sent one after another, or `at_once` of them overlapping."""

    title: str
    requests: Sequence[Request]
    at_once: int = 1


def write_twin(folder: Path, tree: Path) -> None:
    """Write the mission file of `TWIN`: the XTE of a checkout, with a second tracker.

    `tree` is the older checkout of the two that read the file, so settings that a later version
    made optional are included.
    """
    text = (tree / "service/missions/xte.toml").read_text(encoding="utf-8")
    text = text.replace('name = "XTE"', f'name = "{TWIN}"')
    own = text[text.index("[[trackers]]") :]
    own = own.replace("STARTRACKER_1", "STARTRACKER_2")
    for axis, turned in (
        ("x", "[0.0, 0.0, 1.0]"),
        ("y", "[1.0, 0.0, 0.0]"),
        ("z", "[0.0, 1.0, 0.0]"),
    ):
        lines = own.splitlines()
        own = "\n".join(
            f"{axis}_axis_body = {turned}" if line.startswith(f"{axis}_axis_body") else line
            for line in lines
        )
    # The second tracker looks 90 deg from the zone's axis, which a cap must reach.
    (folder / f"{TWIN.lower()}.toml").write_text(f"{text}\n{own}\n", encoding="utf-8")


def phases_of(inputs: int, seed: int, folder: Path) -> list[Phase]:
    """About `inputs` requests that compute or change something, and requests to read the results.

    `folder` holds the mission file of `TWIN`.
    """
    draw = _Draw(seed, folder)
    share = max(inputs, 40)
    batches = draw.batches(round(share * 0.62))
    return [
        Phase("batches", batches),
        Phase("repeats", list(_repeats(batches, round(share * 0.03)))),
        Phase("bad input", draw.bad_input(round(share * 0.12))),
        Phase("frames", draw.frames(max(8, round(share * 0.012)))),
        Phase("what-ifs", draw.what_ifs(batches, round(share * 0.06))),
        Phase("overlapping batches", draw.overlapping(round(share * 0.08)), at_once=16),
        Phase("replays", draw.replays(max(30, round(share * 0.05)))),
        Phase("limits and alarms", draw.alarms()),
        Phase("zones", draw.zones()),
        Phase("comparisons and advice", _computed_reads()),
        Phase("reading", reads(batches)),
    ]


class _Draw:
    """Draws all requests from one seed."""

    def __init__(self, seed: int, folder: Path) -> None:
        self._seed = seed
        self._rng = np.random.default_rng(seed)
        self._sky = SkyModel(load_embedded(), LruCache(256 << 20))
        self._missions: Mapping[str, Mission] = load_missions(folder)
        self._passes = 0

    def _pass(self, mission: str, batches: int, **wanted: Any) -> Iterator[Json]:
        """Batches of a pass; each pass of a spacecraft is on other days."""
        self._passes += 1
        trouble, day, month = 0.12, 1 + self._passes // 12, 1 + self._passes % 12
        settings: Json = {
            "batches": max(batches, 1),
            "seed": self._seed + self._passes,
            # Of two years: for each the service builds run catalogs and indexes of the sky.
            "start": f"{YEARS[self._passes % 2]}-{month:02d}-{day:02d}T00:00:00.000Z",
            "prior": "mixed",
            "troubles": Troubles(
                Trouble(trouble), Trouble(trouble, 1), Trouble(trouble, 0.5), Trouble(trouble, 12.0)
            ),
            "aberration": {"to_correct": 0.7, "applied_upstream": 0.15, "ignore": 0.15},
            **wanted,
        }
        for each in draw_pass(self._missions[mission], self._sky, Pass(**settings)):
            yield each.batch

    def batches(self, count: int) -> list[Request]:
        """Batch requests for all missions, identifiers, a priori kinds and options."""
        rng = self._rng
        most = -(-count // len(MISSIONS))
        passes = {
            (mission, prior): self._fields(mission, most, prior)
            for mission in MISSIONS
            for prior in PRIORS[:2]
        }
        found = []
        for k in range(count):
            mission = MISSIONS[k % len(MISSIONS)]
            identifier = IDENTIFIERS[k // len(MISSIONS) % len(IDENTIFIERS)]
            prior = PRIORS[k // (len(MISSIONS) * len(IDENTIFIERS)) % len(PRIORS)]
            # For a tracker off the zone's axis a direction alone does not determine its boresight.
            drawn_as: PriorKind = (
                "direction" if prior == "direction" and mission != TWIN else "quaternion"
            )
            body = next(passes[mission, drawn_as])
            self._vary(body)
            if prior == "none":
                body["a_priori"] = None
            if identifier != "verified" or rng.random() < 0.5:
                body["options"]["identifier"] = identifier
            name = body["batch"] = f"batch-{k}"
            known = next(iter(body["a_priori"] or {"none": None}))
            trackers = ", two trackers" if mission == TWIN else ""
            found.append(_submit(f"batch: {identifier}, prior {known}{trackers}", name, body))
        return found

    def _fields(self, mission: str, most: int, prior: PriorKind) -> Iterator[Json]:
        """Batches with fields of few stars and of many, alternating."""
        few = self._pass(mission, most, prior=prior)
        many = self._pass(mission, most, prior=prior, stars=25)
        while True:
            yield next(few)
            yield next(few)
            yield next(many)

    def _vary(self, body: Json) -> None:
        """Randomly change optional parts of a batch, and its options."""
        rng = self._rng
        stars = [star for each in body["observations"] for star in each["stars"]]
        options: Json = {}
        if rng.random() < 0.3:
            options["solver"] = "triad"
        if rng.random() < 0.25:
            tests = ("magnitude", "cross_product", "fov_rotation", "match_groups")
            options["tests"] = {name: bool(rng.random() < 0.5) for name in tests}
        if rng.random() < 0.3:
            options["tolerances"] = {
                "separation_deg": round(float(rng.uniform(0.001, 0.02)), 5),
                "magnitude_mag": round(float(rng.uniform(0.2, 1.5)), 3),
            }
        if rng.random() < 0.2:
            options["zone_grid_deg"] = float(rng.choice([0.0, 0.5, 2.0]))
        body["options"] = options
        if rng.random() < 0.1:
            for star in stars:
                star.pop("magnitude", None)
        if rng.random() < 0.15:
            for star in stars:
                star["sigma_arcsec"] = round(float(rng.uniform(0.5, 20.0)), 3)
        if rng.random() < 0.1:
            for name in ("velocity_km_per_s", "position_km"):
                body.pop(name, None)
        if rng.random() < 0.1:
            body.pop("body_rates_deg_per_s", None)
        if rng.random() < 0.06:
            for star in stars:
                if "vector" in star:
                    star["vector"][0] *= -1.0
        if rng.random() < 0.06 and "quaternion" in (body["a_priori"] or {}):
            quaternion = rng.normal(size=4)
            quaternion /= np.linalg.norm(quaternion)
            body["a_priori"] = {"quaternion": quaternion.tolist(), "frame": "ICRF"}
        if rng.random() < 0.05:
            for each in body["observations"]:
                each["stars"] = each["stars"][:1]

    def overlapping(self, count: int) -> list[Request]:
        """Batches of a separate run, whose answers must not depend on their order."""
        found = []
        passes = {name: self._pass(name, count) for name in ("XTE", "SOHO")}
        for k in range(count):
            name = f"overlapping-{k}"
            body = next(passes["XTE" if k % 2 else "SOHO"]) | {"batch": name, "run": "overlapping"}
            found.append(_submit("batch: overlapping", name, body))
        return found

    def bad_input(self, count: int) -> list[Request]:
        """Faulty batch requests: each known fault, then random changes of bytes."""
        good = next(self._pass("XTE", 1))
        found = [
            *(
                _submit("bad input: fields", f"fault-{name}", body)
                for name, body in faulty_batches(good)
            ),
            *_bad_bodies(good),
            *_bad_addresses(),
        ]
        text = json.dumps(good).encode()
        for k in range(max(0, count - len(found))):
            changed = _mutated(text, self._rng)
            name = f"changed-{k}"
            found.append(Request("bad input: bytes", name, "POST", f"{API}/batches", changed, JSON))
        return found

    def frames(self, count: int) -> list[Request]:
        """Frame requests: every format and point spread, good and bad; and pictures of frames."""
        mission = self._missions["IMAGER"]
        path = f"{API}/spacecraft/IMAGER/frames"
        formats: tuple[FrameFormat, ...] = ("fits", "tiff", "png", "npy")
        types = {"fits": "application/fits", "tiff": "image/tiff", "png": "image/png"}
        found: list[Request] = []
        file, known = b"", ""
        for k in range(count):
            settings = FrameSettings(
                frames=1,
                seed=self._seed + k,
                psf=("gaussian", "airy", "cross")[k % 3] if k % 2 else "gaussian",
                a_priori_error_deg=None if k % 4 == 3 else 1.0,
            )
            (drawn,) = draw_frames(mission, self._sky, settings)
            file_format = formats[k % len(formats)]
            query: Json = dict(drawn.known) | {"batch": f"frame-{k}"}
            if k % 5 == 1:
                query["centroid"] = ("window", "scan", "recursive")[k % 3]
            if k % 7 == 2:
                query["options"] = {"solver": "triad"}
            file, known = frame_bytes(drawn, file_format), _query(query | {"batch": "bad-frame"})
            headers = {"Content-Type": types.get(file_format, "application/octet-stream")}
            name = f"frame-{k}"
            found.append(Request("frame", name, "POST", f"{path}?{_query(query)}", file, headers))
        overlay = f"{API}/batches/{{frame-0:id}}/overlay"
        bad = {
            "cut-off": (path, known, file[:5760]),
            "no-picture": (path, known, b"not a picture"),
            "no-camera": (f"{API}/spacecraft/XTE/frames", known, file),
            "no-spacecraft": (f"{API}/spacecraft/NOPE/frames", known, file),
            "bad-query": (path, f"{known}&exposure_s=long&colour=red", file),
            "bad-options": (path, f"{known}&options=%7B", file),
            "empty": (path, known, b""),
        }
        octets = {"Content-Type": "application/octet-stream"}
        return [
            *found,
            *(
                Request("frame: bad", f"frame-{name}", "POST", f"{where}?{query}", body, octets)
                for name, (where, query, body) in bad.items()
            ),
            _get("frame: overlay", "overlay", overlay),
            Request(
                "frame: repeat",
                "frame-again",
                "POST",
                found[0].path,
                found[0].content,
                found[0].headers,
            ),
        ]

    def what_ifs(self, batches: Sequence[Request], count: int) -> list[Request]:
        """Requests with other options for recorded batches: shown, recorded, adopted, refused."""
        rng, found = self._rng, []
        for k in range(count):
            one = batches[int(rng.integers(len(batches)))]
            body: Json = {"options": {"solver": "triad"} if k % 3 == 0 else {}}
            if k % 3 == 1:
                body["options"]["tolerances"] = {"separation_deg": 0.02, "magnitude_mag": 1.0}
            if k % 3 == 2:
                body["options"]["identifier"] = IDENTIFIERS[k % 4]
            if k % 4 == 1:
                body["record"] = True
            if k % 4 == 2:
                body["adopt"] = True
            path = f"{API}/batches/{{{one.name}:id}}/what-if"
            found.append(_post("what-if", f"what-if-{k}", path, body))
        first = f"{API}/batches/{{{batches[0].name}:id}}/what-if"
        unknown = f"{API}/batches/01JD0000000000000000000000/what-if"
        return [
            *found,
            _post("what-if: bad", "what-if-tests", first, {"options": {"tests": {"colour": True}}}),
            _post("what-if: bad", "what-if-unknown", unknown, {"options": {}}),
            _post("what-if: bad", "what-if-empty", first, {}),
        ]

    def replays(self, count: int) -> list[Request]:
        """Replay requests: a file with some bad lines, a repeat, a compressed and a broken file."""
        lines = []
        for k, body in enumerate(self._pass("SWAS", count)):
            if k % 17 == 11:
                body["spacecraft"] = "NOPE"
            text = json.dumps(body | {"batch": f"line-{k}"})
            lines.append(text[: len(text) // 2] if k % 23 == 13 else text)
        file = "\n".join([*lines, "", "null", "[]", '{"batch": 3}', ""]).encode()
        packed = gzip.compress(file, mtime=0)
        ndjson = {"Content-Type": "application/x-ndjson"}
        coded = ndjson | {"Content-Encoding": "gzip"}
        path, found = f"{API}/replays?run=", []
        for name, run, content, headers in (
            ("plain", "replayed", file, ndjson),
            ("again", "replayed", file, ndjson),
            ("packed", "packed", packed, coded),
            ("damaged", "damaged", packed[: len(packed) // 2], coded),
            ("nothing", "nothing", b"", ndjson),
        ):
            begun = f"replay-{name}"
            found.append(Request("replay", begun, "POST", path + run, content, headers))
            address = f"{API}/replays/{{{begun}:id}}"
            found.append(Request("replay", f"{begun}-end", "GET", address, until_ended=True))
        return [
            *found,
            Request("replay: bad", "replay-no-run", "POST", f"{API}/replays", file, ndjson),
            Request("replay: bad", "replay-bad-run", "POST", f"{path}a%20b", file, ndjson),
            Request("replay: bad", "replay-type", "POST", f"{path}x", file, JSON),
            Request("replay: bad", "replay-over", "DELETE", f"{API}/replays/{{replay-plain:id}}"),
        ]

    def alarms(self) -> list[Request]:
        """Alarm requests: changed limits, alarms of a watched run, and actions on them."""
        limit = f"{API}/spacecraft/SWAS/limits/no_attitude_share"
        who = {"who": "J. Operator", "comment": "compared"}
        settings = {"warning": {"high": 0.5}, "minimum_count": 2, "duration_s": 0}
        raised = []
        for k, body in enumerate(islice(self._pass("SWAS", 12), 12)):
            if k < 8:
                for each in body["observations"]:
                    each["stars"] = each["stars"][:1]
            body |= {"batch": f"watched-{k}", "run": "watched"}
            raised.append(_submit("batch: watched", f"watched-{k}", body))
        every = f"{API}/alarms?run=watched&state=all"
        alarm = f"{API}/alarms/{{alarms-raised:items.0.id}}"
        acts: tuple[tuple[str, Json], ...] = (
            ("comment", who),
            ("shelve", who | {"minutes": 60}),
            ("unshelve", who),
            ("unshelve", who),
            ("acknowledge", who),
            ("acknowledge", who),
            ("shelve", who | {"minutes": -1}),
            ("comment", {"who": ""}),
        )
        return [
            _put("limit", "limit-set", limit, {"settings": settings, **who}),
            _put("limit", "limit-bad", limit, {"settings": {"warning": {"high": "x"}}, **who}),
            _put("limit", "limit-unknown", f"{limit}x", {"settings": settings, **who}),
            _put("limit", "run-watched", f"{API}/runs/watched", {"alarms": True}),
            *raised[:8],
            _get("alarm", "alarms-raised", every),
            *raised[8:],
            _get("alarm", "alarms-after", every),
            *(
                _post("alarm", f"alarm-{k}-{act}", f"{alarm}/{act}", body)
                for k, (act, body) in enumerate(acts)
            ),
            _get("alarm", "alarm-record", alarm),
            _get("alarm", "alarm-unknown", f"{API}/alarms/01JD0000000000000000000000"),
            Request("limit", "limit-reset", "DELETE", f"{limit}?who=J.%20Operator"),
            _get("limit", "limit-history", limit),
        ]

    def zones(self) -> list[Request]:
        """Zone requests: zones built in advance, and dropped."""
        body = next(self._pass("XTE", 1))
        asked = {"spacecraft": "XTE", "time": body["time"], "a_priori": [body["a_priori"]]}
        path = f"{API}/zones"
        return [
            _post("zones", "zones-warmed", path, asked),
            _post("zones", "zones-bad", path, asked | {"time": "noon"}),
            _post("zones", "zones-unknown", path, asked | {"spacecraft": "NOPE"}),
            Request("zones", "zones-dropped", "DELETE", path),
            _get("zones", "zones-empty", path),
        ]


def faulty_batches(good: Json) -> Iterator[tuple[str, Any]]:
    """Faulty versions of a batch: one for each fault of a field."""
    star = good["observations"][0]["stars"][0]
    tracker = good["observations"][0]
    for name in ("spacecraft", "batch", "time", "a_priori", "observations"):
        yield f"without-{name}", {key: value for key, value in good.items() if key != name}
    changed: dict[str, Json] = {
        "spacecraft-unknown": {"spacecraft": "NOPE"},
        "spacecraft-number": {"spacecraft": 5},
        "batch-empty": {"batch": ""},
        "batch-long": {"batch": "b" * 129},
        "batch-control": {"batch": "a\nb"},
        "time-word": {"time": "noon"},
        "time-zone": {"time": "1999-03-01T00:00:00+01:00"},
        "time-range": {"time": "1999-02-30T00:00:00Z"},
        "time-early": {"time": "1700-01-01T00:00:00Z"},
        "run-bad": {"run": "a b"},
        "run-long": {"run": "r" * 65},
        "prior-empty": {"a_priori": {}},
        "prior-two": {"a_priori": {"quaternion": [0, 0, 0, 1], "sun_pointed": True}},
        "prior-norm": {"a_priori": {"quaternion": [0, 0, 0, 2]}},
        "prior-short": {"a_priori": {"quaternion": [0, 0, 1]}},
        "prior-kind": {"a_priori": {"sun_pointed": True}},
        "prior-dec": {"a_priori": {"boresight": {"ra_deg": 0, "dec_deg": 91}}},
        "prior-frame": {"a_priori": {"quaternion": [0, 0, 0, 1], "frame": "B1950"}},
        "rates-large": {"body_rates_deg_per_s": [400, 0, 0]},
        "rates-word": {"body_rates_deg_per_s": ["1", 0, 0]},
        "velocity-large": {"velocity_km_per_s": [101, 0, 0]},
        "sun-norm": {"sun_vector": [1, 1, 0]},
        "aberration": {"aberration": "maybe"},
        "extra": {"velocity_km_s": [1, 0, 0]},
        "many-faults": {"time": "noon", "aberration": "maybe", "colour": "red", "run": ""},
        "no-trackers": {"observations": []},
        "no-stars": {"observations": [tracker | {"stars": []}]},
        "tracker-unknown": {"observations": [tracker | {"tracker": "STARTRACKER_9"}]},
        "tracker-twice": {"observations": [tracker, tracker]},
        "many-trackers": {
            "observations": [tracker | {"tracker": f"T{k}"} for k in range(100)],
        },
        "many-stars": {"observations": [tracker | {"stars": [star] * 2000}]},
        "identifier": {"options": {"identifier": "guess"}},
        "solver": {"options": {"solver": "svd"}},
        "option-extra": {"options": {"speed": 3}},
        "tolerance-negative": {"options": {"tolerances": {"separation_deg": -1}}},
        "tolerance-extra": {"options": {"tolerances": {"septol": 1}}},
        "test-word": {"options": {"tests": {"magnitude": "yes"}}},
        "grid-large": {"options": {"zone_grid_deg": 100}},
    }
    for name, values in changed.items():
        yield name, good | {"batch": name} | values
    stars: dict[str, Json] = {
        "star-empty": {},
        "star-norm": {"vector": [0, 0, 1.1]},
        "star-both": {"vector": [0, 0, 1], "h_deg": 1, "v_deg": 1},
        "star-half": {"h_deg": 1},
        "star-angle": {"h_deg": 90, "v_deg": 0},
        "star-magnitude": {"vector": [0, 0, 1], "magnitude": 31},
        "star-true": {"vector": [0, 0, 1], "magnitude": True},
        "star-sigma": {"vector": [0, 0, 1], "sigma_arcsec": 0},
        "star-offset": {"vector": [0, 0, 1], "time_offset_s": 4000},
        "star-extra": {"vector": [0, 0, 1], "colour": "red"},
        "star-behind": {"vector": [0, 0, -1]},
    }
    for name, value in stars.items():
        yield name, good | {"batch": name, "observations": [tracker | {"stars": [value]}]}
    for name, body in (("null", None), ("list", [good]), ("text", "batch"), ("number", 5)):
        yield name, body


def _bad_bodies(good: Json) -> Iterator[Request]:
    text = json.dumps(good).encode()
    bodies: dict[str, tuple[bytes, Mapping[str, str]]] = {
        "truncated": (text[:-9], JSON),
        "empty": (b"", JSON),
        "latin": ('{"spacecraft": "Ä"}'.encode("latin-1"), JSON),
        "nan": (text.replace(b"to_correct", b"NaN").replace(b'"NaN"', b"NaN"), JSON),
        "deep": (b"[" * 5000, JSON),
        "two": (text + text, JSON),
        "no-type": (text, {}),
        "wrong-type": (text, {"Content-Type": "text/plain"}),
        "packed": (gzip.compress(text, mtime=0), JSON | {"Content-Encoding": "gzip"}),
        "too-large": (text + b" " * (2 << 20), JSON),
        "long-key": (text, JSON | {"Idempotency-Key": "k" * 300}),
    }
    for name, (content, headers) in bodies.items():
        yield Request(
            "bad input: bodies", f"body-{name}", "POST", f"{API}/batches", content, headers
        )


def _bad_addresses() -> Iterator[Request]:
    for k, (method, path) in enumerate(
        (
            ("GET", f"{API}/nothing"),
            ("GET", "/nothing"),
            ("PUT", f"{API}/batches"),
            ("DELETE", f"{API}/batches/01JD0000000000000000000000"),
            ("GET", f"{API}/batches/01JD0000000000000000000000"),
            ("GET", f"{API}/batches/not-an-id"),
            ("GET", f"{API}/batches?limit=ten"),
            ("GET", f"{API}/batches?limit=0"),
            ("GET", f"{API}/batches?cursor=nonsense"),
            ("GET", f"{API}/batches?colour=red"),
            ("GET", f"{API}/batches?start=noon"),
            ("GET", f"{API}/batches?spacecraft=NOPE"),
            ("GET", f"{API}/spacecraft/NOPE"),
            ("GET", f"{API}/spacecraft/XTE/rates?bucket=week"),
            ("GET", f"{API}/spacecraft/XTE/history?quantity=colour"),
            ("GET", f"{API}/spacecraft/XTE/history?size=0"),
            ("GET", f"{API}/spacecraft/XTE/worst?by=colour"),
            ("GET", f"{API}/spacecraft/XTE/advice?tolerance=septol=1"),
            ("GET", f"{API}/spacecraft/XTE/limits/colour"),
            ("GET", f"{API}/alarms?state=asleep"),
            ("GET", f"{API}/replays/01JD0000000000000000000000"),
            ("DELETE", f"{API}/replays/01JD0000000000000000000000"),
            ("GET", f"{API}/runs?limit=3"),
            ("PATCH", f"{API}/runs/x"),
            ("GET", f"{API}/events?last_event_id=x"),
        )
    ):
        yield Request("bad input: addresses", f"address-{k}", method, path)


def _mutated(text: bytes, rng: np.random.Generator) -> bytes:
    """Text with random changes at one to three places."""
    changed = bytearray(text)
    tokens = (b'"', b",", b"{", b"}", b"[", b"]", b"null", b"true", b"1e999", b"-", b"\\ud800")
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(len(changed)))
        end = at + int(rng.choice([1, 2, 4, 40]))
        match int(rng.integers(4)):
            case 0:
                changed[at] ^= 1 << int(rng.integers(7))
            case 1:
                del changed[at:end]
            case 2:
                changed[at:end] = tokens[int(rng.integers(len(tokens)))]
            case _:
                changed[at:at] = changed[at:end]
    return bytes(changed)


def _repeats(batches: Sequence[Request], count: int) -> Iterator[Request]:
    """Repeated batches, other bodies under the same id, and requests with idempotency keys."""
    for k, one in enumerate(batches[:: max(1, len(batches) // max(count // 3, 1))]):
        yield Request("repeat", f"repeat-{k}", "POST", one.path, one.content, JSON)
        other = json.loads(one.content) | {
            "aberration": "ignore",
            "body_rates_deg_per_s": [1, 0, 0],
        }
        yield _submit("repeat: conflict", f"conflict-{k}", other)
        headers = JSON | {"Idempotency-Key": f"key-{k // 2}"}
        yield Request("repeat: key", f"key-{k}", "POST", one.path, one.content, headers)
        moved = json.dumps(other | {"batch": f"keyed-{k}"}).encode()
        yield Request("repeat: key", f"key-other-{k}", "POST", one.path, moved, headers)


def _computed_reads() -> list[Request]:
    found = []
    for name, options in (
        ("tight", {"tolerances": {"separation_deg": 1e-5}}),
        ("triad", {"solver": "triad"}),
        ("starid", {"identifier": "starid"}),
    ):
        for spacecraft in ("XTE", "SOHO"):
            body = {"spacecraft": spacecraft, "sample": 10, "b": options}
            found.append(_post("compare", f"compare-{name}-{spacecraft}", f"{API}/compare", body))
    found.append(_post("compare", "compare-bad", f"{API}/compare", {"sample": 10}))
    for spacecraft, query in (
        ("XTE", "sample=12"),
        ("SOHO", "sample=12&tolerance=separation_deg=0.01"),
        ("SWAS", "sample=12&run=replayed"),
    ):
        path = f"{API}/spacecraft/{spacecraft}/advice?{query}"
        found.append(_get("advice", f"advice-{spacecraft}", path))
    return found


RUNS = ("live", "overlapping", "replayed", "watched", "nothing-here")


def reads(batches: Sequence[Request]) -> list[Request]:
    """Requests of all read routes for all recorded data, and of the console's pages."""
    paths: list[tuple[str, str]] = []
    for run in RUNS:
        paths += [
            ("read: spacecraft", f"{API}/spacecraft?run={run}"),
            ("read: overview", f"{API}/overview?run={run}"),
            ("read: batches", f"{API}/batches?run={run}&limit=200"),
            ("read: alarms", f"{API}/alarms?run={run}&state=all"),
        ]
        for name in MISSIONS:
            here = f"{API}/spacecraft/{name}"
            paths += [
                ("read: spacecraft", f"{here}?run={run}"),
                ("read: attitudes", f"{here}/attitudes?run={run}&limit=200"),
                ("read: rates", f"{here}/rates?run={run}"),
                ("read: rates", f"{here}/rates?run={run}&bucket=day"),
                ("read: history", f"{here}/history?run={run}&size=40"),
                ("read: history", f"{here}/history?run={run}&strategy=latest&size=30"),
                ("read: export", f"{here}/history?run={run}&format=csv"),
                ("read: export", f"{here}/history?run={run}&format=csv&size=20"),
            ]
            for by in ("ambiguous_share", "residual_ratio", "a_priori_angle_deg"):
                paths.append(("read: worst", f"{here}/worst?run={run}&by={by}"))
    for outcome in ("unique", "ambiguous", "unmatched"):
        paths.append(("read: batches", f"{API}/batches?outcome={outcome}&limit=50"))
    for status in ("good", "suspect", "none"):
        paths.append(("read: batches", f"{API}/batches?status={status}&run=*&limit=50"))
    for name in MISSIONS:
        paths.append(("read: limits", f"{API}/spacecraft/{name}/limits"))
        paths.append(("read: batches", f"{API}/batches?spacecraft={name}&run=*&limit=100"))
    for one in batches[:: max(1, len(batches) // 150)]:
        paths.append(("read: batch", f"{API}/batches/{{{one.name}:id}}"))
    for one in batches[:: max(1, len(batches) // 10)]:
        paths.append(("read: page", f"/batches/{{{one.name}:id}}"))
    paths.append(("read: batch", f"{API}/batches/{{frame-0:id}}"))
    paths.append(("read: batch", f"{API}/batches/{{what-if-1:id}}"))
    for page in ("/", "/alarms", "/batches", "/runs", "/missions", "/about", "/compare"):
        paths.append(("read: page", page))
    for page in ("/spacecraft/XTE", "/spacecraft/SOHO/limits", "/spacecraft/NOPE", "/sign-in"):
        paths.append(("read: page", page))
    for name in ("runs", "replays", "about", "session", "audit?limit=500"):
        paths.append((f"read: {name.partition('?')[0]}", f"{API}/{name}"))
    paths += [("read: probe", "/livez"), ("read: probe", "/readyz"), ("read: metrics", "/metrics")]
    return [_get(kind, f"read-{k}", path) for k, (kind, path) in enumerate(paths)]


def _query(values: Mapping[str, Any]) -> str:
    return urlencode(
        {
            name: value if isinstance(value, str) else json.dumps(value)
            for name, value in values.items()
        }
    )


def _submit(kind: str, name: str, body: Any) -> Request:
    return _post(kind, name, f"{API}/batches", body)


def _post(kind: str, name: str, path: str, body: Any) -> Request:
    return Request(kind, name, "POST", path, json.dumps(body).encode(), JSON)


def _put(kind: str, name: str, path: str, body: Any) -> Request:
    return Request(kind, name, "PUT", path, json.dumps(body).encode(), JSON)


def _get(kind: str, name: str, path: str) -> Request:
    return Request(kind, name, "GET", path)
