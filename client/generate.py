"""Writes what of the client is generated: python client/generate.py, or --check for differences.

The methods of one request each come from the routes that have a `ClientMethod`, as the OpenAPI
document describes them.  The models come from the records of the service that the client's methods
and events name, with all that these hold; the synchronous half comes from the asynchronous one, as
httpcore does it.
"""

import argparse
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from msgspec import NODEFAULT, UNSET, UnsetType, structs
from pydantic.fields import FieldInfo

from service import contract
from service.contract import answers, base
from service.contract.base import Absent, DescribedAs, Record, component_name, text_below
from service.contract.events import EVENT_DATA
from service.feature import known_features
from service.web.app import bare_app
from service.web.openapi import CLIENT_METHODS, ClientMethod
from service.web.requests.query_parameters import TIME_SCHEMA

CLIENT = Path(__file__).parent / "acquire_client"
HEADER = "# Written by `make client` from {}.\n"

# ---- models ----------------------------------------------------------------------------------

NAMED_BESIDE = {"ProblemDocument", "TokenList"}
"""Models that the client's modules do not name as `models.`..., and no other model holds."""
BASES = {"History": "Tabulated"}
"""Base classes in the client that give methods to models, by the name of the model."""
WORDS: Mapping[str, Any] = {
    "Outcome": base.Outcome,
    "Status": base.Status,
    "Identifier": answers.Identifier,
}
"""Types of texts for which a type checker knows the words of this version."""
ABOUT = """Every model: what the answers of the service hold.

Quaternions have the scalar last and transform inertial (EME2000) into body components.
Covariances are of the small error rotation about the body axes.  Times are UTC in calendar form,
as text: they may be in a leap second and have nanoseconds.  Ids sort by the time of recording.
"""


def client_name(record: type[Record]) -> str:
    """Name of the client's model for a record."""
    return vars(record).get("client_name") or record.__name__


def module_name(record: type[Record]) -> str:
    """Name of the client's module for a record: that of the contract, or of a feature's folder."""
    return record.__module__.removesuffix(".records").rpartition(".")[2]


def all_records() -> Mapping[str, type[Record]]:
    """Records of the contract and of all installed features, by the name of their model."""
    modules = [f"{contract.__name__}.{each.name}" for each in iter_modules(contract.__path__)]
    modules += [f"{feature.package}.records" for feature in known_features().values()]
    for module in filter(find_spec, modules):
        import_module(module)

    def derived(record: type[Record]) -> Iterator[type[Record]]:
        for each in record.__subclasses__():
            yield each
            yield from derived(each)

    found: dict[str, type[Record]] = {}
    for record in derived(Record):
        if found.setdefault(client_name(record), record) is not record:
            raise ValueError(f"two records are named {client_name(record)}: name one `client_name`")
    return found


def own_fields(record: type[Record]) -> dict[str, Any]:
    """Types of the fields that a record adds to those of its base class."""
    hints = get_type_hints(record, include_extras=True)
    return {name: hints[name] for name in record.__annotations__ if name in struct_fields(record)}


def struct_fields(record: type[Record]) -> Mapping[str, structs.FieldInfo]:
    """The fields of a record by name."""
    return {each.name: each for each in structs.fields(record)}


def with_parts(record: type[Record], known: dict[type[Record], None]) -> None:
    """Add a record to `known`, after its base class and the records in its fields."""

    def records_in(kind: Any) -> Iterator[type[Record]]:
        if isinstance(kind, type) and issubclass(kind, Record):
            yield kind
        for each in get_args(kind):
            yield from records_in(each)

    if record in (Record, base.Items) or record in known:
        return
    for part in (record.__base__, *own_fields(record).values()):
        for each in records_in(part):
            with_parts(each, known)
    known[record] = None


