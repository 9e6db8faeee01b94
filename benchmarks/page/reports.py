"""Tables of each benchmark's report, as Markdown."""

from collections.abc import Callable, Iterable
import math
from typing import Any

from benchmarks.common.tables import number, table

Report = dict[str, Any]
Result = dict[str, Any]

ORACLES = {"rasteriser": "MuJoCo's rasterizer", "rays": "MuJoCo's rays"}
RENDERERS = {
  "mujoco_egl": "MuJoCo, EGL",
  "mujoco_osmesa": "MuJoCo, OSMesa",
  "pybullet_tiny": "PyBullet, TinyRenderer",
}
MODULES = {
  "fidelity": "quality.fidelity",
  "memory": "reliability.memory",
  "peers": "peers.compare",
  "stable_baselines": "peers.stable_baselines",
}
"""Modules of benchmarks outside ``benchmarks.speed``."""

UNITS = {
  "pixels": "pixels of a pair of images",
  "slots": "slots of the replay",
  "contacts": "contact slots",
}
"""Axis of growth -> unit of its sizes, where the names differ."""

COLUMNS = {
  "fidelity": "scene|camera|equal pixels=agreeing:%|mean IoU=iou_mean:.3f"
  "|least IoU=iou_least:.3f|median depth error, um=depth_median_um:.1f"
  "|99 %, um=depth_p99_um:.0f",
  "render": "images|batch|shadow|pairs/s=pairs_per_s:rate",
  "other_renderers": "images|renderer|ray caster / renderer=ratio",
  "ray_layouts": "layout|batch|pairs/s=pairs_per_s:rate|compilation, s=compile_s"
  "|equal pixels=agreeing:%",
  "learner": "batch|candidates|phi once, updates/s=once.updates_per_s:rate"
  "|bfloat16, updates/s=bfloat16.updates_per_s"
  "|repeated, updates/s=repeated.updates_per_s|ratio",
  "timeline": "part|ms|share=share:share",
  "physics_timeline": "part|ms|share=share:share",
  "encoder_layouts": "encoder=layout|updates/s=updates_per_s:rate"
  "|share of the images=images:share",
  "env_steps": "task|backend|obs|worlds|env, steps/s=env.steps_per_s:rate"
  "|env + policy, steps/s=env_policy.steps_per_s:rate",
  "end_to_end": "task|backend|obs|worlds|steps/s=steps_per_s:rate"
  "|updates/s=updates_per_s",
  "compile_time": "task|backend|cold, s=cold.seconds|warm, s=warm.seconds"
  "|imports alone, s=imports.seconds",
  "memory": "replays, GB=replay_gb|announced, GB=announced_gb|peak, GB=peak_gb"
  "|steady, GB=steady_gb|new, MiB=new_mib|written, MiB=checkpoint_mib"
  "|checkpoint, s=checkpoint_s|iteration, s=iteration_s|longest, s=longest_s"
  "|all of it, MiB=whole_mib|s=whole_s",
  "peers": "peer|with|rate|ours / theirs (over rounds)=ratio",
  "stable_baselines": "learner=row|minutes to 80 %=minutes_to_80|best|steps"
  "|after, min=minutes",
}
"""A column is HEAD=PATH:FORM; without a path the head is the key of the result."""


SETTINGS = "batch candidates candidate_precision states processes worlds rounds".split()
"""Settings that a caption names."""

SMALL = 0.01  # share of a part of a time line that has no row of its own


def block(report: Report) -> str:
  """Returns a caption and the tables of a report."""
  name = report["benchmark"]
  results, extra = PREPARE.get(name, lambda report: (report["results"], []))(report)
  if name == "growth":
    return "\n\n".join([caption(report), *extra])
  spec = COLUMNS.get(name) or "|".join(results[0])
  return "\n\n".join([caption(report), columns(results, spec), *extra])


