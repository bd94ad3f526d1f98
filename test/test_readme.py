"""The README's tables are those of the code, and its links lead somewhere.

Rewrite the tables with ``python test/test_readme.py``.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from csas_shadow_ros.nodes.params import parameter_table, yaml_text
from msg_adapters.topics import topic_table

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
TABLES = {"topics": topic_table, "parameters": parameter_table}


def marked(name: str) -> re.Pattern[str]:
    return re.compile(rf"(<!-- {name}:begin -->\n)(.*?)(<!-- {name}:end -->)", re.DOTALL)


@pytest.mark.parametrize("name", TABLES)
def test_the_readme_has_the_table_that_the_code_makes(name: str) -> None:
    found = marked(name).search(README.read_text(encoding="utf-8"))
    assert found is not None, f"README.md has no <!-- {name}:begin --> marks"
    assert found[2].strip() == TABLES[name]().strip(), "run: python test/test_readme.py"


def test_the_parameter_file_holds_the_defaults_of_the_code() -> None:
    assert (ROOT / "config" / "csas_shadow.yaml").read_text(encoding="utf-8") == yaml_text()


def documents() -> list[Path]:
    return [README, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", documents(), ids=lambda page: page.name)
def test_every_link_in_the_documents_leads_to_a_file(page: Path) -> None:
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if not (page.parent / link).exists()]
    assert not missing, f"{page.name} links to {missing}"


def rewrite() -> None:
    text = README.read_text(encoding="utf-8")
    for name, table in TABLES.items():
        text = marked(name).sub(lambda m, t=table: m[1] + t() + m[3], text)
    README.write_text(text, encoding="utf-8")
    (ROOT / "config" / "csas_shadow.yaml").write_text(yaml_text(), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(rewrite())
