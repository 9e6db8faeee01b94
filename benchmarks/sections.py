"""What docs/performance.md says of each benchmark, made of its report."""

from __future__ import annotations

import math
from typing import Any

import gpu_suite
from tables import number, table

Report = dict[str, Any]
Rates = dict[str, dict[str, dict[int, float]]]
"""Steps per second by engine, by what is played or trained, and by worlds."""

RENDERERS = {
  "ray_caster": "ray caster",
  "mujoco_egl": "MuJoCo, EGL",
  "mujoco_osmesa": "MuJoCo, OSMesa",
  "pybullet_tiny": "PyBullet, TinyRenderer",
}
SETTING = ("task", "backend", "obs", "worlds")
SIZES = {
  "worlds": "worlds",
  "candidates": "candidates",
  "pixels": "pixels of a pair of images",
  "slots": "slots of the replay",
  "contacts": "contact slots",
}
"""Axis of growth -> what its sizes count."""


def fidelity(report: Report) -> str:
  """How the ray caster's images compare with MuJoCo's."""
  head = (
    "scene",
    "camera",
    "pixels that agree",
    "IoU, mean",
    "IoU, least",
    "depth error, median",
    "99 %",
  )
  rows = [
    (
      row["scene"],
      row["camera"],
      f"{100 * row['agreeing']:.2f} %",
      f"{row['iou_mean']:.3f}",
      f"{row['iou_least']:.3f}",
      f"{row['depth_median_um']:.1f} um",
      f"{row['depth_p99_um']:.0f} um",
    )
    for row in report["rows"]
  ]
  against = {"rasteriser": "MuJoCo's rasteriser", "rays": "MuJoCo's rays"}
  text = (
    f"Against {against[report['oracle']]}, {report['states']} states of each scene."
  )
  return f"{text}\n\n{table(head, rows)}"


def render(report: Report) -> str:
  """Pairs of images per second; of other renderers, how many times ours draws."""
  columns = ("renderer", "batch", "images", "shadow", "pairs/s", "limit", "reached")
  head = (*columns, "times as fast")
  rows = []
  for name, sizes in report["resolutions"].items():
    images = " + ".join(f"{height}x{width}" for height, width in sizes.values())
    results = [r for r in report["results"] if r["resolution"] == name]
    ours = [r for r in results if r["renderer"] == "ray_caster"]
    fastest = max((r["pairs_per_s"] for r in ours), default=0.0)
    for result in results:
      shadow = "of the hand" if result.get("shadow") else ""
      label = (RENDERERS[result["renderer"]], result.get("batch", 1), images, shadow)
      if result in ours or "missing" in result:
        rows.append((*label, *rate(result, "pairs"), ""))
      else:
        rows.append((*label, "", "", "", fastest / result["pairs_per_s"]))
  return f"{report['scene']}. {note(report)}\n\n{table(head, rows)}"


def ray_layouts(report: Report) -> str:
  """Pairs of images per second by the layout of the ray caster's work."""
  columns = ("layout", "batch", "pairs/s", "limit", "reached")
  head = (*columns, "compilation, s", "pixels as in use")
  rows = [
    (
      result["layout"],
      result["batch"],
      *rate(result, "pairs"),
      result["compile_s"],
      f"{100 * result['agreeing']:.2f} %",
    )
    for result in report["results"]
  ]
  return f"{report['scene']}. {note(report)}\n\n{table(head, rows)}"


def learner(report: Report) -> str:
  """Updates per second, with and without the features being shared."""
  found: dict[tuple[int, int], dict[str, Any]] = {}
  for result in report["results"]:
    setting = (result["batch"], result["candidates"])
    found.setdefault(setting, {})[result["phi"]] = result
  head = (
    "batch",
    "candidates",
    "phi once, updates/s",
    "limit",
    "reached",
    "repeated, updates/s",
    "times faster",
  )
  rows = []
  for setting, kinds in found.items():
    once, again = kinds["once"], kinds["repeated"]
    gain = once["updates_per_s"] / again["updates_per_s"]
    rows.append((*setting, *rate(once, "updates"), rate(again, "updates")[0], gain))
  return f"{report['preset']}. {note(report)}\n\n{table(head, rows)}"


