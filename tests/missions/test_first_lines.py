"""The first line of an error names the field, the value and what would be right, in plain words."""

import copy
import json
import random
import re
import tomllib

import pytest

from service.errors import BadBatch, BadConfiguration
from service.missions.mission import parse_mission
from service.observations.schema import submission_from_json
from tests.missions.stated_files import STATED_FOLDER, toml_text
from tests.missions.test_defaults import TEN_LINES
from tests.observations.example import BATCH

MUTATIONS = 200
WRONG = (-7, 0, "wrong", True, [], [1.0], [1.0, 2.0], {}, 1e9, float("nan"), ["a", "b", "c", "d"])
LIBRARY = re.compile(
    r"Input|[Tt]uple|validation|Field required|[Dd]iscriminator|[Uu]nion|\btag\b|pydantic|NoneType|"
    r"instance|parse|dictionary|Value error|function-"
)
SAYS = re.compile(
    r"\bmust\b|is required|are required|no such|there is no|needs?\b|takes|allowed|such as|"
    r"belongs?|has no|several|the mission has|finite"
)


def places(value, path=()):
    """Every place in a table: the path of each key and entry."""
    found = [path] if path else []
    inside = (
        value
        if isinstance(value, dict)
        else dict(enumerate(value) if isinstance(value, list) else ())
    )
    for key, each in inside.items():
        found += places(each, (*path, key))
    return found


def mutated(whole, rng):
    """A copy with one value that is wrong, one key that is misspelt, or one that is missing."""
    made = copy.deepcopy(whole)
    path = rng.choice(places(made))
    held = made
    for key in path[:-1]:
        held = held[key]
    kind = rng.choice(("value", "value", "value", "key", "missing"))
    if kind == "value" or not isinstance(held, dict):
        held[path[-1]] = copy.deepcopy(rng.choice(WRONG))
    elif kind == "key":
        held[f"{path[-1]}s"] = held.pop(path[-1])
    else:
        del held[path[-1]]
    return made


def checked(line, whole):
    key, _, message = line.partition(": ")
    assert not LIBRARY.search(message), line
    assert SAYS.search(message), line
    assert re.fullmatch(r"[\w.\[\]-]+( \w+)?", key), line
    assert "is required" in message or "are required" in message or whole, line


@pytest.mark.parametrize(
    "text", [TEN_LINES, *map(STATED_FOLDER.joinpath, ("xte.toml", "soho.toml"))]
)
def test_the_first_line_about_a_mutated_mission_is_plain(text, seed):
    rng = random.Random(seed)
    table = tomllib.loads(text if isinstance(text, str) else text.read_text(encoding="utf-8"))
    refused = 0
    for _ in range(MUTATIONS):
        made = mutated(table, rng)
        try:
            parse_mission(toml_text(made), "x.toml")
        except BadConfiguration as error:
            refused += 1
            first = str(error).splitlines()[0].removeprefix("x.toml: ")
            checked(first, made)
    assert refused > MUTATIONS // 3


def test_the_first_line_about_a_mutated_batch_is_plain(seed):
    rng = random.Random(seed)
    refused = 0
    for _ in range(MUTATIONS):
        made = mutated(BATCH, rng)
        try:
            submission_from_json(json.dumps(made).encode())
        except BadBatch as error:
            refused += 1
            checked(str(error.faults[0]), made)
    assert refused > MUTATIONS // 3


def test_a_quaternion_of_three_numbers_says_so():
    body = BATCH | {"a_priori": {"quaternion": [0.0, 0.0, 1.0]}}
    with pytest.raises(BadBatch) as refusal:
        submission_from_json(json.dumps(body).encode())
    (fault,) = refusal.value.faults
    assert fault.field == "a_priori.quaternion"
    assert fault.message.startswith("must have 4 entries, not 3, such as [")
