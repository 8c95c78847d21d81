"""Runs and replays, and the caller of the service."""

from collections.abc import Sequence

from ..base import FieldFault, Model


class Run(Model, frozen=True):
    """A named set of batches; `alarms` tells whether they can raise alarms."""

    run: str
    created: str
    alarms: bool
    batches: int
    spacecraft: Sequence[str]
    first_day: str
    last_day: str


class RunState(Model, frozen=True):
    """A run, and whether its batches can raise alarms."""

    run: str
    alarms: bool


class ReplayLines(Model, frozen=True):
    """The lines of a replay; `total` is None where it is not known in advance."""

    total: int | None
    done: int
    refused: int


class ReplayCounts(Model, frozen=True):
    """Batches, stars and gyro blocks of the lines so far.

    `attitudes` are batches with an attitude; the counts of gyro blocks may be absent.
    """

    new: int
    repeated: int
    observed: int
    unique: int
    ambiguous: int
    unmatched: int
    attitudes: int
    gyro_new: int = 0
    gyro_repeated: int = 0


class LineProblem(Model, frozen=True):
    """The faults of a line."""

    detail: str
    errors: Sequence[FieldFault] = ()


class RefusedLine(Model, frozen=True):
    """A refused line by its number, or a packet by its number in its file, from 1."""

    line: int
    problem: LineProblem


class ApidPackets(Model, frozen=True):
    """The space packets of one APID."""

    apid: int
    packets: int
    described: bool
    gaps: int
    missing: int
    backward: int
    refused: int
    incomplete: int = 0


class ReplayPackets(Model, frozen=True):
    """The space packets of a replay so far."""

    packets: int
    bytes: int
    batches: int
    without_stars: int
    gyro_blocks: int
    gyro_samples: int
    unknown: int
    not_asked: int
    idle: int
    gaps: int
    missing: int
    backward: int
    refused: int
    apids: Sequence[ApidPackets]
    joined: int = 0
    incomplete: int = 0
    unread_bytes: int = 0
    empty_files: int = 0
    without_attitude: int = 0


class ReplayProgress(Model, frozen=True):
    """A replay and how far it is; see `Replay`."""

    id: str
    run: str
    name: str
    state: str
    lines: ReplayLines
    counts: ReplayCounts
    started: str
    finished: str | None


class Replay(ReplayProgress, frozen=True):
    """A replay and its progress.

    `state` is running, waiting, done, interrupted, failed or cancelled; one that is waiting goes
    on by itself once the service is ready after a restart.  `errors` has the first thousand
    refused lines; the last error of a failed replay is the reason.
    """

    packets: ReplayPackets | None
    errors: Sequence[RefusedLine]


class Token(Model, frozen=True, kw_only=True):
    """A token without its secret; `state` is good, expired or revoked."""

    name: str
    scopes: Sequence[str]
    spacecraft: Sequence[str] | None
    rate_per_s: float | None
    created: str
    expires: str
    revoked: str | None
    state: str


class NewToken(Token, frozen=True, kw_only=True):
    """A new token with its secret, which is in this answer alone."""

    token: str


class TokenList(Model, frozen=True):
    """All tokens, the oldest first."""

    items: Sequence[Token]


class Session(Model, frozen=True):
    """The caller and its scopes; `spacecraft` is None where the token is bound to none."""

    name: str | None
    scopes: Sequence[str]
    spacecraft: Sequence[str] | None
