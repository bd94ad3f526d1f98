"""The generated pages are those of the code, and the documents' links lead somewhere.

Rewrite the pages with ``python test/test_readme.py``.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# As a script it writes what the tree says, whatever copy of the package is installed.
sys.path.insert(0, str(ROOT))

from csas_shadow_ros.nodes.runtime.params import parameter_table, yaml_text  # noqa: E402
from msg_adapters.topics import topic_table  # noqa: E402

README = ROOT / "README.md"
PARAMETER_FILE = ROOT / "config" / "csas_shadow.yaml"


def cli_reference() -> str:
    """Return the page of the command line, by what draws the site."""
    spec = importlib.util.spec_from_file_location("docs_cli", ROOT / "docs" / "make" / "cli.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.cli_reference()


#: What stands between marks of that name, and on which page.
PARTS = {
    "topics": ("docs/topics.md", topic_table),
    "parameters": ("docs/parameters.md", parameter_table),
    "cli": ("docs/cli.md", cli_reference),
}


def marked(name: str) -> re.Pattern[str]:
    return re.compile(rf"(<!-- {name}:begin -->\n)(.*?)(<!-- {name}:end -->)", re.DOTALL)


@pytest.mark.parametrize("name", PARTS)
def test_the_page_has_what_the_code_makes(name: str) -> None:
    page, make = PARTS[name]
    found = marked(name).search((ROOT / page).read_text(encoding="utf-8"))
    assert found is not None, f"{page} has no <!-- {name}:begin --> marks"
    assert found[2].strip() == make().strip(), "run: python test/test_readme.py"


def test_the_parameter_file_holds_the_defaults_of_the_code() -> None:
    assert PARAMETER_FILE.read_text(encoding="utf-8") == yaml_text()


def documents() -> list[Path]:
    return [README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", documents(), ids=lambda page: page.name)
def test_every_link_in_the_documents_leads_to_a_file(page: Path) -> None:
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if not (page.parent / link).exists()]
    assert not missing, f"{page.name} links to {missing}"


@pytest.mark.parametrize("notebook", sorted((ROOT / "docs" / "notebooks").glob("*.py")), ids=lambda n: n.stem)
def test_every_link_in_a_notebook_leads_to_a_page_of_the_site(notebook: Path) -> None:
    """The site has pages, not their sources, and does not check what notebooks link to."""
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", notebook.read_text(encoding="utf-8"))
    pages = [(notebook.parent / link).with_suffix(".md") for link in links if link.endswith(".html")]
    assert len(pages) == len(links), f"{notebook.name} links to {links}; expected .html of the site"
    assert all(page.exists() for page in pages), links


def test_the_script_writes_what_the_tree_says_and_not_an_installed_copy(tmp_path: Path) -> None:
    for package in ("csas_shadow_ros", "msg_adapters"):
        shutil.copytree(ROOT / package, tmp_path / package)
    for part in ("docs", "config", "test"):
        (tmp_path / part).mkdir()
    shutil.copytree(ROOT / "docs" / "make", tmp_path / "docs" / "make")
    for page, _ in PARTS.values():
        shutil.copy(ROOT / page, tmp_path / page)
    shutil.copy(__file__, tmp_path / "test" / "test_readme.py")
    changed = tmp_path / "csas_shadow_ros" / "nodes" / "runtime" / "params.py"
    text = changed.read_text(encoding="utf-8")
    assert "record to this new directory" in text
    changed.write_text(text.replace("record to this new directory", "record to a new directory"), "utf-8")
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    subprocess.run([sys.executable, "test/test_readme.py"], cwd=tmp_path, env=environment, check=True)
    assert "record to a new directory" in (tmp_path / "docs" / "parameters.md").read_text(encoding="utf-8")
    assert "record to a new directory" in (tmp_path / "config" / "csas_shadow.yaml").read_text("utf-8")


def test_the_readme_is_short() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) < 120


def rewrite() -> None:
    for name, (page, make) in PARTS.items():
        path = ROOT / page
        before, _, rest = path.read_text(encoding="utf-8").partition(f"<!-- {name}:begin -->\n")
        after = rest.partition(f"<!-- {name}:end -->")[2]
        text = f"{before}<!-- {name}:begin -->\n{make()}<!-- {name}:end -->{after}"
        path.write_text(text, encoding="utf-8")
    PARAMETER_FILE.write_text(yaml_text(), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(rewrite())