def models(methods: str) -> Mapping[str, str]:
    """Generate the text of each module of models, by its path in the client.

    `methods` is the text of all generated methods.
    """
    own = {*CLIENT.glob("*.py"), *CLIENT.glob("_async/*.py")} - {CLIENT / "events.py"}
    texts = "\n".join((methods, *(path.read_text(encoding="utf-8") for path in own)))
    names = set(re.findall(r"\bmodels\.([A-Z]\w+)", texts)) | NAMED_BESIDE
    known = all_records()
    needed: dict[type[Record], None] = {}
    for each in (*(known[name] for name in sorted(names)), *EVENT_DATA.values()):
        with_parts(each, needed)
    modules: dict[str, list[type[Record]]] = {}
    for record in needed:
        modules.setdefault(module_name(record), []).append(record)
    for held in modules.values():
        held.sort(key=place_in_source)
    texts_of = {
        f"models/{name}.py": module_text(name, held, list(needed)) for name, held in modules.items()
    }
    imports = [
        f"from .{name} import {', '.join(f'{n} as {n}' for n in map(client_name, held))}\n"
        for name, held in modules.items()
    ]
    return texts_of | {
        "models/__init__.py": f'"""{ABOUT}"""\n{HEADER.format("the records of the service")}\n'
        + "".join(imports),
        "events.py": events_text(),
        "words.py": words_text(),
    }


def place_in_source(record: type[Record]) -> tuple[bool, int]:
    """Sort key of records in a module: those of the contract, then those of a feature."""
    source = sys.modules[record.__module__]
    of_feature = not source.__name__.startswith(contract.__name__)
    return of_feature, list(vars(source)).index(record.__name__)


def module_text(name: str, held: Sequence[type[Record]], needed: Sequence[type[Record]]) -> str:
    """Generate the text of a module of models; ruff removes unused imports."""
    source = sys.modules[held[0].__module__]
    others = sorted({module_name(each) for each in needed} - {name})
    imports = [
        f"from .{other} import {client_name(each)}\n"
        for other in others
        for each in needed
        if module_name(each) == other
    ]
    sources = dict.fromkeys(each.__module__.replace(".", "/") + ".py" for each in held)
    header = HEADER.format(" and\n# ".join(sources))
    text = [
        f'"""{(source.__doc__ or "").splitlines()[0]}"""\n{header}\n',
        "from collections.abc import Sequence\nfrom typing import Any\n\n",
        f"from ..base import Model, {', '.join(BASES.values())}\n",
        f"from ..words import {', '.join(WORDS)}\n",
        *imports,
        *(class_text(each) for each in held),
    ]
    return "".join(text)


def words_text() -> str:
    """Generate the module of answers' words: known to a type checker, any text at run time."""
    words = {name: get_args(described_type(alias)) for name, alias in WORDS.items()}
    return "".join(
        [
            '"""Words of answers: those of this version for a type checker, else any text."""\n',
            f"{HEADER.format('service/contract')}\nfrom typing import TYPE_CHECKING, Literal\n\n",
            *(f"{name}Word = Literal{list(known)}\n" for name, known in words.items()),
            "if TYPE_CHECKING:\n",
            *(f"    {name} = {name}Word\n" for name in words),
            "else:\n    # A later service may know further words: they are read, too.\n",
            f"    {' = '.join(words)} = str\n",
        ]
    )


def described_type(alias: Any) -> Any:
    """Type, such as a `Literal`, that describes the words of a text."""
    (described,) = (each for each in alias.__metadata__ if isinstance(each, DescribedAs))
    return described.shape


def class_text(record: type[Record]) -> str:
    """Python text of the client's class for one of the service's records."""
    parent = record.__base__
    is_derived = parent not in (Record, base.Items)
    name = client_name(record)
    bases = client_name(parent) if is_derived else BASES.get(name, "Model")  # type: ignore[arg-type]
    fields = "".join(field_text(record, *each) for each in own_fields(record).items())
    about = in_client_words(record.__doc__ or "")
    return f'\n\nclass {name}({bases}, frozen=True, kw_only=True):\n    """{about}"""\n\n{fields}'


