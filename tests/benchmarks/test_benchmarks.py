"""The benchmarks run and report, and the document consists of their reports."""

from __future__ import annotations

from collections.abc import Iterator
import functools
import importlib
import itertools
import json
import os
import pkgutil
import shlex
import subprocess
import sys
import threading
import time
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.config.files import mjcf_path
from apnpql_jax.runs.metrics import MetricWriter
from apnpql_jax.sim.scene import load_scene
import benchmarks
from benchmarks.common import (
  command,
  floor,
  noise,
  parts,
  settings,
  store,
  tables,
  timing,
  turns,
)
from benchmarks.page import performance, reports
from benchmarks.quality import tasks
from benchmarks.reliability import resume, soak
from benchmarks.speed import messages, physics_timeline, ray_layouts, render

MACHINE = {
  "device": "a machine",
  "cores": 2,
  "versions": {"jax": "1.2"},
  "commit": "abc",
  "peak": {"flops_per_s": 2e9, "bytes_per_s": 1e9},
  "repeats": 3,
}


def run(module: str, *args: str) -> dict[str, Any]:
  """Returns the report of a benchmark, which prints nothing else."""
  done = subprocess.run(
    [sys.executable, "-m", module, "--quick", "--json", *args],
    cwd=store.ROOT,
    env=os.environ | {"PYTHONPATH": str(store.ROOT)},
    capture_output=True,
    text=True,
    check=False,
  )
  assert done.returncode == 0, done.stderr
  return json.loads(done.stdout)


def dicts(tree: Any) -> Iterator[dict[str, Any]]:
  """Yields all dictionaries in a report."""
  if isinstance(tree, dict):
    yield tree
    tree = list(tree.values())
  if isinstance(tree, list):
    for value in tree:
      yield from dicts(value)


@pytest.mark.slow
@pytest.mark.parametrize(
  ("name", "args"),
  [
    ("growth", []),
    ("render", ["--alone"]),
    ("ray_layouts", []),
    ("learner", []),
    ("learner", ["--lstm-instants", "2", "--phi", "once"]),
    ("timeline", []),
    ("physics_timeline", []),
    ("seeds", ["--obs", "state"]),
    ("encoder_layouts", []),
    ("env_steps", []),
    ("env_steps", ["--obs", "state"]),
    ("end_to_end", []),
    ("compile_time", []),
    ("engines", ["--variants", "barrier and cones", "Warp"]),
    ("fidelity", []),
    ("memory", []),
  ],
)
def test_a_benchmark_reports_its_figures(name, args):
  found = run(reports.module(name), *args)
  assert found["benchmark"] == name and found["results"]
  assert shlex.split(found["options"]) == ["--quick", "--json", *args]
  if name in ("timeline", "encoder_layouts"):
    assert "candidates 8, candidate precision" in reports.caption(found)
  assert found["cores"] >= 1 and found["versions"]["jax"] == jax.__version__
  if "peak" in found:
    assert min(found["peak"].values()) > 0 and found["repeats"]
  for entry in dicts(found["results"]):
    for key in [key[:-4] for key in entry if key.endswith("_low")]:
      assert 0 < entry[f"{key}_low"] <= entry[key] <= entry[f"{key}_high"]
    if "parts" in entry:
      shares = [part["share"] for part in entry["parts"].values()]
      assert all(0 <= share <= 1 for share in shares)
      assert sum(shares) == pytest.approx(1.0)
    if "floor_s" in entry:
      assert entry["floor_s"] > 0 and entry["of_floor"] > 0
    if "qpos_differs" in entry:
      assert entry["qpos_differs"] < 1e-4
  # The document can be made of it.
  assert "| --- |" in reports.block(found)


def test_a_caption_has_the_options_of_its_run(capsys):
  parser = command.parser("A benchmark.")
  parser.add_argument("--batch", type=int)
  args = command.parse(parser, ["--json", "--batch", "64"])
  command.publish("learner", args, [])
  caption = reports.caption(json.loads(capsys.readouterr().out))
  assert caption.startswith("`python -m benchmarks.speed.learner --json --batch 64`")
  # Older reports did not keep them.
  caption = reports.caption(MACHINE | {"benchmark": "learner", "cores": 1})
  assert caption.startswith("`python -m benchmarks.speed.learner ...`")
  assert "a machine, 1 core, " in caption


def test_small_parts_of_a_time_line_are_in_its_rest():
  shares = {"large": 0.9, "rest": 0.085, "small": 0.009, "smaller": 0.006}
  results = [{"part": k, "ms": 10 * x, "share": x} for k, x in shares.items()]
  results.append({"part": "by the clock", "ms": 5.0})
  lines = reports.block(MACHINE | {"benchmark": "timeline", "results": results})
  assert lines.splitlines()[-3:] == [
    "| large | 9 | 90 % |",
    "| rest | 1 | 10 % |",
    "| by the clock | 5 |  |",
  ]


