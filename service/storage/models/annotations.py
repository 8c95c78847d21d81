"""Annotations: notes that people write on times and periods."""

from typing import Annotated, ClassVar

from service.storage.models.base import Id, Moment, Record, Stamp, doc


class Annotation(Record, frozen=True, kw_only=True):
    """A note on a time or a period, signed by its author."""

    component: ClassVar[str] = "Annotation"
    id: Id
    spacecraft: Annotated[str | None, doc("null: it is about every spacecraft.")]
    start: Annotated[Moment, doc("Telemetry time.")]
    end: Annotated[Moment | None, doc("null: the note is about a moment.")]
    text: str
    who: str
    created: Stamp


class AnnotationPage(Record, frozen=True, kw_only=True):
    """A page of annotations."""

    component: ClassVar[str] = "AnnotationPage"
    items: list[Annotation]
    next_cursor: str | None


class AnnotationChange(Annotation, frozen=True, kw_only=True):
    """The data of an event: an annotation that was written or deleted."""

    component: ClassVar[str] = "AnnotationEvent"
    deleted: bool
