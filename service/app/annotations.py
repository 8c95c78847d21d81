"""Annotations: notes that people write about times and periods."""

import dataclasses

import msgspec
from sqlalchemy import Connection

from service.access import Entry
from service.app.context import Context, known_id
from service.contract.alarms import Annotation
from service.contract.base import Page
from service.ingest.solver_pool import mission_in_input
from service.storage.recording import events
from service.storage.recording.ids import Ulids
from service.times import Utc, utc_now


class Annotations:
    """Service for annotations; an `entry` adds the change to the audit list."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._ids = Ulids()

    def page(
        self,
        *,
        spacecraft: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page[Annotation]:
        """Page of the annotations in a period, newest first; see `list_annotations`."""
        with self._context.reading() as connection:
            return events.list_annotations(
                connection, spacecraft=spacecraft, start=start, end=end, limit=limit, cursor=cursor
            )

    def get(self, id: str) -> Annotation:
        """Return the annotation with an id; raises `NotFound`."""
        with self._context.reading() as connection:
            return events.read_annotation(connection, known_id(id, "annotation"))

    def add(
        self,
        text: str,
        *,
        start: Utc,
        who: str,
        end: Utc | None = None,
        spacecraft: str | None = None,
        entry: Entry | None = None,
    ) -> Annotation:
        """Write an annotation about a moment or a period, and about one spacecraft or all.

        Raises `BadInput` for a spacecraft without a mission file.
        """
        if spacecraft is not None:
            mission_in_input(self._context.missions, spacecraft)
        row = {
            "id": self._ids.new(),
            "spacecraft": spacecraft,
            "start": start.text,
            "start_ns": start.tai_ns,
            "end": None if end is None else end.text,
            "end_ns": (end or start).tai_ns,
            "text": text,
            "who": who,
            "created": utc_now().text,
        }
        return self._context.change_audited(
            lambda connection: events.add_annotation(connection, row), entry
        )

    def delete(
        self, id: str, who: str, comment: str | None = None, entry: Entry | None = None
    ) -> Annotation:
        """Delete an annotation; the audit list keeps it, who deleted it, and the comment."""
        known = known_id(id, "annotation")

        def change(connection: Connection) -> Annotation:
            deleted = events.delete_annotation(connection, known)
            if entry is not None:
                signed = {"who": who, "comment": comment, "deleted": deleted}
                body = msgspec.json.encode(signed).decode()
                dataclasses.replace(entry, body=body).add_to(connection)
            return deleted

        return self._context.change(change)
