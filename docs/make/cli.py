"""The reference of the command line, from its parsers."""

from __future__ import annotations

import argparse

from csas_shadow_ros.cli import build_parser


def cli_reference() -> str:
    """Return every command of ``csas-shadow`` with its options, as Markdown."""
    parser = build_parser()
    commands = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    lines = ["| command | does |", "|---|---|"]
    lines += [f"| [`{one.dest}`](#{one.dest}) | {_cell(one.help)} |" for one in commands._choices_actions]
    for name, command in commands.choices.items():
        lines += ["", f"## {name}", "", *_command(command)]
    return "\n".join(lines) + "\n"


def _command(command: argparse.ArgumentParser) -> list[str]:
    options = getattr(command, "options", None)
    if options is not None:  # they are made when a command is asked for
        command.options = None
        options(command)
    places = [a for a in command._actions if not a.option_strings]
    usage = " ".join([command.prog, *(_place(a) for a in places), "[options]"])
    lines = [(command.description or "").strip(), "", "```text", usage, "```", ""]
    if command.epilog:
        lines += ["```text", command.epilog.strip(), "```", ""]
    for group in command._action_groups:
        actions = [a for a in group._group_actions if a.dest != "help"]
        if not actions:
            continue
        title = "arguments" if group.title == "positional arguments" else group.title
        lines += [f"| {title} | |", "|---|---|"]
        lines += [f"| {_name(a)} | {_cell(_help(a))} |" for a in actions]
        lines.append("")
    return lines[:-1]


def _place(action: argparse.Action) -> str:
    shown = str(action.metavar or action.dest)
    if action.nargs in ("+", "*"):
        return f"{shown} [{shown} ...]"
    return f"[{shown}]" if action.nargs == "?" else shown


def _name(action: argparse.Action) -> str:
    if not action.option_strings:
        return _code(str(action.metavar or action.dest))
    if isinstance(action, argparse.BooleanOptionalAction):
        return " ".join(_code(flag) for flag in action.option_strings)
    flags = ", ".join(action.option_strings)
    if action.nargs == 0:
        return _code(flags)
    if action.choices is not None:
        value = action.metavar or "{" + ",".join(str(c) for c in action.choices) + "}"
    else:
        value = action.metavar or action.dest.upper()
    if isinstance(value, tuple):
        value = " ".join(value)
    elif isinstance(action.nargs, int):
        value = " ".join([str(value)] * action.nargs)
    return _code(f"{flags} {value}")


def _help(action: argparse.Action) -> str:
    text = (action.help or "").replace("%%", "%")
    return f"{text} (required)" if getattr(action, "required", False) and action.option_strings else text


def _code(text: str) -> str:
    # A bar in backticks ends the cell for some readers of Markdown, an escaped one shows its slash in others.
    return f"<code>{text.replace('|', '&#124;')}</code>" if "|" in text else f"`{text}`"


def _cell(text: str | None) -> str:
    return (text or "").replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
