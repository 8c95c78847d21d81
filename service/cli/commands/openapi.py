"""Command `acquire openapi`: print, write or check the OpenAPI description."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from service.cli.arguments import add_command


def add(commands: Any) -> None:
    """Declare the command `openapi`."""
    parser = add_command(commands, "openapi", run)
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--output", type=Path, metavar="FILE")
    way.add_argument(
        "--check",
        type=Path,
        nargs="?",
        const=Path("openapi.yaml"),
        metavar="FILE",
        help="exit code 1 if FILE (default openapi.yaml) differs from the description",
    )


def run(parsed: Namespace) -> int:
    """Print the description of the API (OpenAPI 3.1, YAML).

    acquire openapi --output openapi.yaml
    acquire openapi --check                        compare with ./openapi.yaml
    """
    from service.web.app import openapi_yaml

    checked = None if parsed.check is None else parsed.check.read_text(encoding="utf-8")
    text = openapi_yaml()
    if parsed.output is not None:
        parsed.output.write_text(text, encoding="utf-8")
    elif checked is None:
        print(text, end="")
    elif checked != text:
        print(f"{parsed.check} is not what the service describes: run `make openapi`")
        return 1
    return 0