def caption(report: Report) -> str:
  """Returns command, commit, machine and settings of a report."""
  versions, cores = report["versions"], report["cores"]
  command = f"{module(report['benchmark'])} {report.get('options', '...')}"
  parts = [
    f"`python -m {report.get('command', command)}`",
    f"commit {report['commit'] or 'unknown'}",
    f"{report['device']}, {cores} core{'s' * (cores > 1)}",
    *(f"{name} {versions[name]}" for name in ("jax", "mujoco") if name in versions),
    *(report[key] for key in ("scene", "preset") if key in report),
  ]
  for key in SETTINGS:
    parts += [f"{key.replace('_', ' ')} {report[key]}"] if key in report else []
  if report.get("precision", "highest") != "highest":
    parts.append(report["precision"])
  if "oracle" in report:
    parts.append(f"against {ORACLES.get(report['oracle'], report['oracle'])}")
  if "repeats" in report:
    flops, moved = (number(rate / 1e9) for rate in report["peak"].values())
    parts.append(f"{flops} GFLOP/s, {moved} GB/s")
    parts.append(f"medians of {report['repeats']} (lowest to highest)")
  return ", ".join(parts)


def module(name: str) -> str:
  """Returns the module that runs a benchmark."""
  return f"benchmarks.{MODULES.get(name, f'speed.{name}')}"


def columns(results: Iterable[Result], spec: str) -> str:
  """Returns a table with a row for each result; see ``COLUMNS``."""
  head, chosen = [], []
  for column in spec.split("|"):
    title, _, rest = column.partition("=")
    path, _, form = (rest or title).partition(":")
    head += [title, "limit", "reached"] if form == "rate" else [title]
    chosen.append((path.split("."), form))
  rows = [[x for c in chosen for x in cells(result, *c)] for result in results]
  return table(head, rows)


def cells(result: Result, path: list[str], form: str) -> list[Any]:
  """Returns a cell, or three of a rate: median, limit of the machine, share reached."""
  *parents, key = path
  for parent in parents:
    result = result.get(parent, {})
  value, reached = result.get(key), result.get("of_floor")
  if form == "rate":
    limit = value / reached if value and reached else ""
    return [spread(result, key), limit, percent(reached)]
  if form == "part":
    return [percent(value) + (f" ({percent(reached)})" if reached else "")]
  if form == "share":
    return [percent(value)]
  if form == "%":
    return [f"{100 * result[key]:.2f} %"]
  return [format(value, form) if form else spread(result, key)]


def spread(result: Result, key: str) -> str:
  """Returns the median with the lowest and the highest of the repeats, if there are."""
  if key not in result:
    return "missing" if "missing" in result else ""
  if f"{key}_low" not in result:
    return number(result[key])
  median, low, high = (number(result[f"{key}{end}"]) for end in ("", "_low", "_high"))
  return f"{median} ({low} to {high})"


def percent(value: float | None) -> str:
  """Returns a share; below 10 % it has two significant digits."""
  if value is None:
    return ""
  value = round(value, 6)  # Rounding errors become zero.
  return f"{100 * value:.0f} %" if value >= 0.1 else f"{100 * value:.2g} %"


Prepared = tuple[list[Result], list[str]]  # rows of the first table, and further tables


def render(report: Report) -> Prepared:
  """Separates the ray caster from other renderers, which are reported as ratios."""
  ours, others, best = [], [], {}
  for result in report["results"]:
    name, rate = result["resolution"], result.get("pairs_per_s", math.nan)
    sizes = report["resolutions"][name].values()
    result = result | {"images": " + ".join(f"{h}x{w}" for h, w in sizes)}
    if result["renderer"] == "ray_caster":
      best[name] = max(rate, best.get(name, 0.0))
      ours.append(result | {"shadow": "of the hand" if result["shadow"] else ""})
    else:
      others.append(result | {"renderer": RENDERERS[result["renderer"]]})
  for result in others:
    if "missing" not in result:
      result["ratio"] = best[result["resolution"]] / result["pairs_per_s"]
  return ours, [columns(others, COLUMNS["other_renderers"])] if others else []


