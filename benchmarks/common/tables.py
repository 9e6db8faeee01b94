"""Markdown tables, and the marked blocks of documents that hold them."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
  """Returns a Markdown table; ``number`` formats its cells."""
  lines = [head, ["---"] * len(head), *rows]
  return "\n".join("| " + " | ".join(map(number, line)) + " |" for line in lines)


def number(value: Any) -> str:
  """Returns a cell; a float has three significant digits."""
  if isinstance(value, float):
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
  return str(value)


def put(name: str, text: str, doc: Path) -> None:
  """Replaces the block of a document between the marks of that name.

  Raises:
    ValueError: The document lacks the marks.
  """
  begin, end = f"<!-- {name} -->", f"<!-- end {name} -->"
  before, found, rest = doc.read_text().partition(begin)
  _, closed, after = rest.partition(end)
  if not found or not closed:
    raise ValueError(f"{doc.name} has no marks {begin} and {end}")
  doc.write_text(f"{before}{begin}\n{text}\n{end}{after}")
