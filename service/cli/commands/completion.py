"""Command `acquire completion`: completion of commands and options in a shell."""

import argparse
from argparse import Namespace
from pathlib import Path
from typing import Any

from service.cli.arguments import add_command

SHELLS = ("bash", "zsh", "fish", "tcsh")
NOTES = """\
To have it in every shell from now on:
  bash   acquire completion bash > ~/.local/share/bash-completion/completions/acquire
  fish   acquire completion fish > ~/.config/fish/completions/acquire.fish
  zsh    acquire completion zsh > a folder of $fpath, in a file named _acquire"""


def add(commands: Any) -> None:
    """Declare the command `completion`."""
    parser = add_command(commands, "completion", run, notes=NOTES)
    parser.add_argument("shell", choices=SHELLS)


def run(parsed: Namespace) -> int:
    """Print a script with which a shell completes commands, options and their values.

    acquire completion bash
    acquire completion zsh
    """
    import shtab

    from service.cli import build_parser

    parser = build_parser()
    _complete_files(parser, shtab.FILE)
    print(shtab.complete(parser, shell=parsed.shell))
    return 0


def _complete_files(parser: argparse.ArgumentParser, files: object) -> None:
    """Complete file names for all arguments that are paths."""
    for action in parser._actions:
        if action.type is Path:
            # The attribute that shtab reads; argparse does not declare it.
            action.complete = files  # type: ignore[attr-defined]
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _complete_files(command, files)
