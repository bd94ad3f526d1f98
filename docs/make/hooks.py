"""What the site needs besides mkdocs: equations as MathML, links into the tree, graphs without a CDN.

The pages are written to be read in the repository too: a link from one leads to the file itself. On the site
it leads to a copy of that file, so that nothing is fetched from elsewhere and no link is dead.
"""

from __future__ import annotations

import html
import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

import latex2mathml.converter
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
#: Pages of the repository's root, and what they are on the site.
HOMES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
#: `make docs` puts them there, from npm.
MERMAID, FONT = (ROOT / "build" / "from_npm" / name for name in ("mermaid.js", "math.woff2"))
_LINK = re.compile(r"(?<=\]\()([^)#:\s]+)((?:#[^)]*)?)(?=\))")
_NAMED = re.compile(r"\[(?:docs/)?(\w+\.md)\](?=\()")
_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_LOADER = re.compile(r"<script[^>]*>(?:(?!</script>).)*cdnjs(?:(?!</script>).)*</script>", re.DOTALL)
_FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
#: What a browser shows as it is; source texts get .txt, or it would save them instead.
_PICTURES = (".png", ".gif", ".svg")


def on_config(config: Any) -> Any:
    """Learn the pages' titles; draw mermaid's graphs where it is at hand, otherwise they stay text."""
    _learn(config.nav)
    if MERMAID.exists():
        config.extra_javascript.append("mermaid.js")
        from pymdownx.superfences import fence_code_format

        fence = {"name": "mermaid", "class": "mermaid", "format": fence_code_format}
        config.mdx_configs.setdefault("pymdownx.superfences", {})["custom_fences"] = [fence]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the root's pages, and every file that a page links to."""
    for path in (MERMAID, FONT):
        if path.exists():
            files.append(File.generated(config, path.name, abs_src_path=str(path)))
    pages = {f"docs/{page.src_uri}": page.content_string for page in files.documentation_pages()}
    for name in ("CONTRIBUTING.md", "CHANGELOG.md"):
        text = pages[name] = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, HOMES[name], content=_on_site(text, name)))
    for page, text in pages.items():
        if not page.endswith(".md"):
            continue
        for link, _ in _LINK.findall(_FENCE.sub("", text)):
            target = _target(page, link)
            if not target.startswith("docs/") and (ROOT / target).is_file() and target not in HOMES:
                there = _site_name(target)
                if files.get_file_from_path(there) is None:
                    files.append(File.generated(config, there, abs_src_path=str(ROOT / target)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links into the tree lead to the copies."""
    if page.file.src_uri in HOMES.values() and page.file.src_uri != "index.md":
        return markdown  # done in on_files
    return _on_site(markdown, f"docs/{page.file.src_uri}")


def on_post_page(output: str, **_: Any) -> str:
    """Leave out the notebooks' loader of mermaid, which would ask a CDN."""
    return _LOADER.sub("", output)


def on_page_content(content: str, **_: Any) -> str:
    """Turn TeX into MathML, which browsers draw without a script."""

    def equation(found: re.Match[str]) -> str:
        display = "block" if found[2] == "[" else "inline"
        return latex2mathml.converter.convert(html.unescape(found[3]).strip(), display=display)

    return _EQUATION.sub(equation, content)


_TITLES: dict[str, str] = {}


def _learn(nav: Any) -> None:
    """Note the titles of the navigation, for links that are called by a file's name."""
    for one in nav:
        for title, what in one.items():
            if isinstance(what, str):
                _TITLES[what] = title
            else:
                _learn(what)


def _target(page: str, link: str) -> str:
    """Return the file of the repository that a page's link leads to."""
    return os.path.normpath(PurePosixPath(page).parent / link)


def _site_name(target: str) -> str:
    return f"source/{target}" + ("" if target.endswith(_PICTURES) else ".txt")


def _on_site(text: str, page: str) -> str:
    text = _NAMED.sub(lambda found: f"[{_TITLES.get(found[1], found[1])}]", text)

    def moved(found: re.Match[str]) -> str:
        target = _target(page, found[1])
        if target in HOMES:
            return HOMES[target] + found[2]
        if target.startswith("docs/"):
            return (target.removeprefix("docs/") if not page.startswith("docs/") else found[1]) + found[2]
        return _site_name(target) if (ROOT / target).is_file() else found[0]

    parts, at = [], 0
    for fence in _FENCE.finditer(text):
        parts += [_LINK.sub(moved, text[at : fence.start()]), fence[0]]
        at = fence.end()
    return "".join([*parts, _LINK.sub(moved, text[at:])])
