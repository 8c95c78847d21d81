"""Client methods for batches, results, runs, alarms, calibrations and access.

`who` signs an action while access is open; with a token, its name does.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Literal, TypeVar

import httpx
import msgspec

from . import models
from .calls import Call, Listing, get, get_items, paged_list, post, single_request
from .encoding import Batch, Time, decoded, parameters_of, path_of
from .errors import Problem, UnexpectedAnswer
from .retrying import Repeat
from .words import Outcome, Status

T = TypeVar("T")


@dataclass(frozen=True)
class RecordedAnswer:
    """Answer as recorded: its JSON, and True if the batch was recorded before."""

    body: bytes
    replayed: bool

    @cached_property
    def answer(self) -> models.Answer:
        """Decode the recorded answer to a model."""
        try:
            return msgspec.json.decode(self.body, type=models.Answer)
        except msgspec.DecodeError as error:
            raise UnexpectedAnswer(f"this is no answer to a batch: {error}") from None


@dataclass(frozen=True)
class BatchOutcome:
    """Outcome of a submitted batch: its answer, or the problem for which it was refused."""

    batch: Batch
    recorded: RecordedAnswer | None
    problem: Problem | None

    @property
    def answer(self) -> models.Answer:
        """Answer to the batch as a model; raises the problem of a refused one."""
        if self.recorded is None:
            assert self.problem is not None
            raise self.problem
        return self.recorded.answer


class Results:
    """Client methods for batches, their results, and pictures."""

    @single_request
    def submit(self, batch: Batch, *, idempotency_key: str | None = None) -> Call[models.Answer]:
        """Identify the stars of a batch, solve for the attitude, and record both.

        Spacecraft, run and batch id identify the batch: to send it again is harmless, and gives
        the first answer.  Raises `BadInput` naming each field, `Conflict` where another body has
        this batch id.

        >>> answer = client.submit(batch)
        >>> answer.counts.unique, answer.attitude.status
        (4, 'good')
        """
        return _submission(batch, idempotency_key, lambda recorded: recorded.answer)

    @single_request
    def submit_json(
        self, batch: Batch, *, idempotency_key: str | None = None
    ) -> Call[RecordedAnswer]:
        """Submit a batch as `submit` does; the answer as recorded, with `replayed` for a repeat.

        >>> recorded = client.submit_json(batch)
        >>> recorded.replayed
        True
        """
        return _submission(batch, idempotency_key, lambda recorded: recorded)

    @paged_list
    def batches(
        self,
        spacecraft: str | None = None,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        outcome: Outcome | None = None,
        status: Status | Literal["no_attitude"] | None = None,
        batch: str | None = None,
    ) -> Listing[models.Summary]:
        """List the current results of recorded batches, newest first by batch time.

        `run` is `*` for all runs; `end` is excluded; `outcome` asks for at least one such star.

        >>> [found.batch for found in client.batches("XTE")]
        ['1996-010-0110']
        """
        query = {
            "spacecraft": spacecraft,
            "run": run,
            "start": start,
            "end": end,
            "outcome": outcome,
            "status": status,
            "batch": batch,
        }
        return Listing(models.Summary, path_of("batches"), query)

    @single_request
    def batch(self, id: str) -> Call[models.Result]:
        """Read a recorded result with its batch; raises `NotFound`."""
        return get(models.Result, path_of("batches", id))

    @single_request
    def latest(self, spacecraft: str, *, run: str = "live") -> Call[models.Result]:
        """Read the newest result of a spacecraft by batch time; raises `NotFound` without a batch.

        >>> latest = client.latest("XTE")
        >>> latest.answer.attitude.status
        'good'
        """
        return get(models.Result, path_of("spacecraft", spacecraft, "latest"), {"run": run})

    @single_request
    def adopt(self, id: str, options: Mapping[str, Any]) -> Call[models.Answer]:
        """Process a recorded batch again, and make the result the batch's current one.

        >>> latest = client.latest("XTE")
        >>> adopted = client.adopt(latest.answer.id, {"identifier": "verified"})
        >>> found = client.batch(adopted.id)
        >>> found.current
        True
        """
        body = {"options": dict(options), "adopt": True}
        return post(models.Answer, path_of("batches", id, "what-if"), body)

    @single_request
    def solve_picture(
        self,
        picture: bytes,
        *,
        spacecraft: str | None = None,
        field_of_view_deg: float | None = None,
    ) -> Call[models.Picture]:
        """Find the attitude, the lens and the stars of a picture of any camera; records nothing.

        `picture` is the content of its file; `spacecraft` names the spacecraft whose camera took
        it.
        """
        return Call(
            partial(decoded, kind=models.Picture),
            "POST",
            path_of("pictures"),
            query={"spacecraft": spacecraft, "field_of_view_deg": field_of_view_deg},
            content=picture,
            headers={"Content-Type": "application/octet-stream"},
            repeat=Repeat.ALWAYS,
        )


class Runs:
    """Client methods for runs and for the state of replays."""

    @single_request
    def runs(self) -> Call[list[models.Run]]:
        """List all runs with batches."""
        return get_items(models.Run, path_of("runs"))

    @single_request
    def watch_run(self, run: str, *, alarms: bool = True) -> Call[models.RunState]:
        """Switch the alarms of a run on or off; creates the run if it does not exist."""
        return Call(
            partial(decoded, kind=models.RunState),
            "PUT",
            path_of("runs", run),
            body={"alarms": alarms},
        )

    @single_request
    def replays(self) -> Call[list[models.Replay]]:
        """List the latest hundred replays, newest first."""
        return get_items(models.Replay, path_of("replays"))

    @single_request
    def cancel_replay(self, id: str) -> Call[models.Replay]:
        """Cancel a replay; recorded batches stay.  Raises `WrongState` if it has ended."""
        return Call(partial(decoded, kind=models.Replay), "DELETE", path_of("replays", id))


class Access:
    """Client methods for the caller and for tokens."""

    @single_request
    def session(self) -> Call[models.Session]:
        """Read the caller as the service knows it: the token's name, its scopes and spacecraft.

        Raises `Unauthenticated` where the service asks for a token, or for another one.

        >>> session = client.session()
        >>> session.scopes
        ['operate', 'read', 'submit']
        """
        return get(models.Session, path_of("session"))

    @single_request
    def tokens(self) -> Call[list[models.Token]]:
        """List all tokens without their secrets, the oldest first."""
        return get_items(models.Token, path_of("tokens"))

    @single_request
    def create_token(
        self,
        name: str,
        scopes: Sequence[str],
        *,
        spacecraft: Sequence[str] | None = None,
        days: int = 365,
        rate_per_s: float | None = None,
    ) -> Call[models.NewToken]:
        """Create a token; only this answer has its secret.  The first one ends open access."""
        asked = {"name": name, "scopes": list(scopes), "days": days, "rate_per_s": rate_per_s}
        asked["spacecraft"] = None if spacecraft is None else list(spacecraft)
        return post(models.NewToken, path_of("tokens"), asked)

    @single_request
    def revoke_token(self, name: str) -> Call[models.Token]:
        """Revoke a token at once and end its sessions; raises `NotFound`."""
        return Call(partial(decoded, kind=models.Token), "DELETE", path_of("tokens", name))


class Alarms:
    """Client methods for alarms."""

    @paged_list
    def alarms(
        self, spacecraft: str | None = None, *, run: str = "live", state: str = "active"
    ) -> Listing[models.Alarm]:
        """List alarms, newest first; the state `active` means all that are not cleared.

        >>> [alarm.severity for alarm in client.alarms("XTE")]
        []
        """
        query = {"spacecraft": spacecraft, "run": run, "state": state}
        return Listing(models.Alarm, path_of("alarms"), query)

    @single_request
    def alarm(self, id: str) -> Call[models.AlarmWithActions]:
        """Read an alarm with its history; raises `NotFound`."""
        return get(models.AlarmWithActions, path_of("alarms", id))

    @single_request
    def acknowledge(
        self, id: str, *, who: str | None = None, comment: str | None = None
    ) -> Call[models.AlarmWithActions]:
        """Acknowledge an alarm, which clears it if the quantity is back in limits."""
        return _act(id, "acknowledge", {"who": who, "comment": comment})

    @single_request
    def shelve(
        self, id: str, minutes: int, *, who: str | None = None, comment: str | None = None
    ) -> Call[models.AlarmWithActions]:
        """Silence an alarm for some minutes; it returns by itself."""
        return _act(id, "shelve", {"minutes": minutes, "who": who, "comment": comment})

    @single_request
    def unshelve(
        self, id: str, *, who: str | None = None, comment: str | None = None
    ) -> Call[models.AlarmWithActions]:
        """End the silence of a shelved alarm now."""
        return _act(id, "unshelve", {"who": who, "comment": comment})

    @single_request
    def comment(
        self, id: str, comment: str, *, who: str | None = None
    ) -> Call[models.AlarmWithActions]:
        """Add a comment to an alarm."""
        return _act(id, "comment", {"who": who, "comment": comment})


class Calibrations:
    """Client methods for calibrations."""

    @single_request
    def calibrate(
        self,
        spacecraft: str,
        *,
        run: str = "live",
        start: Time | None = None,
        end: Time | None = None,
        degree: int | None = None,
        time_tag: bool = False,
        who: str | None = None,
    ) -> Call[models.Calibration]:
        """Start a calibration from recorded batches; read it again until its `state` is done.

        Without a `degree`, the distortion gets the degree that fits held-out blocks of time best.
        """
        asked = parameters_of(
            {
                "spacecraft": spacecraft,
                "run": run,
                "start": start,
                "end": end,
                "degree": degree,
                "time_tag": time_tag,
                "who": who,
            }
        )
        return post(models.Calibration, path_of("calibrations"), asked)

    @paged_list
    def calibrations(self, spacecraft: str | None = None) -> Listing[models.CalibrationSummary]:
        """List calibrations without covariances and residual maps, newest first.

        >>> [each.version for each in client.calibrations("XTE")]
        []
        """
        query = {"spacecraft": spacecraft}
        return Listing(models.CalibrationSummary, path_of("calibrations"), query)

    @single_request
    def calibration(self, id: str) -> Call[models.Calibration]:
        """Read a calibration with all its results; raises `NotFound`."""
        return get(models.Calibration, path_of("calibrations", id))

    @single_request
    def calibration_in_force(self, spacecraft: str) -> Call[models.CalibrationInForce]:
        """Read the calibration that new batches use, with all adoptions.

        >>> in_force = client.calibration_in_force("XTE")
        >>> in_force.calibration, in_force.history
        (None, [])
        """
        path = path_of("spacecraft", spacecraft, "calibration")
        return get(models.CalibrationInForce, path)

    @single_request
    def adopt_calibration(
        self, id: str, *, who: str | None = None, note: str = ""
    ) -> Call[models.CalibrationAdoption]:
        """Adopt a calibration for new batches; raises `WrongState`."""
        path = path_of("calibrations", id, "adopt")
        return post(models.CalibrationAdoption, path, {"who": who, "note": note})

    @single_request
    def revert_calibration(
        self, spacecraft: str, to: str | None = None, *, who: str | None = None, note: str = ""
    ) -> Call[models.CalibrationAdoption]:
        """Return to an earlier adoption of a calibration, or with None to the mission file."""
        path = path_of("spacecraft", spacecraft, "calibration", "revert")
        return post(models.CalibrationAdoption, path, {"to": to, "who": who, "note": note})


def _act(id: str, action: str, body: dict[str, Any]) -> Call[models.AlarmWithActions]:
    return post(models.AlarmWithActions, path_of("alarms", id, action), body)


def _submission(
    batch: Batch, idempotency_key: str | None, read: Callable[[RecordedAnswer], T]
) -> Call[T]:
    def recorded(response: httpx.Response) -> T:
        is_replayed = response.headers.get("Replayed") == "true"
        return read(RecordedAnswer(response.content, is_replayed))

    headers = {} if idempotency_key is None else {"Idempotency-Key": idempotency_key}
    return Call(
        recorded, "POST", path_of("batches"), body=batch, headers=headers, repeat=Repeat.ALWAYS
    )
