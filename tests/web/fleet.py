"""A fleet in the records: copies of a mission, two trackers each, six of them in trouble.

The rows are written as the writer would write them, without any star's vector: what a
page of all spacecraft shows does not depend on those.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, insert

from service.app.factory import App
from service.features.alarms.tables import alarm_actions, alarms
from service.missions.mission import load_missions
from service.storage.recording.ids import Ulids
from service.storage.sql.statements import insert_all
from service.storage.sql.tables import solutions, star_results
from service.times import DAY_S, Utc, parse_utc, shifted, utc_now
from service.trends.quantities import QUANTITIES
from tests.storage.bulk import put, result_row

END = parse_utc("1999-03-02T00:00:00.000Z")
BATCHES, CADENCE_S = 48, 1800.0
SILENT_S = 6.5 * 3600.0
IN_TROUBLE = 6
QUANTITIES_OUT = ("unmatched_share", "ambiguous_share", "no_attitude_share", "suspect_share")
SHIPPED = Path(__file__).parents[2] / "service" / "missions" / "xte.toml"
TRACKER = "[[trackers]]"


def names(size: int) -> list[str]:
    """The spacecraft of a fleet."""
    return [f"SAT-{k:03d}" for k in range(size)]


def troubled(size: int) -> list[str]:
    """Those in trouble, somewhere in the middle of their names."""
    return names(size)[size // 2 : size // 2 + IN_TROUBLE]


def write_missions(folder: Path, size: int) -> Path:
    """A mission file for each spacecraft."""
    text = SHIPPED.read_text(encoding="utf-8")
    body, _, tracker = text.partition(TRACKER)
    second = tracker.replace("STARTRACKER_1", "STARTRACKER_2")
    folder.mkdir(exist_ok=True)
    for name in names(size):
        whole = f"{body}{TRACKER}{tracker}\n{TRACKER}{second}".replace(
            'name = "XTE"', f'name = "{name}"'
        )
        (folder / f"{name.lower()}.toml").write_text(whole, encoding="utf-8")
    load_missions(folder)
    return folder


def fill(app: App, size: int, run: str = "live", silent: str | None = None) -> None:
    """A day of every spacecraft, the last hours of some in trouble, with their alarms.

    The latest batches were received now; those of `silent` end six and a half hours before.
    """
    in_trouble = troubled(size)
    pairs = [pair for name in names(size) for pair in _batches(app, name, name in in_trouble, run)]
    present = utc_now()
    for batch, _ in pairs:
        behind_s = (END.tai_ns - batch["time_ns"]) * 1e-9
        batch["received"] = shifted(present, -behind_s).text
    pairs = [
        (batch, result)
        for batch, result in pairs
        if batch["spacecraft"] != silent or END.tai_ns - batch["time_ns"] >= SILENT_S * 1e9
    ]
    put(app, pairs)
    latest = [result for _, result in pairs if result["time_ns"] == END.tai_ns]
    raised = [_alarm(name, k, run) for k, name in enumerate(in_trouble)]

    def write(connection: Connection) -> None:
        insert_all(connection, star_results, [star for each in latest for star in _stars(each)])
        solved = [_solution(each) for each in latest if each["status"]]
        insert_all(connection, solutions, solved)
        connection.execute(insert(alarms), raised)

    app.store.writer.change(write)


def _batches(app: App, name: str, is_bad: bool, run: str) -> Iterator[tuple[Any, Any]]:
    for k in range(BATCHES):
        time = shifted(END, (k + 1 - BATCHES) * CADENCE_S)
        wrong = {"unmatched": 4, "status": None, "reason": "no_consistent_attitude"}
        values: dict[str, Any] = {"observed": 10, "unique": 10}
        if is_bad and k > BATCHES - 10:
            values |= wrong | {"unique": 6}
        elif (k + len(name) * hash_of(name)) % 7 == 0:
            values |= {"ambiguous": 1, "unique": 9}
        yield result_row(app, time, spacecraft=name, run=run, name=name, **values)


def hash_of(name: str) -> int:
    """A small number that is the same in every process."""
    return sum(map(ord, name))


def _stars(result: dict[str, Any]) -> list[dict[str, Any]]:
    outcomes = ["unique"] * result["unique"] + ["unmatched"] * (10 - result["unique"])
    return [
        {
            "result_id": result["id"],
            "tracker": f"STARTRACKER_{1 + k // 5}",
            "position": k % 5,
            "outcome": outcome,
            "star_id": "HIP 26311" if outcome == "unique" else None,
            "votes": 4,
            "runner_up": 0,
            "probability": None,
            "residual_arcsec": 1.0,
        }
        for k, outcome in enumerate(outcomes)
    ]


def _solution(result: dict[str, Any]) -> dict[str, Any]:
    parts = {"q1": 0.0, "q2": 0.0, "q3": 0.0, "qc": 1.0, "frame": "EME2000"}
    variance = {"p11": 4.0, "p12": 0.0, "p13": 0.0, "p22": 4.0, "p23": 0.0, "p33": 9.0}
    fit = {"residual_rms_arcsec": 2.0, "predicted_rms_arcsec": 2.0, "taste": 1.0}
    how = {"method": "quest", "status": result["status"]}
    return {"result_id": result["id"], **parts, **variance, **fit, **how}


def _alarm(name: str, number: int, run: str) -> dict[str, Any]:
    quantity = QUANTITIES_OUT[number % len(QUANTITIES_OUT)]
    assert quantity in QUANTITIES
    since = shifted(END, -4 * 3600.0)
    severity = ("critical", "warning")[number % 2]
    return {
        "id": Ulids().new(),
        "spacecraft": name,
        "run": run,
        "quantity": quantity,
        "severity": severity,
        "current_severity": severity,
        "raised_at": since.text,
        "bound": 0.25,
        **_place("raised", since),
        **_place("worst", END),
        **_place("latest", END),
    }


def put_alarm(
    app: App,
    name: str,
    actions: Sequence[tuple[str, float]],
    in_limits: bool = False,
    **columns: Any,
) -> None:
    """An alarm of a spacecraft with what its value did, by hours after the day's start."""
    begin = shifted(END, -DAY_S)
    places = [(action, shifted(begin, 3600.0 * hours)) for action, hours in actions]
    alarm = _alarm(name, 0, "live")
    alarm |= _place("raised", places[0][1]) | _place("latest", places[-1][1]) | columns
    if in_limits:
        alarm |= {"current_severity": None, "returned_at": utc_now().text}
    rows = [
        {"alarm_id": alarm["id"], "at": utc_now().text, "action": action, "time": time.text}
        for action, time in places
    ]

    def write(connection: Connection) -> None:
        connection.execute(insert(alarms), [alarm])
        connection.execute(insert(alarm_actions), rows)

    app.store.writer.change(write)


def _place(which: str, time: Utc) -> dict[str, Any]:
    return {f"{which}_value": 0.4, f"{which}_time": time.text, f"{which}_batch_id": None}
