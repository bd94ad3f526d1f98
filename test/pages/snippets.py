"""What the pages show, as a reader would run it: fenced blocks, in order, in one folder a page.

A block runs unless a comment before it says why not::

    <!-- not run: needs Jazzy from apt -->
    <!-- long -->                             only by `make long`
    <!-- before: cp -r my_run other_run -->   first run this, which the reader has done already

A ``console`` block is a line of shell each, or, where lines begin with ``$``, those lines alone. A ``python``
block goes on where the one before it ended.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

from csas_shadow_ros.cli import main

ROOT = Path(__file__).resolve().parents[2]
RUN_KINDS = ("console", "bash", "python")
#: What else a fence may be: shown, not run.
SHOWN_KINDS = ("text", "yaml", "mermaid", "sql", "")
#: Views every 15°, not every degree, and no figures, unless a page says otherwise: the time of a test.
_QUICK = (("--step-deg", "15"), ("--no-figures",))
CHEAPER = {"run": _QUICK, "replay": _QUICK, "batch": _QUICK[:1]}
_BLOCK = re.compile(
    r"(?P<marks>(?:^<!--.*?-->\n+)*)^```(?P<kind>\w*)[^\n]*\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL
)
_MARK = re.compile(r"<!-- *(not run|before|long)(?:: *(.*?))? *-->")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    line: int
    kind: str
    text: str
    marks: dict[str, str] = field(default_factory=dict)

    @property
    def commands(self) -> list[str]:
        """Lines of shell, continued ones joined; a line of ``$`` says that the others are output."""
        lines = self.text.replace("\\\n", " ").splitlines()
        if any(line.startswith("$ ") for line in lines):
            lines = [line[2:] for line in lines if line.startswith("$ ")]
        return [line for line in lines if line.strip() and not line.lstrip().startswith("#")]


def blocks_of(path: Path) -> list[Block]:
    """Return the fenced blocks of a page."""
    text = path.read_text(encoding="utf-8")
    found = []
    for match in _BLOCK.finditer(text):
        marks = {name: (more or "").strip() for name, more in _MARK.findall(match["marks"])}
        line = text.count("\n", 0, match.start("kind")) + 1
        found.append(Block(path.name, line, match["kind"], match["text"], marks))
    return found


def is_ours(command: str) -> bool:
    """Whether a line is one call of csas-shadow, without the shell's doing."""
    bare = re.sub(r"'[^']*'|\"[^\"]*\"", "", command).partition("#")[0]
    return command.startswith("csas-shadow ") and not re.search(r"[|&;<>$*]", bare)


def arguments_of(command: str) -> list[str]:
    """Split a line of csas-shadow, without its comment."""
    return shlex.split(command, comments=True)[1:]


class Reader:
    """Somebody who does what a page says."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names: dict[str, object] = {"__name__": "__page__"}
        tools = folder / ".tools"
        tools.mkdir()
        shim = tools / "csas-shadow"
        shim.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m csas_shadow_ros "$@"\n', encoding="utf-8")
        shim.chmod(0o755)
        self.environment = {
            **os.environ,
            "PATH": f"{tools}:{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "MPLBACKEND": "Agg",
        }

    def do(self, block: Block) -> None:
        """Run a block; raise an AssertionError that names it if it fails."""
        if "before" in block.marks:
            self._shell(block, block.marks["before"])
        if block.kind == "python":
            code = compile("\n" * block.line + block.text, block.page, "exec")
            with contextlib.redirect_stdout(io.StringIO()):
                exec(code, self.names)
            return
        for command in block.commands:
            if is_ours(command):
                self._ours(block, arguments_of(command))
            else:
                self._shell(block, command)

    def _ours(self, block: Block, arguments: list[str]) -> None:
        """Run csas-shadow in this process: a process of its own would cost seconds, a line."""
        for flag, *value in CHEAPER.get(arguments[0], ()):
            if flag not in arguments:
                arguments = [*arguments, flag, *value]
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            try:
                code = main(arguments)
            except SystemExit as stop:
                code = int(stop.code or 0)
        assert code == 0, f"{block.page}:{block.line}: csas-shadow {shlex.join(arguments)}\n{said.getvalue()}"

    def _shell(self, block: Block, command: str) -> None:
        words = ["bash", "-c", command]
        done = subprocess.run(
            words, cwd=self.folder, env=self.environment, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, f"{block.page}:{block.line}: {command}\n{done.stdout}{done.stderr}"
