"""Table of replays: their progress, and the end of those that this process does not run."""

from collections.abc import Collection
from typing import Any

import msgspec
from msgspec import structs
from sqlalchemy import Connection, insert, select, update

from service.contract import runs
from service.errors import NotFound, WrongState, shown_value
from service.storage.recording import events
from service.storage.sql.tables import replays, rollups_daily

CANCELLED: runs.ReplayStateName = "cancelled"
UNFINISHED: tuple[runs.ReplayStateName, ...] = ("running", "waiting")
_NO_GYRO = {"gyro_blocks": 0, "gyro_samples": 0}
"""Gyro counts of a replay's packets recorded by an earlier version, which did not count them."""
_NO_COUNTS = dict.fromkeys(runs.ReplayCounts.__struct_fields__, 0)


def find_replay(connection: Connection, id: str) -> runs.Replay | None:
    """Find a replay and its progress by id; None if there is none."""
    row = connection.execute(select(replays).where(replays.c.id == id)).mappings().first()
    return None if row is None else _replay(row)


def read_replay(connection: Connection, id: str) -> runs.Replay:
    """Read a replay and its progress by id; raises `NotFound`."""
    replay = find_replay(connection, id)
    if replay is None:
        raise NotFound(f"there is no replay with the id {shown_value(id)}")
    return replay


def list_replays(
    connection: Connection, spacecraft: Collection[str] | None = None
) -> list[runs.Replay]:
    """List the latest replays and their progress, newest first.

    With `spacecraft`, only replays into runs whose batches are all of these.
    """
    query = select(replays).order_by(replays.c.id.desc()).limit(100)
    if spacecraft is not None:
        batches = rollups_daily.c
        own = select(batches.run).where(batches.spacecraft.in_(spacecraft))
        others = select(batches.run).where(batches.spacecraft.not_in(spacecraft))
        query = query.where(replays.c.run.in_(own), replays.c.run.not_in(others))
    return [_replay(row) for row in connection.execute(query).mappings()]


def _replay(row: Any) -> runs.Replay:
    # A row of an earlier version may have no counts.
    counts = _NO_COUNTS | msgspec.json.decode(row["counts"] or "{}")
    packets = counts.pop("packets", None)
    return runs.Replay(
        id=row["id"],
        run=row["run"],
        name=row["name"],
        state=row["state"],
        lines=runs.ReplayLines(
            total=row["lines_total"], done=row["lines_done"], refused=row["lines_refused"]
        ),
        counts=msgspec.convert(counts, runs.ReplayCounts),
        packets=None
        if packets is None
        else msgspec.convert(_NO_GYRO | packets, runs.ReplayPackets),
        errors=msgspec.json.decode(row["errors"], type=list[runs.RefusedLine]),
        started=row["started"],
        finished=row["finished"],
    )


def insert_replay(connection: Connection, replay: runs.Replay) -> None:
    """Insert the row of a new replay."""
    row = {
        "id": replay.id,
        "run": replay.run,
        "name": replay.name,
        "lines_total": replay.lines.total,
        "started": replay.started,
    }
    connection.execute(
        insert(replays), row | _progress(replay, replay.packets) | _errors(replay.errors)
    )


def update_replay(
    connection: Connection,
    progress: runs.ReplayProgress,
    packets: runs.ReplayPackets | None,
    errors: list[runs.RefusedLine] | None,
) -> None:
    """Store the progress of a replay, and its refused lines unless they are None."""
    values = _progress(progress, packets) | ({} if errors is None else _errors(errors))
    connection.execute(update(replays).where(replays.c.id == progress.id).values(values))


def _progress(progress: runs.ReplayProgress, packets: runs.ReplayPackets | None) -> dict[str, Any]:
    counts = msgspec.to_builtins(progress.counts)
    if packets is not None:
        counts["packets"] = msgspec.to_builtins(packets)
    return {
        "state": progress.state,
        "lines_done": progress.lines.done,
        "lines_refused": progress.lines.refused,
        "counts": msgspec.json.encode(counts).decode(),
        "finished": progress.finished,
    }


def _errors(errors: list[runs.RefusedLine]) -> dict[str, str]:
    return {"errors": msgspec.json.encode(errors).decode()}


def is_cancelled(connection: Connection, id: str) -> bool:
    """True if a replay was cancelled, perhaps by another process.

    Until the transaction ends no other process changes the replay.
    """
    asked = select(replays.c.state).where(replays.c.id == id).with_for_update()
    return connection.scalar(asked) == CANCELLED


def unfinished_replays(connection: Connection) -> set[str]:
    """Ids of the replays that are running or waiting to continue."""
    return set(connection.scalars(select(replays.c.id).where(replays.c.state.in_(UNFINISHED))))


def mark_interrupted(
    connection: Connection,
    now: str,
    stored: Collection[str] = (),
    only: Collection[str] | None = None,
) -> None:
    """Close the replays that a stopped process left unfinished; those in `stored` wait instead.

    With `only`, just these are closed.  If another process still runs one, that process sets its
    state to `running` again when it next stores its progress.
    """
    # A process that stopped regularly has written `interrupted` itself.
    waits = replays.c.id.in_(stored), replays.c.state.in_((*UNFINISHED, "interrupted"))
    connection.execute(update(replays).where(*waits).values(state="waiting", finished=None))
    ended = [replays.c.id.not_in(stored), replays.c.state.in_(UNFINISHED)]
    if only is not None:
        ended.append(replays.c.id.in_(only))
    connection.execute(update(replays).where(*ended).values(state="interrupted", finished=now))


def close_waiting(connection: Connection, id: str, now: str) -> None:
    """Close a waiting replay that cannot continue."""
    waiting = replays.c.id == id, replays.c.state == "waiting"
    connection.execute(update(replays).where(*waiting).values(state="interrupted", finished=now))


def mark_cancelled(connection: Connection, id: str, now: str) -> None:
    """Cancel a running replay of another process, which stops when it next stores its progress.

    Raises `NotFound`, and `WrongState` for one that has ended.
    """
    if is_cancelled(connection, id):
        return
    replay = read_replay(connection, id)
    require_cancellable(replay.state)
    if replay.state in UNFINISHED:
        ended = structs.replace(replay.progress(), state=CANCELLED, finished=now)
        update_replay(connection, ended, replay.packets, None)
        events.add_event(connection, "replay", ended, run=ended.run)


def require_cancellable(state: str) -> None:
    """Raise `WrongState` unless a replay in this state can be cancelled."""
    if state not in (*UNFINISHED, CANCELLED):
        raise WrongState(f"the replay has ended already, its state is {state}")
