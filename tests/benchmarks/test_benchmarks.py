"""The benchmarks: each runs and reports what can be, and the document is made of it."""

from __future__ import annotations

from collections.abc import Iterator
import functools
import itertools
import json
import os
import subprocess
import sys
import time
from typing import Any

import floor
import jax
import jax.numpy as jnp
import numpy as np
import parts
import pytest
import report
import resume
import soak
import tables
import timing

from apnpql_jax import testing
from apnpql_jax.runs.metrics import MetricWriter

PEAK = {"flops_per_s": 2e9, "bytes_per_s": 1e9}
MACHINE = {
  "device": "a machine",
  "cores": 2,
  "versions": {"jax": "1.2"},
  "commit": "abc",
  "peak": PEAK,
  "repeats": 3,
}


def run(script: str, *args: str) -> dict[str, Any]:
  """The report of a benchmark in a process of its own; it prints nothing else."""
  done = subprocess.run(
    [sys.executable, f"benchmarks/{script}.py", "--quick", "--json", *args],
    cwd=tables.ROOT,
    env=os.environ | {"XLA_FLAGS": testing.XLA_FLAGS, "PYTHONPATH": str(tables.ROOT)},
    capture_output=True,
    text=True,
    check=False,
  )
  assert done.returncode == 0, done.stderr
  return json.loads(done.stdout)


def dicts(tree: Any) -> Iterator[dict[str, Any]]:
  """All dictionaries in a report."""
  if isinstance(tree, dict):
    yield tree
    tree = list(tree.values())
  if isinstance(tree, list):
    for value in tree:
      yield from dicts(value)


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
  ("script", "args"),
  [
    ("render", ["--alone"]),
    ("encoder_layouts", ["--layouts", "none", "4x4 / 4, 3x3 / 2 by XLA"]),
    ("env_steps", ["--obs", "state"]),
    ("growth", ["--axes", "candidates", "slots"]),
    pytest.param("ray_layouts", [], marks=SLOW),
    pytest.param("encoder_layouts", [], marks=SLOW),
    pytest.param("learner", [], marks=SLOW),
    pytest.param("learner", ["--lstm-instants", "2"], marks=SLOW),
    pytest.param("env_steps", [], marks=SLOW),
    pytest.param("end_to_end", [], marks=SLOW),
    pytest.param("compile_time", [], marks=SLOW),
    pytest.param("growth", [], marks=SLOW),
  ],
)
def test_a_benchmark_reports_what_can_be(script, args):
  found = run(script, *args)
  assert found["benchmark"] == script and found["results"]
  assert found["cores"] >= 1 and found["versions"]["jax"] == jax.__version__
  assert min(found["peak"].values()) > 0
  spreads = 0
  for entry in dicts(found["results"]):
    for name in [key[:-4] for key in entry if key.endswith("_low")]:
      assert 0 < entry[f"{name}_low"] <= entry[name] <= entry[f"{name}_high"]
      spreads += 1
    if "parts" in entry:
      shares = [part["share"] for part in entry["parts"].values()]
      assert all(0 <= share <= 1 for share in shares)
      assert sum(shares) == pytest.approx(1.0)
    if "floor_s" in entry:
      assert entry["floor_s"] > 0 and entry["of_floor"] > 0
  assert spreads
  # What a script reports, the document can be made of.
  assert "| --- |" in report.SECTIONS[script](found)


def test_other_layouts_draw_the_same():
  same = ["fold, 16 blocks", "types at once", "one by one, in sight"]
  found = run("ray_layouts", "--layouts", *same)
  assert [result["layout"] for result in found["results"]] == same
  for result in found["results"]:
    assert result["agreeing"] > 0.999
  assert "| types at once | 2 | " in report.SECTIONS["ray_layouts"](found)


def test_operations_are_counted_as_often_as_loops_turn():
  x = jnp.ones((8, 8))

  def inner(x, _):
    return x @ x, None

  def outer(x, _):
    return jax.lax.scan(inner, x @ x, length=3)[0], None

  def program(x):
    return jax.lax.scan(outer, x, length=5)[0]

  product = 2 * 8**3
  work = floor.count(jax.jit(program), x)
  assert work.flops == pytest.approx(5 * 4 * product, rel=0.01)
  assert work.bytes == 2 * x.nbytes
  assert work.times(2.0) == (2 * work.flops, 2 * work.bytes)


def test_the_floor_is_the_slower_of_computing_and_moving(monkeypatch):
  monkeypatch.setattr(floor, "machine_peak", lambda: floor.Peak(10.0, 100.0))
  assert floor.Work(20.0, 100.0).seconds() == 2.0
  assert floor.Work(20.0, 500.0).seconds() == 5.0


def test_times_are_of_one_thing_and_runs_take_turns():
  calls = []

  def nap(name: str, seconds: float) -> jax.Array:
    time.sleep(seconds)
    calls.append(name)
    return jnp.zeros(())

  ready = [
    timing.Ready(functools.partial(nap, "one", 0.01), floor_s=0.005),
    timing.Ready(functools.partial(nap, "ten", 0.04), floor_s=0.001, things=10),
  ]
  one, ten = timing.measure(ready, repeats=3, seconds=0.03)
  assert len(one.wall) == len(ten.wall) == 3
  assert 0.01 <= one.seconds < 0.03
  assert 0.004 <= ten.seconds < 0.012
  assert one.per(10).seconds == pytest.approx(one.seconds / 10)
  # Two calls of each that do not count, then three rounds.
  turns = [name for name, _ in itertools.groupby(calls)]
  assert turns == ["one", "ten"] * 4 and calls.count("ten") == 5
  figures = ready[1].figures("step", ten)
  assert figures["steps_per_s"] == pytest.approx(1 / ten.seconds)
  assert figures["of_floor"] == pytest.approx(0.001 / ten.seconds)