def encoder_layouts(report: Report) -> str:
  """Updates per second by the layout of the encoder, and the share of the images."""
  rates = {result["layout"]: result["updates_per_s"] for result in report["results"]}
  blind = rates.get("none")
  head = ("encoder", "updates/s", "limit", "reached", "share of the images")
  rows = []
  for result in report["results"]:
    share = percent(1.0 - result["updates_per_s"] / blind) if blind else ""
    rows.append((result["layout"], *rate(result, "updates"), share))
  about = f"{report['preset']}, batch {report['batch']}."
  return f"{about} {note(report)}\n\n{table(head, rows)}"


def env_steps(report: Report) -> str:
  """Steps per second without and with the policy."""
  parts = _parts(report)
  head = (
    *SETTING,
    "env, steps/s",
    "limit",
    "reached",
    "env + policy, steps/s",
    "limit",
    "reached",
    *parts,
  )
  rows = [
    (
      *(result[name] for name in SETTING),
      *rate(result["env"], "steps"),
      *rate(result["env_policy"], "steps"),
      *(_part(result["parts"].get(part)) for part in parts),
    )
    for result in report["results"]
  ]
  return f"{note(report)}\n\n{table(head, rows)}"


def end_to_end(report: Report) -> str:
  """Steps and updates per second of training."""
  parts = _parts(report)
  head = (*SETTING, "steps/s", "limit", "reached", "updates/s", *parts)
  rows = [
    (
      *(result[name] for name in SETTING),
      *rate(result, "steps"),
      spread(result, "updates_per_s"),
      *(_part(result["parts"].get(part)) for part in parts),
    )
    for result in report["results"]
  ]
  plot = "![steps per second by worlds](images/rates.png)"
  return f"{note(report)}\n\n{table(head, rows)}\n\n{plot}"


def rates(env_steps: Report, end_to_end: Report) -> Rates:
  """Steps per second of the first task by number of worlds."""
  task = env_steps["results"][0]["task"]
  found: Rates = {}

  def put(result: dict[str, Any], label: str, steps: float) -> None:
    if result["task"] == task:
      curves = found.setdefault(result["backend"], {})
      curves.setdefault(label, {})[result["worlds"]] = steps

  for result in env_steps["results"]:
    put(result, "env", result["env"]["steps_per_s"])
    put(result, "env + policy", result["env_policy"]["steps_per_s"])
  for result in end_to_end["results"]:
    put(result, "env + policy + learning", result["steps_per_s"])
  return found


def compile_time(report: Report) -> str:
  """Seconds until the first iteration is done."""
  head = ("task", "backend", "cold, s", "warm, s", "imports alone, s")
  rows = [
    (
      result["task"],
      result["backend"],
      *(spread(result[kind], "seconds") for kind in ("cold", "warm", "imports")),
    )
    for result in report["results"]
  ]
  return f"{note(report)}\n\n{table(head, rows)}"


def growth(report: Report) -> str:
  """A table for each axis; the exponent since the last size is one where time grows in
  proportion."""
  tables = []
  for axis, series in curves(report).items():
    head, rows = [SIZES[axis]], {}
    for name, points in series.items():
      head += [f"{name}, ms", "exponent", "reached"]
      for last, point in zip([None, *points], points, strict=False):
        rows.setdefault(point["size"], [point["size"]]).extend(_point(last, point))
    tables.append(table(head, rows.values()))
  return "\n\n".join([note(report), "![growth](images/growth.png)", *tables])


