"""No file and no room of the packages imports in a circle, and no function is too long to be read at once."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("csas_shadow_ros", "msg_adapters")
#: Edges between rooms that close a circle and are wanted: (from, to). None is.
ALLOWED: set[tuple[str, str]] = set()
#: Where functions are held to a length; ruff holds their branches to 12, and has no rule for lines.
OF_SHORT_FUNCTIONS = (*PACKAGES, "launch", "examples", "benchmarks", "test")
#: Lines of a function without its docstring, at most. Kernels may have more: compiled loops have no seams.
MOST_LINES = 60


@dataclass(frozen=True)
class Import:
    """That one module imports another: at once, or only when a function is called (`late`)."""

    importer: str
    imported: str
    late: bool


def modules_of(root: Path) -> dict[str, Path]:
    """Return every module below a folder by its name."""
    found = {}
    for path in sorted(path for name in PACKAGES for path in (root / name).rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports_of(modules: dict[str, Path]) -> Iterator[Import]:
    """Iterate what is imported at run time; what only type checkers import makes no circle."""
    for name, path in modules.items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]

        def walk(node: ast.AST, late: bool, name: str = name, package: str = package) -> Iterator[Import]:
            for child in ast.iter_child_nodes(node):
                if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                    continue
                for target in targets_of(child, package):
                    # What is no module is a name in one.
                    known = target if target in modules else target.rpartition(".")[0]
                    if known in modules and known != name:
                        yield Import(name, known, late)
                yield from walk(child, late or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef))

        yield from walk(ast.parse(path.read_text(encoding="utf-8")), False)


def targets_of(node: ast.AST, package: str) -> list[str]:
    """Return the absolute names that an import statement asks for."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
    base += [node.module] if node.module else []
    return [".".join([*base, alias.name]) for alias in node.names]


def room_of(module: str, modules: dict[str, Path]) -> str:
    """Return the room of a module: its package, or the file itself where it lies in the root."""
    first, *rest = module.split(".")
    return first if first != PACKAGES[0] or not rest else rest[0]


def circle_in(edges: set[tuple[str, str]]) -> list[str]:
    """Return a circle of edges, empty if there is none."""
    graph: dict[str, set[str]] = {}
    for importer, imported in edges:
        graph.setdefault(importer, set()).add(imported)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(reversed(error.args[1]))
    return []


def room_edges(modules: dict[str, Path]) -> set[tuple[str, str]]:
    """Return which rooms import which, late ones too."""
    pairs = {(room_of(i.importer, modules), room_of(i.imported, modules)) for i in imports_of(modules)}
    # The package's own version is no room.
    return {(a, b) for a, b in pairs if a != b and b != PACKAGES[0]}


@pytest.fixture(scope="module")
def modules():
    return modules_of(ROOT)


def test_no_file_imports_itself_round_a_circle(modules):
    assert circle_in({(i.importer, i.imported) for i in imports_of(modules) if not i.late}) == []


def test_no_room_imports_itself_round_a_circle_not_even_late(modules):
    edges = room_edges(modules)
    assert edges >= ALLOWED, "an allowed edge is no longer there: take it out of the list"
    assert circle_in(edges - ALLOWED) == []


def inner_room_of(module: str) -> str:
    """Return the room within the core or the nodes that a module lies in; the module itself where in none."""
    parts = module.split(".")
    return ".".join(parts[:3]) if len(parts) > 3 else module


def test_no_room_within_core_or_nodes_imports_itself_round_a_circle(modules):
    inside = tuple(f"{PACKAGES[0]}.{room}." for room in ("core", "nodes"))
    pairs = {
        (inner_room_of(i.importer), inner_room_of(i.imported))
        for i in imports_of(modules)
        if i.importer.startswith(inside) and i.imported.startswith(inside)
    }
    assert circle_in({(a, b) for a, b in pairs if a != b}) == []


def test_the_core_imports_nothing_but_itself(modules):
    assert {b for a, b in room_edges(modules) if a == "core"} == set()


def test_a_circle_is_found_in_files_and_rooms(tmp_path):
    for name, text in {
        "core/__init__.py": "",
        "core/a.py": "from . import b",
        "core/b.py": "from .c import thing",
        "core/c.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ..core import a\n",
        "bags/d.py": "def f():\n    from ..core.a import b\n",
    }.items():
        path = tmp_path / PACKAGES[0] / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    made = modules_of(tmp_path)
    assert circle_in({(i.importer, i.imported) for i in imports_of(made)}) == []
    (tmp_path / PACKAGES[0] / "core/c.py").write_text("from .a import b\nfrom ..bags import d\n")
    assert len(circle_in({(i.importer, i.imported) for i in imports_of(made) if not i.late})) == 4
    assert circle_in(room_edges(made)) in (["core", "bags", "core"], ["bags", "core", "bags"])


def lines_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count a function's lines from its name on; those of its docstring do not count."""
    assert function.end_lineno is not None
    doc = function.body[0] if ast.get_docstring(function, clean=False) is not None else None
    return function.end_lineno - function.lineno + 1 - (doc.end_lineno - doc.lineno + 1 if doc else 0)


def is_kernel(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Say whether `core.kernels.kernel` compiles a function."""
    return any(ast.unparse(decorator).startswith("kernel(") for decorator in function.decorator_list)


def long_functions(root: Path) -> list[str]:
    """Return each function below a folder that is too long and no kernel: its file, name and lines."""
    return [
        f"{path.relative_to(root)}: {node.name} has {lines_of(node)} lines"
        for folder in OF_SHORT_FUNCTIONS
        for path in sorted((root / folder).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and lines_of(node) > MOST_LINES
        and not is_kernel(node)
    ]


def test_no_function_but_kernels_is_longer_than_60_lines():
    assert long_functions(ROOT) == []


def test_a_long_function_is_found_by_its_lines_without_the_docstring(tmp_path):
    def function(name: str, lines: int, doc: str = "", before: str = "def") -> str:
        return f"{before} {name}():\n" + doc + "    pass\n" * (lines - 1)

    doc = '    """Do so.\n\n    At length.\n    """\n'
    methods = "\n".join(f"    {line}" for line in function("method", 62).splitlines())
    path = tmp_path / "launch" / "deep" / "one.py"
    path.parent.mkdir(parents=True)
    path.write_text(
        function("short", MOST_LINES, doc)
        + function("long", MOST_LINES + 1, doc)
        + function("awaited", MOST_LINES + 5, before="async def")
        + "@kernel()\n"
        + function("compiled", 90)
        + "@cache\n"
        + function("cached", 90)
        + f"class Thing:\n{methods}\n"
    )
    assert long_functions(tmp_path) == [
        f"launch/deep/one.py: {name} has {lines} lines"
        for name, lines in (("long", 61), ("awaited", 65), ("cached", 90), ("method", 62))
    ]