def field_text(record: type[Record], name: str, hint: Any) -> str:
    """Generate the line of a model's field with its default, and the description below it."""
    field = struct_fields(record)[name]
    kind, default = type_text(hint), field.default
    if field.default_factory is not NODEFAULT:
        default = ()
    elif default is UNSET:
        absent = [each.value for each in metadata_of(hint) if isinstance(each, Absent)]
        default = absent[0] if absent else () if kind.startswith("Sequence[") else None
        if default is None and not kind.endswith(" | None"):
            kind += " | None"
    end = "" if default is NODEFAULT else f" = {default!r}"
    about = description(hint) or text_below(record, name)
    return f"    {name}: {kind}{end}\n" + (documented(in_client_words(about)) if about else "")


def metadata_of(hint: Any) -> tuple[Any, ...]:
    """Metadata of an annotated type; empty for a plain type."""
    return hint.__metadata__ if get_origin(hint) is Annotated else ()


OF_ALIASES = [each for alias in vars(base).values() for each in metadata_of(alias)]


def description(hint: Any) -> str | None:
    """Description in a field's annotation, without those of common types; None without any."""
    found = [
        each.description
        for each in metadata_of(hint)
        if isinstance(each, FieldInfo) and not any(each is known for known in OF_ALIASES)
    ]
    return found[-1] if found else None


def type_text(hint: Any) -> str:
    """Type of a model's field as text: lists are sequences, words are any text."""
    for word, alias in WORDS.items():
        if any(each in metadata_of(hint) for each in alias.__metadata__):
            return word
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return type_text(parts[0])
    if origin is Literal:
        return "str"
    if origin in (Union, UnionType):
        return " | ".join(type_text(each) for each in parts if each is not UnsetType)
    if origin in (list, dict):
        outer = "Sequence" if origin is list else "dict"
        return f"{outer}[{', '.join(map(type_text, parts))}]"
    if isinstance(hint, type) and issubclass(hint, Record):
        return client_name(hint)
    return "None" if hint is NoneType else hint.__name__


def in_client_words(text: str) -> str:
    """Replace JSON's null by None in a description."""
    return re.sub(r"\b[nN]ull\b", "None", text.strip())


def documented(text: str) -> str:
    """Format the description below a field."""
    lines = textwrap.wrap(f'"""{text}"""', 96)
    return textwrap.indent("\n".join(lines), "    ") + "\n"


def events_text() -> str:
    """Generate the module with the kinds of events, each with the model of its data."""
    classes = [
        f'class {kind.capitalize()}Event(_Numbered, frozen=True):\n    """An event `{kind}`."""\n\n'
        f'    kind: Literal["{kind}"]\n    data: models.{client_name(data)}\n\n\n'
        for kind, data in EVENT_DATA.items()
    ]
    return (
        f'"""The kinds of events that this version knows."""\n'
        f"{HEADER.format('service/contract/events.py')}\n"
        "from typing import Literal\n\nfrom . import models\nfrom .base import Model\n\n\n"
        "class _Numbered(Model, frozen=True):\n    id: int\n\n\n"
        + "".join(classes)
        + f"KnownEvent = {' | '.join(f'{kind.capitalize()}Event' for kind in EVENT_DATA)}\n"
    )


# ---- methods ---------------------------------------------------------------------------------

JSON = "application/json"
PLAIN_TYPES = {
    "string": "str",
    "integer": "int",
    "number": "float",
    "boolean": "bool",
    "null": "None",
    "object": "Mapping[str, Any]",
}


class Argument(NamedTuple):
    """Argument of a method: a name in the path, or a field of the query or the body."""

    name: str
    field: str
    place: str
    kind: str
    default: str
    """Text of its default; empty for a required argument."""
    about: str


