"""MkDocs hooks: pages from outside ``docs/``, reference pages, and links between them.

Links in the documents lead to files of the repository, so that they work there too.
"""

from __future__ import annotations

from collections.abc import Iterator
import fnmatch
import os
from pathlib import Path
import re
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "apnpql_jax"

MOVED = {
  "README.md": "index.md",
  "CONTRIBUTING.md": "contributing.md",
  "CHANGELOG.md": "changelog.md",
  "benchmarks/README.md": "benchmarks.md",
}
"""Path in the repository -> path in the site."""

KEPT = (
  "experiments/log.md",
  "experiments/results/**/README.md",
  "experiments/results/**/*.png",
)
"""Files outside ``docs/`` that have the same path in the site."""

LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s:#]+)(?:#([^)\s]*))?\)")


def on_config(config: Any) -> Any:
  """Replaces each path with a star in the navigation by the pages that match it."""
  config.nav = [_expanded(entry, _pages()) for entry in config.nav]
  return config


def on_files(files: Any, config: Any) -> Any:
  """Adds the pages from outside ``docs/`` and one reference page per package."""
  for site, source in _outside().items():
    files.append(File.generated(config, site, abs_src_path=str(ROOT / source)))
  for site, modules in _reference().items():
    title = f"# {Path(site).stem}"
    text = "\n\n".join([title, *(f"::: {module}" for module in modules)])
    files.append(File.generated(config, site, content=text))
  return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
  """Makes links between files of the repository lead to the pages of the site."""
  del config
  here = page.file.src_uri
  source = Path(_outside().get(here, f"docs/{here}"))

  def link(match: re.Match[str]) -> str:
    image, text, target, name = match.groups()
    path = os.path.normpath(source.parent / target)
    if not (ROOT / path).exists():
      return match[0]  # MkDocs reports it.
    site, anchor = _target(path, name or "")
    if files.get_file_from_path(site) is None:
      return text  # In the repository only.
    relative = os.path.relpath(site, os.path.dirname(here) or ".")
    return f"{image}[{text}]({relative}{anchor and '#' + anchor})"

  return LINK.sub(link, markdown)


def _target(path: str, name: str) -> tuple[str, str]:
  """Returns the page and anchor that stand for ``name`` in a file of the repository."""
  if not path.startswith(f"{PACKAGE.name}/"):
    return MOVED.get(path, path.removeprefix("docs/")), name
  module = path.removesuffix(".py").replace("/", ".")
  return _page_of(module), f"{module}.{name}" if name else module


def _outside() -> dict[str, str]:
  """Returns path in the site -> path in the repository, of pages outside ``docs/``."""
  kept = (path for pattern in KEPT for path in ROOT.glob(pattern))
  same = {name: name for name in (str(path.relative_to(ROOT)) for path in kept)}
  return {site: source for source, site in MOVED.items()} | same


def _reference() -> dict[str, list[str]]:
  """Returns reference page -> modules on it: one page per package."""
  pages: dict[str, list[str]] = {}
  for path in sorted(PACKAGE.rglob("*.py")):
    if path.stem.startswith("__"):
      continue
    parts = path.relative_to(ROOT).with_suffix("").parts
    module = ".".join(parts)
    pages.setdefault(_page_of(module), []).append(module)
  return pages


def _page_of(module: str) -> str:
  """Returns the reference page of a module: that of its package."""
  package = module.split(".")[1:-1] or [PACKAGE.name]
  return f"reference/{'.'.join(package)}.md"


def _pages() -> list[str]:
  """Returns the paths in the site of all pages, sorted, an index before the others."""
  docs = (str(path.relative_to(ROOT / "docs")) for path in ROOT.glob("docs/**/*.md"))
  pages = {*docs, *_outside(), *_reference()}
  return sorted(pages, key=lambda page: (not page.endswith("index.md"), page[:-3]))


def _expanded(entry: Any, pages: list[str]) -> Any:
  if isinstance(entry, list):
    return [new for old in entry for new in _listed(_expanded(old, pages))]
  if isinstance(entry, dict):
    return {title: _expanded(inside, pages) for title, inside in entry.items()}
  return fnmatch.filter(pages, entry) if "*" in entry else entry


def _listed(entry: Any) -> Iterator[Any]:
  yield from entry if isinstance(entry, list) else [entry]
