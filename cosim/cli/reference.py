"""The command line in the documentation: a Markdown extension that renders the parser."""

from __future__ import annotations

import argparse
import re
from typing import Any

from markdown import Markdown
from markdown.extensions import Extension
from markdown.preprocessors import Preprocessor

from cosim.cli import COMMANDS
from cosim.cli.main import parser

PLACEHOLDER = "[command-line]"  # the line of a page replaced by the commands


def commands() -> list[str]:
    """Lines of Markdown: a section for each command, with a table of its arguments."""
    return [line for name in COMMANDS for line in _section(_children(parser(name))[name], level=2)]


def _section(command: argparse.ArgumentParser, level: int) -> list[str]:
    lines = [f"{'#' * level} {command.prog}", "", _text(command.description or ""), ""]
    for group in command._action_groups:
        actions = [a for a in group._group_actions if not _without_row(a)]
        if actions:
            title = group.title if group.title not in ("options", "positional arguments") else ""
            if title:
                lines += [f"**{title}**: {_text(group.description or '')}", ""]
            lines += ["| argument | meaning |", "|---|---|", *map(_row, actions), ""]
    for child in _children(command).values():
        lines += _section(child, level + 1)
    return lines


def _children(command: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    for action in command._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def _without_row(action: argparse.Action) -> bool:
    hidden = action.help == argparse.SUPPRESS
    return hidden or isinstance(action, (argparse._HelpAction, argparse._SubParsersAction))


def _row(action: argparse.Action) -> str:
    names = ", ".join(f"`{name}`" for name in action.option_strings)
    value = "" if action.nargs == 0 else action.metavar or "|".join(map(str, action.choices or ()))
    value = value or ("" if names else action.dest)
    shown = " ".join(part for part in (names, f"`{value}`" if value else "") if part)
    meaning = _text((action.help or "") % _values(action))
    needed = " (required)" if names and action.required else ""
    return f"| {_cell(shown)} | {_cell(meaning)}{needed} |"


def _values(action: argparse.Action) -> dict[str, Any]:
    """Values of argparse's placeholders such as `%(default)s`."""
    return {**vars(action), "choices": ", ".join(map(str, action.choices or ()))}


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _text(text: str) -> str:
    """Help as Markdown, with markup escaped."""
    return re.sub(r"([*_<\[])", r"\\\1", " ".join(text.split()))


class _CommandLine(Preprocessor):
    def run(self, lines: list[str]) -> list[str]:
        if PLACEHOLDER not in lines:
            return lines
        at = lines.index(PLACEHOLDER)
        return [*lines[:at], *commands(), *lines[at + 1 :]]


class CommandLine(Extension):
    """Renders the commands in place of `[command-line]`."""

    def extendMarkdown(self, md: Markdown) -> None:
        md.preprocessors.register(_CommandLine(md), "command-line", 100)  # before fences are read (25)


def makeExtension(**options: Any) -> CommandLine:
    return CommandLine(**options)
