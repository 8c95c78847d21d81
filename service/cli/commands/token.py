"""Command `acquire token`: access tokens of the service.

Changes are made in the database, or through a running service that writes to its SQLite file.
"""

from argparse import ArgumentParser, Namespace
from typing import Any

from service.cli import arguments


def add(commands: Any) -> None:
    """Declare the command `token` with its subcommands."""
    group = arguments.add_group(
        commands,
        "token",
        "Tokens for programs and people.  Until the first token is created, access is open on "
        "this machine; from then on, every request needs one, except for /livez, /readyz, "
        "signing in and the API description.",
        """
        acquire token create pipeline --scope submit --spacecraft XTE
        acquire token create "J. Operator" --scope read --scope operate --days 30
        acquire token list
        acquire token revoke pipeline
        """,
    )
    parser = arguments.add_command(group, "create", create)
    parser.add_argument("name", metavar="NAME", help="name of a program or a person")
    parser.add_argument(
        "--scope",
        action="append",
        required=True,
        choices=("read", "submit", "operate"),
        help="read: read everything; submit: send batches; operate: change limits, acknowledge "
        "alarms, adopt what-ifs and calibrations, and all other changes.  May be repeated",
    )
    parser.add_argument(
        "--spacecraft",
        action="append",
        metavar="NAME",
        help="bind the token to this spacecraft; may be repeated",
    )
    parser.add_argument(
        "--days",
        type=arguments.count,
        default=365,
        metavar="N",
        help="days until the token expires; default 365",
    )
    parser.add_argument(
        "--rate",
        type=float,
        metavar="N",
        help="maximum number of requests per second; default: no limit",
    )
    add_service(parser)
    parser = arguments.add_command(group, "list", show)
    arguments.add_json(parser, "the tokens")
    arguments.add_database(parser)
    parser = arguments.add_command(group, "revoke", revoke)
    parser.add_argument("name", metavar="NAME")
    add_service(parser)


def add_service(parser: ArgumentParser) -> None:
    """Add options for the database, and for a service that may be writing to it."""
    parser.add_argument(
        "--url",
        help=f"{arguments.SERVICE}.  Where it writes to the SQLite file, it makes the change",
    )
    arguments.add_database(parser)


def create(parsed: Namespace) -> int:
    """Create a token and print it once: the database keeps only its digest.  The audit list records
    changes under the token's name.

    acquire token create pipeline --scope submit --spacecraft XTE
    ACQUIRE_TOKEN=acq_... acquire replay pass.ndjson
    curl -H "Authorization: Bearer acq_..." http://127.0.0.1:8000/api/v1/spacecraft
    """
    from service.cli.tokens import create_token

    return create_token(parsed)


def show(parsed: Namespace) -> int:
    """Show every token, without its secret.

    acquire token list
    """
    from service.cli.tokens import print_tokens

    return print_tokens(arguments.settings_of_existing(parsed), parsed.json)


def revoke(parsed: Namespace) -> int:
    """End a token and its browser sessions, within a second.

    acquire token revoke pipeline
    """
    from service.cli.tokens import opened_tokens

    with opened_tokens(
        arguments.settings_of_existing(parsed), arguments.service_url(parsed)
    ) as tokens:
        tokens.revoke(parsed.name)
    print(f"{parsed.name} is revoked; a running service heeds that within a second")
    return 0
