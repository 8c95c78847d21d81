"""Reading of a change's author and reason from its request's body, as kept in the audit list."""

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from sqlalchemy import Connection, select

from service.contract.answers import Signature
from service.storage.sql.tables import audit

REASONS = ("comment", "note", "text")
"""Names of the request fields that may give the reason of a change."""


def signed_in(body: str | None) -> tuple[str | None, str | None]:
    """The author and the reason that a request names; None where it names none."""
    sent: Any = None
    with suppress(ValueError):
        sent = json.loads(body or "null")
    texts = sent if isinstance(sent, dict) else {}
    who, *reasons = (texts.get(name) for name in ("who", *REASONS))
    reason = next((each for each in reasons if isinstance(each, str) and each), None)
    return (who if isinstance(who, str) and who else None), reason


def naming_result(body: str | None, id: str) -> str:
    """Put the id of the result and the signature at the start of a what-if's stored request body.

    A long body is stored without its end.
    """
    sent = json.loads(body or "{}")
    first = {"result": id} | {name: sent[name] for name in ("who", "comment") if name in sent}
    return json.dumps(first | sent, ensure_ascii=False)


def result_in(body: str | None) -> str | None:
    """Id of the result at the start of a what-if's stored request body; None in any other body."""
    found = re.match(r'\{"result": "(\w+)"', body or "")
    return None if found is None else found[1]


def signatures_of(connection: Connection, parents: Mapping[str, str]) -> dict[str, Signature]:
    """Signatures on recorded what-ifs by their ids, from the ids of the results they started from.

    A what-if that no audit entry names has none.
    """
    abouts = [f"/api/v1/batches/{parent}/what-if" for parent in set(parents.values())]
    found: dict[str, Signature] = {}
    for row in connection.execute(select(audit).where(audit.c.about.in_(abouts))).mappings():
        id = result_in(row["body"])
        if id is not None and id in parents:
            who, reason = signed_in(row["body"])
            found[id] = Signature(who=who or row["who"], at=row["moment"], comment=reason)
    return found