def peers(report: Report) -> str:
  """Ratios of this project's rates to those of others."""
  head = ("peer", "with", "rate", "ours / theirs", "over rounds")
  rows = [
    (
      result["peer"],
      ", ".join(f"{name} {value}" for name, value in result.get("about", {}).items()),
      result.get("rate", "-"),
      *_ratio(result),
    )
    for result in report["results"]
  ]
  about = (
    f"{report['task']}. {machine(report)}; theirs in {report['processes']} processes, "
    f"ours with {report['worlds']} worlds; updates of batch {report['batch']} with "
    f"{report['candidates']} candidates; medians of {report['rounds']} rounds."
  )
  return f"{about}\n\n{table(head, rows)}"


def _ratio(result: dict[str, Any]) -> tuple[Any, str]:
  if "missing" in result:
    return "-", f"missing: {result['missing']}"
  return result["ratio"], " to ".join(
    number(result[f"ratio_{end}"]) for end in ("low", "high")
  )


def gpu(report: Report) -> str:
  """All that the suite found on a GPU."""
  head = ("section", "figure", "per second", "", "compile s", "GiB", "note")
  found = report["sections"]["device"]["results"]
  device = next(result for result in found if result["what"] == "device")
  about = f"{device['kind']}, {_versions(device)}, commit {report['commit']}."
  return f"{about}\n\n{table(head, gpu_suite.rows(report))}"


def curves(report: Report) -> dict[str, dict[str, list[dict[str, Any]]]]:
  """The points of growth by axis and series."""
  found: dict[str, dict[str, list[dict[str, Any]]]] = {}
  for point in report["results"]:
    series = found.setdefault(point["axis"], {})
    series.setdefault(point["series"], []).append(point)
  return found


def _point(last: dict[str, Any] | None, point: dict[str, Any]) -> list[Any]:
  exponent: Any = ""
  if last is not None:
    slower = math.log(point["seconds"] / last["seconds"])
    exponent = f"{slower / math.log(point['size'] / last['size']):.2f}"
  names = ("seconds", "seconds_low", "seconds_high")
  in_ms = {name: 1e3 * point[name] for name in names}
  return [spread(in_ms, "seconds"), exponent, percent(point["of_floor"])]


def rate(result: dict[str, Any], name: str) -> tuple[Any, Any, Any]:
  """Cells: so many per second, the limit of this machine, and what share is reached."""
  if "missing" in result:
    return f"missing: {result['missing']}", "", ""
  median = spread(result, f"{name}_per_s")
  if "of_floor" not in result:
    return median, "", ""
  limit = result[f"{name}_per_s"] / result["of_floor"]
  return median, limit, percent(result["of_floor"])


def spread(result: dict[str, Any], name: str) -> str:
  """The median with the lowest and the highest of the repeats, where there are some."""
  median = number(result[name])
  if f"{name}_low" not in result:
    return median
  return (
    f"{median} ({number(result[f'{name}_low'])} to {number(result[f'{name}_high'])})"
  )


def percent(share: float) -> str:
  """A share, with two digits that count where it is small."""
  share = round(share, 6)  # What rounding leaves is none.
  return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def machine(report: Report) -> str:
  """On what a report was measured, and with what."""
  return (
    f"{report['device']}, {report['cores']} cores, {_versions(report)}, commit "
    f"{report['commit'] or 'unknown'}"
  )


def note(report: Report) -> str:
  """The machine and what it can do."""
  peak = report["peak"]
  return (
    f"{machine(report)}; {number(peak['flops_per_s'] / 1e9)} GFLOP/s and "
    f"{number(peak['bytes_per_s'] / 1e9)} GB/s; medians of {report['repeats']} (lowest "
    "to highest)."
  )


def _versions(report: Report) -> str:
  return ", ".join(f"{name} {x}" for name, x in report["versions"].items())


def _parts(report: Report) -> list[str]:
  """Names of all parts that some result has, the rest last."""
  names = {name: None for result in report["results"] for name in result["parts"]}
  return [*(name for name in names if name != "rest"), "rest"]


def _part(part: dict[str, float] | None) -> str:
  """Its share of the whole and, but for the rest, what it reaches of its limit."""
  if part is None:
    return ""
  share = percent(part["share"])
  return f"{share} ({percent(part['of_floor'])})" if "of_floor" in part else share