def test_every_module_can_be_imported():
  missing = set()
  for module in pkgutil.walk_packages(benchmarks.__path__, "benchmarks."):
    try:
      importlib.import_module(module.name)
    except ModuleNotFoundError as error:
      missing.add(error.name)
  assert missing <= {"pybullet", "torch"}


@pytest.mark.slow
def test_other_layouts_draw_the_same():
  sizes = render.RESOLUTIONS["tiny"]
  scene = load_scene(mjcf_path(render.SCENE))
  poses = render.make_poses(scene, 2)
  pair = jax.jit(render.make_pair(scene, sizes))
  expected = pair(poses)
  for name in ("fold, 16 blocks", "types at once"):
    fast: Any = ray_layouts.LAYOUTS[name]
    program, _ = ray_layouts.prepare(scene, sizes, poses, **fast)
    assert ray_layouts.agreeing(program(poses), expected) > 0.999
  assert ray_layouts.agreeing([x + 1 for x in expected], expected) == 0.0


def test_noise_has_the_shapes_of_the_training():
  config = settings.changed(settings.preset("", quick=True), "replay", batch_size=6)
  batch = noise.transitions(settings.changed(config, "agent", lstm_instants=3))
  seen = batch.observation_t
  image: Any = seen.global_image
  assert image.shape == (6, 3, 12, 16, 3) and seen.objects is None
  assert image.dtype == jnp.uint8 and image.std() > 50
  assert seen.robot.shape == (6, 3, 21) and 0 <= seen.robot.min() < seen.robot.max() < 1
  assert batch.window is None and batch.action_tm1.shape == (6, 7)


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


def test_times_are_of_one_unit_and_programs_take_turns(monkeypatch):
  calls, now = [], 0.0

  def nap(name: str, seconds: float) -> jax.Array:
    nonlocal now
    now += seconds
    calls.append(name)
    return jnp.zeros(())

  ready = {
    "one": timing.Ready(functools.partial(nap, "one", 0.01), floor_s=0.005),
    "ten": timing.Ready(functools.partial(nap, "ten", 0.04), floor_s=0.001, units=10),
  }
  clock = types.SimpleNamespace(perf_counter=lambda: now, process_time=lambda: now)
  monkeypatch.setattr(timing, "time", clock)
  times = timing.measure(ready, repeats=3, seconds=0.03)
  one, ten = times["one"], times["ten"]
  assert len(one.wall) == len(ten.wall) == 3
  assert one.seconds == pytest.approx(0.01) and ten.seconds == pytest.approx(0.004)
  assert one.per(10).seconds == pytest.approx(0.001)
  # Two calls of each that do not count, then three rounds.
  taken = [name for name, _ in itertools.groupby(calls)]
  assert taken == ["one", "ten"] * 4 and calls.count("ten") == 5
  figures = ready["ten"].figures("step", ten)
  assert figures["steps_per_s"] == pytest.approx(1 / ten.seconds)
  assert figures["of_floor"] == pytest.approx(0.001 / ten.seconds)


def test_measuring_waits_for_compilation(tmp_path, monkeypatch):
  monkeypatch.setenv(turns.FOLDER, str(tmp_path))
  events, compiling = [], threading.Barrier(3)

  def measure() -> None:
    with turns.turn():
      events.append("measured")

  def compile_slowly() -> None:
    with turns.turn(shared=True):
      compiling.wait(10)
      time.sleep(0.2)
      events.append("compiled")

  threads = [threading.Thread(target=compile_slowly) for _ in range(2)]
  for thread in threads:
    thread.start()
  compiling.wait(10)
  threads.append(threading.Thread(target=measure))
  threads[-1].start()
  for thread in threads:
    thread.join()
  assert events == ["compiled", "compiled", "measured"]


def test_shares_add_up_even_if_parts_are_slower_alone():
  def shares(whole_s: float, **seconds: float) -> list[float]:
    found = parts.shares(whole_s, {name: (s, 0.5) for name, s in seconds.items()})
    return [part["share"] for part in found.values()]

  assert shares(4.0, a=1.0, b=2.0) == [0.25, 0.5, 0.25]
  assert shares(2.0, a=1.0, b=3.0) == [0.25, 0.75, 0.0]


def sine(x):
  return jnp.sin(x)


def accumulated_sine(x):
  return jnp.cumsum(sine(x)) + 1.0


def test_operations_belong_to_the_functions_they_were_written_in():
  program: Any = jax.jit(accumulated_sine).lower(jnp.ones(8)).compile()
  found = physics_timeline.functions(program.as_text(), "accumulated_sine")
  kinds = {name.partition(".")[0]: part for name, part in found.items()}
  assert (kinds["sin"], kinds["add"]) == ("sine", "rest")