def test_shares_add_up_even_if_parts_are_slower_alone():
  def shares(whole_s: float, **seconds: float) -> list[float]:
    found = {name: parts.Part(x, floor_s=0.5) for name, x in seconds.items()}
    return [part["share"] for part in parts.shares(whole_s, found).values()]

  assert shares(4.0, a=1.0, b=2.0) == [0.25, 0.5, 0.25]
  assert shares(2.0, a=1.0, b=3.0) == [0.25, 0.75, 0.0]


def test_the_soak_sees_metrics_that_were_put_aside_and_every_other_loss(tmp_path):
  losses = np.linspace(1.0, 0.1, 40)
  runs = {"long": losses, "short": losses[:30], "gap": losses[1:], "other": losses + 1}
  for name, values in runs.items():
    (tmp_path / name).mkdir()
    with MetricWriter(tmp_path / name, max_bytes=500) as writer:
      for i, loss in enumerate(values, start=1 if name != "gap" else 2):
        writer.write(i * testing.STEPS, {"loss/q": loss})
        writer.write(i * testing.STEPS, {"checkpoint/mib": 1.0})
  assert (tmp_path / "long" / "metrics.3.jsonl").exists()
  assert soak.reached(tmp_path / "short") == 30 * testing.STEPS
  long, short, gap, other = (tmp_path / name for name in runs)
  assert soak.same_metrics(long, short)
  assert not soak.same_metrics(long, gap) and not soak.same_metrics(gap, gap)
  assert not soak.same_metrics(short, other)


def test_what_differs_after_a_resume_is_told_by_how_much():
  a = {"x": np.array([1.0, -4.0], np.float32), "n": np.arange(3), "k": np.zeros(2)}
  assert resume.compare(a, a) == {"arrays": 3, "same_bits": 3, "differ": {}}
  b = a | {"x": np.array([1.0, -3.0], np.float32), "k": np.array([0.0, -0.0])}
  told = resume.compare(a, b)
  assert told == {"arrays": 3, "same_bits": 1, "differ": {"x": 0.25, "k": 0.0}}
  with pytest.raises(ValueError, match="only one state has .*'n'"):
    resume.compare(a, {"x": a["x"], "k": a["k"]})


def test_the_document_is_what_the_stored_reports_make(tmp_path):
  doc = tmp_path / "performance.md"
  doc.write_text(tables.PERFORMANCE.read_text())
  report.write(docs=doc)
  assert doc.read_text() == tables.PERFORMANCE.read_text()


def test_the_document_is_made_of_what_is_at_hand(tmp_path):
  doc = tmp_path / "performance.md"
  marks = [
    f"<!-- {name} -->\nas before\n<!-- end {name} -->" for name in report.SECTIONS
  ]
  doc.write_text("\n".join(marks))
  speed = {"steps_per_s": 50.0, "steps_per_s_low": 40.0, "steps_per_s_high": 60.0}
  speed |= {"floor_s": 0.001, "of_floor": 0.05}
  setting = {"task": "t", "backend": "mjx", "obs": "pixels", "worlds": 4}
  found = {"physics": {"share": 0.6, "of_floor": 0.03}, "rest": {"share": 0.4}}
  steps = {**setting, "env": speed, "env_policy": speed, "parts": found}
  training = setting | speed | {"updates_per_s": 9.0, "parts": found}
  points = [
    {
      "axis": "worlds",
      "series": "mjx",
      "size": size,
      "seconds": seconds,
      "seconds_low": seconds,
      "seconds_high": seconds,
      "floor_s": 1e-6,
      "of_floor": 0.5,
    }
    for size, seconds in ((1, 0.1), (4, 0.2), (16, 0.8))
  ]
  missing = {"resolution": "paper", "renderer": "pybullet_tiny", "missing": "no module"}
  render = {"scene": "s", "resolutions": {"paper": {"global": (72, 96)}}}
  reports = {
    "render": render | {"results": [missing]},
    "env_steps": {"results": [steps]},
    "end_to_end": {"results": [training]},
    "growth": {"results": points},
  }
  for name, fields in reports.items():
    (tmp_path / f"{name}.json").write_text(json.dumps(MACHINE | fields))
  report.write(tmp_path, doc)
  text = doc.read_text()
  assert text.count("as before") == len(report.SECTIONS) - len(reports)
  assert "| PyBullet, TinyRenderer | 1 | 72x96 |  | missing: no module |  |  |" in text
  assert "| t | mjx | pixels | 4 | 50 (40 to 60) | 1,000 | 5 % |" in text
  assert "| 60 % (3 %) | 40 % |" in text
  assert "2 GFLOP/s and 1 GB/s" in text
  # Half of proportional from 1 to 4, proportional from there on.
  assert "| 4 | 200 (200 to 200) | 0.50 | 50 % |" in text
  assert "| 16 | 800 (800 to 800) | 1.00 | 50 % |" in text
  for plot in ("growth", "rates"):
    assert (tmp_path / "images" / f"{plot}.png").stat().st_size > 1000
