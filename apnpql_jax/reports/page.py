"""A report as one HTML file: curves, tables, settings and videos."""

from __future__ import annotations

import base64
from collections.abc import Sequence
import html
import io
import os
from pathlib import Path
import string
from urllib.parse import quote

from apnpql_jax.reports import figure, tables
from apnpql_jax.reports.groups import Group, tasks_of
from apnpql_jax.reports.reading import Run
from apnpql_jax.reports.statistics import AXES
from apnpql_jax.reports.tables import Rows
from apnpql_jax.runs.text import write_text

MAX_VIDEO_BYTES = 3 << 20
"""Size up to which a video is inside the page; larger ones are linked."""

MAX_VIDEOS_BYTES = 24 << 20
"""Size of all videos inside the page."""

_PAGE = string.Template("""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
  body { font: 15px/1.45 system-ui, sans-serif; color: #1c2430; background: #fff;
         max-width: 1180px; margin: 0 auto; padding: 1rem; }
  h1 { font-size: 1.4rem; margin: .2rem 0; }
  h2 { font-size: 1.1rem; margin: 1.8rem 0 .5rem; }
  p { margin: .4rem 0; } .note { color: #5c6673; font-size: .85rem; }
  .grid { display: grid; gap: .8rem;
          grid-template-columns: repeat(auto-fill, minmax(min(100%, 400px), 1fr)); }
  figure { margin: 0; border: 1px solid #dfe4ea; border-radius: 6px; padding: .5rem; }
  figcaption { font-size: .85rem; overflow-wrap: anywhere; }
  svg, video { width: 100%; height: auto; display: block; }
  .scroll { overflow-x: auto; border: 1px solid #dfe4ea; border-radius: 6px; }
  table { border-collapse: collapse; font-size: .85rem; width: 100%;
          font-variant-numeric: tabular-nums; }
  th, td { text-align: left; vertical-align: top; padding: .3rem .6rem;
           border-bottom: 1px solid #eceff3; min-width: 3.5rem; max-width: 22rem;
           overflow-wrap: break-word; }
  th { background: #f5f7f9; } tr:last-child td { border-bottom: 0; }
  td.short, th:first-child { white-space: nowrap; }
  td:not(.short) { min-width: 11rem; }
  tr.differs td { background: #fff6dd; }
  .key { display: flex; flex-wrap: wrap; gap: .2rem 1.1rem; margin: .5rem 0; }
  .key i { display: inline-block; width: 1.1em; height: .28em; margin-right: .4em;
           vertical-align: middle; border-radius: 2px; }
  summary { cursor: pointer; margin: .8rem 0; }
</style>
<h1>$title</h1>
<p class="note">$note</p>
<h2>Success</h2>
$key
<div class="grid">$curves</div>
<p class="note">$caption</p>
<h2>Groups</h2>
$groups
<h2>Settings that differ</h2>
$differing
<details><summary>All settings</summary>$settings</details>
<h2>Runs</h2>
$runs
$videos
</html>
""")


def write(groups: Sequence[Group], path: Path, *, band: str = "interval") -> None:
  """Writes the page; it needs no other file, except for videos that are too large."""
  title = f"Comparison of {', '.join(tasks_of(groups))}"
  runs = [run for group in groups for run in group.runs]
  found = html.escape(tables.listed(tables.commits(runs)))
  differing = tables.of_settings(groups)
  names = {row[0] for row in differing}
  page = _PAGE.substitute(
    title=html.escape(title),
    note=f"{len(runs)} runs" + (f", made at commit {found}" if found else ""),
    key=_key(groups),
    curves="".join(_curves(groups, band)),
    caption=html.escape(figure.caption(groups, band)),
    groups=_table(tables.of_groups(groups)),
    differing=_table(differing) if len(differing) > 1 else "<p>None.</p>",
    settings=_table(tables.of_settings(groups, whole=True), marked=names),
    runs=_table(tables.of_runs(groups)),
    videos=_videos(groups, path.absolute().parent),
  )
  write_text(path, page)


def _key(groups: Sequence[Group]) -> str:
  """Returns the legend that all panels share."""
  items = "".join(
    f'<span><i style="background:{color}"></i>{html.escape(title)}</span>'
    for title, color in figure.colors_of(groups).items()
  )
  return f'<div class="key">{items}</div>'


def _curves(groups: Sequence[Group], band: str) -> list[str]:
  """Returns a figure for each task and axis."""
  colors = figure.colors_of(groups)
  found = []
  for task in tasks_of(groups):
    members = [group for group in groups if group.task == task]
    for axis in AXES:
      image = io.StringIO()
      figure.save_panel(members, image, axis, colors, band=band, title=task)
      svg = image.getvalue()
      found.append(f"<figure>{svg[svg.index('<svg') :]}</figure>")
  return found


def _table(rows: Rows, *, marked: set[str] | None = None) -> str:
  """Returns a table; rows whose first cell is ``marked`` are highlighted."""
  head, *body = [[html.escape(cell) for cell in row] for row in rows]
  lines = ["<tr>" + "".join(f"<th>{cell}</th>" for cell in head) + "</tr>"]
  for row in body:
    kind = ' class="differs"' if marked and row[0] in marked else ""
    cells = (f"<td{_short(cell)}>{cell}</td>" for cell in row)
    lines.append(f"<tr{kind}>{''.join(cells)}</tr>")
  return f'<div class="scroll"><table>{"".join(lines)}</table></div>'


def _short(cell: str) -> str:
  """Returns the class of a cell that stays on one line."""
  return ' class="short"' if len(cell) < 24 else ""


def _videos(groups: Sequence[Group], folder: Path) -> str:
  """Returns the newest video of each run, as far as there is room."""
  found, left = [], MAX_VIDEOS_BYTES
  for group in groups:
    for run in group.runs:
      if (video := newest_video(run)) is None:
        continue
      size = video.stat().st_size
      inside = size <= min(MAX_VIDEO_BYTES, left)
      left -= size if inside else 0
      about = html.escape(f"{tables.column(group, groups)}, seed {run.config.seed}")
      found.append(_video(video, folder, about, inside=inside))
  if not found:
    return ""
  return f'<h2>Videos</h2><div class="grid">{"".join(found)}</div>'


def _video(video: Path, folder: Path, about: str, *, inside: bool) -> str:
  """Returns a figure that holds a video or links to it."""
  if not inside:
    target = quote(os.path.relpath(video.resolve(), folder.resolve()))
    link = f'<a href="{html.escape(target)}">{html.escape(video.name)}</a>'
    return f"<figure><figcaption>{about}: {link}</figcaption></figure>"
  data = base64.b64encode(video.read_bytes()).decode()
  source = f"data:video/mp4;base64,{data}"
  return (
    f'<figure><video controls muted loop preload="metadata" src="{source}"></video>'
    f"<figcaption>{about}</figcaption></figure>"
  )


def newest_video(run: Run) -> Path | None:
  """Returns the last video of a run's evaluations, if there is one."""
  paths = (run.folder / "videos").glob("step_*.mp4") if run.folder else ()
  # Others are being written, or were when their process was killed.
  whole = (path for path in paths if path.stem.removeprefix("step_").isdecimal())
  return max(whole, default=None)