def test_messages_are_read_from_a_program():
  class Program:
    def as_text(self) -> str:
      return """
        %sum = (f32[16,7]{1,0}, pred[]) all-reduce(%a, %b), replica_groups={}
        %parts = u8[3,2]{1,0} all-gather-start(%c), dimensions={0}
        %add = f32[100]{0} add(%d, %e)
      """

  sent = messages.messages(Program())
  assert [messages.size(types) for types in sent] == [16 * 7 * 4 + 1, 6]


@pytest.mark.slow
def test_an_update_on_several_devices_sends_messages():
  found = run("benchmarks.speed.messages", "--devices", "2")
  assert found["messages_bytes"] >= found["parameters_bytes"] + found["batch_bytes"]
  assert found["largest_message_bytes"] <= found["messages_bytes"]


def test_the_soak_reads_all_metrics_and_compares_every_loss(tmp_path):
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


def test_the_soak_fits_the_growth_of_memory():
  samples = [(0.0, 50.0), *((float(i), 100.0 + 2.0 * i) for i in range(3, 11))]
  found = soak.growth(samples)
  assert found["slope_mib_per_h"] == pytest.approx(120.0)
  assert found["minutes_mib"][1] == [3.0, 106.0]


def test_a_resumed_run_is_compared_array_by_array():
  a = {"x": np.array([1.0, -4.0], np.float32), "n": np.arange(3), "k": np.zeros(2)}
  assert resume.compare(a, a) == {"arrays": 3, "same_bits": 3, "differ": {}}
  b = a | {"x": np.array([1.0, -3.0], np.float32), "k": np.array([0.0, -0.0])}
  found = resume.compare(a, b)
  assert found == {"arrays": 3, "same_bits": 1, "differ": {"x": 0.25, "k": 0.0}}
  with pytest.raises(ValueError, match="only one state has .*'n'"):
    resume.compare(a, {"x": a["x"], "k": a["k"]})


def test_the_documents_are_what_the_stored_reports_make(tmp_path):
  copies = {}
  for doc in (performance.DOC, tasks.DOC, messages.DOC):
    copies[doc] = tmp_path / doc.name
    copies[doc].write_text(doc.read_text())
  performance.write(doc=copies[performance.DOC])
  tasks.write_tables(copies[tasks.DOC])
  sent = json.loads((store.RESULTS / "messages.json").read_text())
  tables.put("messages", messages.table(sent), copies[messages.DOC])
  for doc, copy in copies.items():
    assert copy.read_text() == doc.read_text(), doc.name


def test_the_document_uses_the_available_reports(tmp_path):
  doc = tmp_path / "performance.md"
  names = [*performance.BLOCKS, "gpu", "answer"]
  marks = [f"<!-- {name} -->\nas before\n<!-- end {name} -->" for name in names]
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
  image = {"resolution": "paper", "shadow": False, "batch": 2}
  pairs = image | {"renderer": "ray_caster", "pairs_per_s": 30.0}
  other = {"resolution": "paper", "renderer": "mujoco_egl", "pairs_per_s": 10.0}
  missing = {"resolution": "paper", "renderer": "pybullet_tiny", "missing": "no module"}
  sizes = {"resolutions": {"paper": {"global": (72, 96)}}}
  stored = {
    "render": sizes | {"scene": "s", "results": [missing, other, pairs]},
    "env_steps": {"results": [steps]},
    "end_to_end": {"results": [training]},
    "growth": {"results": points},
  }
  for name, fields in stored.items():
    report = MACHINE | {"benchmark": name} | fields
    (tmp_path / f"{name}.json").write_text(json.dumps(report))
  run = MACHINE | {"benchmark": "training", "results": [{"first_iteration_s": 90.0}]}
  empty = {"report": {"results": []}, "status": "out of time"}
  gpu = {"sections": {"training": {"report": run}, "late": empty}}
  (tmp_path / "gpu.json").write_text(json.dumps(gpu))
  performance.write(tmp_path, doc)
  text = doc.read_text()
  assert text.count("as before") == len(names) - len(stored) - 1
  assert "| 72x96 | MuJoCo, EGL | 3 |" in text
  assert "| 72x96 | PyBullet, TinyRenderer | missing |" in text
  assert "| t | mjx | pixels | 4 | 50 (40 to 60) | 1,000 | 5 % |" in text
  assert "| t | mjx | pixels | 4 | 60 % (3 %) | 40 % |" in text
  assert "commit abc, a machine, 2 cores" in text and "2 GFLOP/s, 1 GB/s" in text
  # Half of proportional from 1 to 4, proportional from there on.
  assert "| 4 | 200 (200 to 200) | 0.50 | 50 % |" in text
  assert "| 16 | 800 (800 to 800) | 1.00 | 50 % |" in text
  assert "| first_iteration_s |\n| --- |\n| 90 |" in text
  for plot in ("growth", "rates"):
    assert (tmp_path / "images" / f"{plot}.png").stat().st_size > 1000