def argument_type(schema: Mapping[str, Any]) -> str:
    """Type of an argument as text, from the schema of its field."""
    if "anyOf" in schema:
        return " | ".join(dict.fromkeys(map(argument_type, schema["anyOf"])))
    if schema.get("pattern") == TIME_SCHEMA["pattern"]:
        return "Time"
    if schema.get("type") == "array":
        return f"Sequence[{argument_type(schema['items'])}]"
    for word, alias in WORDS.items():
        known, allowed = get_args(described_type(alias)), schema.get("enum", ())
        if set(known) <= set(allowed):
            others = [each for each in allowed if each not in known]
            return f"{word} | Literal{others}" if others else word
    return PLAIN_TYPES[schema.get("type", "object")]


def argument(
    method: ClientMethod, path: str, place: str, field: str, required: bool, field_schema: Any
) -> Argument:
    """Argument for a field, by its description in the OpenAPI document."""
    name = method.renamed.get(field, field)
    if place == "path" and f"/spacecraft/{{{field}}}/" in path:
        name = "spacecraft"
    described = field_schema.get("schema", field_schema)
    default = method.defaults.get(field, described.get("default"))
    kind = argument_type(described)
    text = (
        ""
        if required and field not in method.defaults
        else repr(tuple(default) if isinstance(default, list) else default)
    )
    if text == "None" and not kind.endswith("None"):
        kind += " | None"
    return Argument(name, field, place, kind, text, field_schema.get("description", ""))


def arguments(
    method: ClientMethod, path: str, operation: Mapping[str, Any], schemas: Mapping[str, Any]
) -> list[Argument]:
    """Arguments of a method in their order: of the path, by place, by keyword."""
    found = [
        argument(method, path, each["in"], each["name"], each["required"], each)
        for each in operation.get("parameters", ())
        if each["in"] != "header"
    ]
    content = operation.get("requestBody", {}).get("content", {})
    if method.body:
        kind = "Batch" if JSON in content else "bytes"
        about = "The body of the request." if JSON in content else "The content of the file."
        found.append(Argument(method.body, "", "body", kind, "", about))
    elif content:
        body = schemas[content[JSON]["schema"]["$ref"].rpartition("/")[2]]
        found += [
            argument(method, path, "body", name, name in body.get("required", ()), schema)
            for name, schema in body["properties"].items()
        ]
    omitted = {*method.omitted, "format"}
    if any(each.field == "cursor" for each in found):
        omitted |= {"limit", "cursor"}
    by_place = ["", *method.by_place]

    def order(each: Argument) -> int:
        if each.place == "path":
            return -1
        return by_place.index(each.field) if each.field in by_place else len(by_place)

    return sorted((each for each in found if each.field not in omitted), key=order)


def answer_record(operation: Mapping[str, Any], known: Mapping[str, type[Record]]) -> type[Record]:
    """Record of the successful answer of an operation."""
    (name,) = {
        response["content"][JSON]["schema"]["$ref"].rpartition("/")[2]
        for status, response in operation["responses"].items()
        if status.startswith("2")
    }
    return known[name]


