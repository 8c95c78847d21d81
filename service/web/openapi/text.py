"""`openapi.yaml`: the reference as text, the same bytes every time it is made."""

import json

import yaml

from service.web.app import bare_app


class _Dumper(yaml.SafeDumper):
    """Writes text of several lines as it stands."""


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    style = "|" if "\n" in text else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _text)


def openapi_yaml() -> str:
    """The text of `openapi.yaml`, made without a running service."""
    # Once through JSON: YAML would mark what is shared between places.
    plain = json.loads(json.dumps(bare_app().openapi()))
    return str(yaml.dump(plain, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100))