def learner(report: Report) -> Prepared:
  """Puts the features computed once and repeated into one row."""
  found: dict[tuple[int, int], Result] = {}
  for result in report["results"]:
    row = found.setdefault((result["batch"], result["candidates"]), dict(result))
    row[result["phi"]] = result
    if "repeated" in row:
      rates = (row[phi]["updates_per_s"] for phi in ("once", "repeated"))
      row["ratio"] = next(rates) / next(rates)
  return list(found.values()), []


def encoder_layouts(report: Report) -> Prepared:
  """Adds the share of the images in an update."""
  rates = {result["layout"]: result["updates_per_s"] for result in report["results"]}
  blind = rates.get("none", math.nan)
  rows = [r | {"images": 1 - r["updates_per_s"] / blind} for r in report["results"]]
  return rows, []


def timeline(report: Report) -> Prepared:
  """Merges small parts into the rest, which follows the others."""
  *parts, whole = report["results"]
  large = [x for x in parts if x["share"] >= SMALL and x["part"] != "rest"]
  rest = {k: sum(x[k] for x in parts if x not in large) for k in ("ms", "share")}
  return [*large, {"part": "rest"} | rest, whole], []


def with_parts(report: Report) -> Prepared:
  """Adds a table with the share of each part, and what it reaches of its limit."""
  names = dict.fromkeys(name for r in report["results"] for name in r["parts"])
  names = sorted(names, key=lambda name: name == "rest")
  spec = "|".join(f"{name}=parts.{name}.share:part" for name in names)
  results = report["results"]
  return results, [columns(results, f"task|backend|obs|worlds|{spec}")]


def peers(report: Report) -> Prepared:
  """Joins the facts about a peer."""
  rows = []
  for result in report["results"]:
    about = (f"{name} {value}" for name, value in result.get("about", {}).items())
    rows.append(result | {"with": ", ".join(about)})
  return rows, []


def stable_baselines(report: Report) -> Prepared:
  """Adds the best evaluation of each learner and the end of its curve."""
  rows = []
  for result in report["results"]:
    curve = result["curve"]
    best = percent(max(point["success_rate"] for point in curve))
    reached = result["minutes_to_80"] or "not reached"
    rows.append(result | curve[-1] | {"best": best, "minutes_to_80": reached})
  return rows, []


def growth(report: Report) -> Prepared:
  """Makes a table for each axis, with the exponent of growth since the last size."""
  found = []
  for axis, series in curves(report).items():
    head, rows = [UNITS.get(axis, axis)], {}
    for name, points in series.items():
      head += [f"{name}, ms", "exponent", "reached"]
      for last, point in zip([None, *points], points, strict=False):
        in_ms = {k: 1e3 * x for k, x in point.items() if k.startswith("seconds")}
        row = rows.setdefault(point["size"], [point["size"]])
        row += [spread(in_ms, "seconds"), exponent(last, point)]
        row += [percent(point["of_floor"])]
    found.append(table(head, rows.values()))
  return [], found


def curves(report: Report) -> dict[str, dict[str, list[Result]]]:
  """Returns the points of growth by axis and series."""
  found: dict[str, dict[str, list[Result]]] = {}
  for point in report["results"]:
    series = found.setdefault(point["axis"], {})
    series.setdefault(point["series"], []).append(point)
  return found


def exponent(last: Result | None, point: Result) -> str:
  """Returns the exponent of growth; 1 is in proportion to the size."""
  if last is None:
    return ""
  slower = math.log(point["seconds"] / last["seconds"])
  return f"{slower / math.log(point['size'] / last['size']):.2f}"


PREPARE: dict[str, Callable[[Report], Prepared]] = {
  "render": render,
  "learner": learner,
  "timeline": timeline,
  "physics_timeline": timeline,
  "encoder_layouts": encoder_layouts,
  "env_steps": with_parts,
  "end_to_end": with_parts,
  "growth": growth,
  "peers": peers,
  "stable_baselines": stable_baselines,
}