def method_text(
    method: ClientMethod,
    path: str,
    verb: str,
    operation: Mapping[str, Any],
    schemas: Mapping[str, Any],
    known: Mapping[str, type[Record]],
) -> str:
    """Generate the text of a method."""
    given = arguments(method, path, operation, schemas)
    named = [each for each in given if each.place != "path" and each.field]
    by_keyword = [each for each in named if each.field not in method.by_place]
    signature = ["self", *(argument_text(each) for each in given if each not in by_keyword)]
    if by_keyword:
        signature += ["*", *map(argument_text, by_keyword)]
    names_in_path = {each.field: each.name for each in given if each.place == "path"}
    parts = [
        names_in_path[part[1:-1]] if part.startswith("{") else repr(part)
        for part in path.removeprefix("/api/v1/").split("/")
    ]
    lines, sent = [f"path = path_of({', '.join(parts)})"], [f'"{verb.upper()}"', "path"]
    for place in ("query", "body"):
        fields = [f'"{each.field}": {each.name}' for each in named if each.place == place]
        fields += [f'"format": "{method.format}"'] if method.format and place == "query" else []
        if fields:
            lines.append(f"{place} = {{{', '.join(fields)}}}")
            sent.append(f"{place}={place if place == 'query' else 'parameters_of(body)'}")
    if method.body:
        is_json = JSON in operation["requestBody"]["content"]
        sent.append(f"body={method.body}" if is_json else f"content={method.body}, headers=BINARY")
    if method.repeatable:
        sent.append("repeat=Repeat.ALWAYS")
    decorator, returned, call = "single_request", "str", f"Call(text, {', '.join(sent)})"
    if not method.format:
        record = answer_record(operation, known)
        held = struct_fields(record).keys()
        item = f"models.{client_name(record)}"
        if held <= {"items", "next_cursor"}:
            (listed,) = get_args(get_type_hints(record)["items"])
            item = f"models.{client_name(listed)}"
        returned, call = item, f"Call(model({item}), {', '.join(sent)})"
        if held == {"items"}:
            returned, call = f"list[{item}]", f"Call(items({item}), {', '.join(sent)})"
        elif held == {"items", "next_cursor"}:
            decorator, call = "paged_list", f"Listing({item}, path, query)"
    kind = "Listing" if decorator == "paged_list" else "Call"
    head = f"def {method.name}({', '.join(signature)}) -> {kind}[{returned}]:"
    body = [docstring_of(method, operation, given), *lines, f"return {call}"]
    return f"\n    @{decorator}\n    {head}\n" + textwrap.indent("\n".join(body), " " * 8) + "\n"


def argument_text(each: Argument) -> str:
    """Generate an argument with its type and default."""
    return f"{each.name}: {each.kind}" + (f" = {each.default}" if each.default else "")


def docstring_of(
    method: ClientMethod, operation: Mapping[str, Any], given: Sequence[Argument]
) -> str:
    """Generate a method's docstring: what its route does, its arguments, and the example."""
    first, *others = f"{operation['summary']}.".split("\n\n")
    texts = [first, *("\n".join(textwrap.wrap(each, 90)) for each in others)]
    described = [f"- `{each.name}`: {in_client_words(each.about)}" for each in given if each.about]
    texts.append(
        "\n".join("\n".join(textwrap.wrap(e, 90, subsequent_indent="  ")) for e in described)
    )
    texts.append(textwrap.dedent(method.example).strip())
    return '"""' + "\n\n".join(filter(None, texts)) + '\n"""'


def methods() -> Mapping[str, str]:
    """Generate the text of each module of methods, by its path in the client."""
    described = bare_app().openapi()
    schemas = described["components"]["schemas"]
    known = {component_name(each): each for each in all_records().values()}
    found: dict[str, list[str]] = {}
    for path, operations in described["paths"].items():
        for verb, operation in operations.items():
            for handler, method in reversed(CLIENT_METHODS.get(operation["operationId"], [])):
                text = method_text(method, path, verb, operation, schemas, known)
                found.setdefault(handler.__module__, []).append(text)
    modules = {each.removesuffix(".routes").rpartition(".")[2]: each for each in found}
    texts = {
        f"methods/{name}.py": methods_module(name, source, found[source])
        for name, source in modules.items()
    }
    classes = {name: class_of_methods(name) for name in sorted(modules)}
    imports = "".join(f"from .{name} import {each}\n" for name, each in classes.items())
    return texts | {
        "methods/__init__.py": '"""Client methods that send one request each."""\n'
        f"{HEADER.format('the routes of the service')}\n{imports}\n\n"
        f"class Methods({', '.join(classes.values())}):\n"
        '    """All methods that send one request each.\n\n'
        "    `who` signs a change while access is open; with a token, its name does.\n"
        '    """\n'
    }


def class_of_methods(name: str) -> str:
    """Name of the class with the methods of a module."""
    return f"{name.title().replace('_', '')}Methods"


def methods_module(name: str, source: str, texts: Sequence[str]) -> str:
    """Generate the text of a module of methods; ruff removes unused imports."""
    return (
        f'"""Client methods: {name.replace("_", " ")}."""\n'
        f"{HEADER.format(source.replace('.', '/') + '.py')}\n"
        "from collections.abc import Mapping, Sequence\nfrom typing import Any, Literal\n\n"
        "from .. import models\n"
        "from ..calls import Call, Listing, items, model, paged_list, single_request, text\n"
        "from ..encoding import BINARY, Batch, Time, parameters_of, path_of\n"
        f"from ..retrying import Repeat\nfrom ..words import {', '.join(WORDS)}\n\n\n"
        f'class {class_of_methods(name)}:\n    """Methods for the routes of '
        f'`{source.replace(".", "/")}.py` of the service."""\n' + "".join(texts)
    )


# ---- the synchronous half --------------------------------------------------------------------

BY_HAND = ("__init__.py", "backend.py")
SYNCHRONOUS = [
    (re.compile(pattern), replacement)
    for pattern, replacement in (
        (r"\basync (def|for|with)\b", r"\1"),
        (r"\bawait ", ""),
        (r"\bAsyncGenerator\[(.*), None\]", r"Generator[\1, None, None]"),
        (r"\bAsync([A-Z]\w*)", r"\1"),
        (r"\basynccontextmanager\b", "contextmanager"),
        (r"\b__a(enter|exit|iter|next)__\b", r"__\1__"),
        (r"\ba(close|closing|read|iter_bytes)\b", r"\1"),
    )
]


def synchronous() -> Mapping[str, str]:
    """Generate the synchronous modules from the asynchronous ones, by path."""
    texts = {}
    for path in sorted((CLIENT / "_async").glob("*.py")):
        if path.name not in BY_HAND:
            text = path.read_text(encoding="utf-8")
            for pattern, replacement in SYNCHRONOUS:
                text = pattern.sub(replacement, text)
            texts[f"_sync/{path.name}"] = text
    return texts


# ---- files -----------------------------------------------------------------------------------

# The other fixes turn loops that no longer wait into one call, and sort imports.
TIDY = ["check", "--quiet", "--fix-only", "--unsafe-fixes", "--select=C4,F401,I,UP028"]


def tidied(text: str, path: Path) -> str:
    """Format the text of a module with ruff."""
    for step in (TIDY, ["format"]):
        command = [sys.executable, "-m", "ruff", *step, "--stdin-filename", str(path), "-"]
        text = subprocess.run(
            command, input=text, capture_output=True, text=True, check=True
        ).stdout
    return text


def main() -> int:
    """Write the generated files; with `--check` name those that differ, and return 1 for any."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing, name what differs")
    only_checks = parser.parse_args().check
    of_routes = methods()
    of_records = models("\n".join(of_routes.values()))
    generated = {**of_routes, **of_records, **synchronous()}
    made = {CLIENT / path: text for path, text in generated.items()}
    texts = {path: tidied(text, path) for path, text in made.items()}
    folders = [CLIENT / "methods", CLIENT / "models", CLIENT / "_sync"]
    found = {path for folder in folders for path in folder.glob("*.py")}
    left = {path for path in found - texts.keys() if path.name not in BY_HAND}
    stale = [p for p, text in texts.items() if not p.exists() or p.read_text("utf-8") != text]
    if only_checks:
        for path in sorted((*stale, *left)):
            print(f"{path.relative_to(CLIENT.parent)} differs from its source; run: make client")
        return 1 if stale or left else 0
    for path in stale:
        path.parent.mkdir(exist_ok=True)
        path.write_text(texts[path], encoding="utf-8")
    for path in left:
        path.unlink()
    return 0


if __name__ == "__main__":
    sys.exit(main())
