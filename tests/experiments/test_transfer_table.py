"""Table of transfer: cells as options, stored results, no cell played twice."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
import sys
from typing import Any

import jax.numpy as jnp
import pytest
import transfer_results
import transfer_table
from transfer_table import condition_of

from apnpql_jax import testing
from apnpql_jax.cli import transfer as command
from apnpql_jax.cli.options import parse
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError
from apnpql_jax.runs import run_folder
from apnpql_jax.runs.checkpoint_writer import CheckpointWriter

CONFIG = dataclasses.replace(
  testing.TINY, env=dataclasses.replace(testing.TINY.env, obs="pixels")
)
FIGURES = {
  "successes": 190,
  "ci95": [0.91, 0.972],
  "failures": {"goal": 7, "object": 3},
}


def store(out: Path, who: str, cell: str, **changes: Any) -> Path:
  """Stores a result as the script does, with some changes."""
  chosen = condition_of(cell)
  wanted = transfer_table.identity_of(who, chosen, episodes=200, seed=0)
  label = transfer_table.label_of(who)
  path = transfer_table.path_of(out, who, chosen)
  path.write_text(json.dumps({"run": label} | wanted | FIGURES | changes))
  return path


def save(run: Path, step: int, weight: float, config: TrainConfig = CONFIG) -> None:
  """Saves a checkpoint with a learner of two weights."""
  with CheckpointWriter(run, config, keep=9) as checkpoints:
    checkpoints.save(step, {"learner": {"w": jnp.full(2, weight)}})


@pytest.fixture
def trained(tmp_path: Path) -> Path:
  """Returns a run with a checkpoint at step 8."""
  run = tmp_path / "mine"
  run_folder.create(run, CONFIG)
  save(run, 8, 1.0)
  return run


def test_cells_are_options_of_the_command():
  pytest.importorskip("pybullet")
  condition = condition_of("bullet/tiny/unseen/60/admittance")
  args = parse(
    command.Transfer, "transfer", transfer_table.options_of("a/b", condition)
  )
  assert (args.physics, args.renderer, args.looks) == ("bullet", "tiny", "unseen")
  assert (args.run, args.latency_ms, args.admittance) == ("a/b", 60, True)
  condition = condition_of("native/opengl/unseen-shadows-lights")
  args = parse(
    command.Transfer, "transfer", transfer_table.options_of("a/b", condition)
  )
  assert (args.looks, args.without) == ("unseen", ("shadows", "lights"))
  assert transfer_table.name_of(condition) == "native-opengl-unseen-lights-shadows"
  condition = condition_of("native/rays/plain")
  words = transfer_table.options_of("expert:stack_box", condition)
  args = parse(command.Transfer, "transfer", words)
  assert (args.run, args.task, args.latency_ms) == ("expert", "stack_box", None)
  assert not args.admittance


def test_a_cell_has_one_name():
  """30 ms is the latency where none is named."""
  pytest.importorskip("pybullet")
  names = [
    transfer_table.name_of(condition_of(f"bullet/rays/plain{more}"))
    for more in ("", "/30", "/admittance", "/30/admittance", "/60")
  ]
  assert names[0] == names[1] == "bullet-rays-plain-30"
  assert names[2] == names[3] == "bullet-rays-plain-30-admittance"
  assert names[4] == "bullet-rays-plain-60"


@pytest.mark.parametrize(
  ("text", "words"),
  [
    ("native/rays", "'native/rays' must have the form"),
    ("bullet/rays/plain/fast", "must have the form"),
    ("bullet/rays/plain/admittance/30", "must have the form"),
    ("native/rays/unseen", "--looks unseen needs"),
    ("native/opengl/plain-clutter", "--without needs --looks unseen"),
    ("native/rays/plain/30", "--latency-ms needs --physics bullet"),
  ],
)
def test_other_cells_are_refused(text, words):
  with pytest.raises(ConfigError, match=words):
    condition_of(text)


def test_default_cells_are_valid():
  pytest.importorskip("pybullet")
  for cells in (transfer_table.CELLS, transfer_table.EXPERT_CELLS):
    names = {transfer_table.name_of(condition_of(cell)) for cell in cells}
    assert len(names) == len(cells)


def run(monkeypatch, capsys, *words: str) -> str:
  monkeypatch.setattr(sys, "argv", ["transfer_table.py", *words])
  transfer_table.main()
  return capsys.readouterr().out


def test_stored_results_become_a_table_and_are_not_played(
  tmp_path, monkeypatch, capsys
):
  pytest.importorskip("pybullet")
  cell, who = "bullet/rays/plain/60/admittance", "expert:stack_box"
  path = store(tmp_path, who, cell)
  assert path.name == "expert-stack_box-bullet-rays-plain-60-admittance.json"
  words = [who, "--cells", cell, "--out", str(tmp_path)]
  shown = run(monkeypatch, capsys, *words)
  row = "| expert | stack_box | - | bullet | rays | plain | 60 ms | on | 190 of 200 |"
  assert f"{row} 91.0 to 97.2 % | goal: 7, object: 3 |" in shown
  assert (tmp_path / "table.md").read_text() in shown
  with pytest.raises(SystemExit, match="has episodes 200 instead of 50; remove it"):
    run(monkeypatch, capsys, *words, "--episodes", "50")
  with pytest.raises(SystemExit, match="has seed 0 instead of 1; remove it"):
    run(monkeypatch, capsys, *words, "--seed", "1")


@pytest.mark.parametrize(
  ("name", "value"),
  [
    ("env_crc32", 1),
    ("scene_sha256", "other"),
    ("looks", "trained"),
    ("seed", None),
    ("algorithm", "ap_npql"),
  ],
)
def test_a_result_of_other_settings_is_refused(
  name, value, tmp_path, monkeypatch, capsys
):
  cell, who = "native/rays/plain", "expert:stack_box"
  store(tmp_path, who, cell, **{name: value})
  with pytest.raises(SystemExit, match=f"has {name} {value} instead of .*; remove it"):
    run(monkeypatch, capsys, who, "--cells", cell, "--out", str(tmp_path))


def test_a_result_of_another_checkpoint_is_refused(
  trained, tmp_path, monkeypatch, capsys
):
  out = tmp_path / "out"
  out.mkdir()
  words = [str(trained), "--cells", "native/rays/plain", "--out", str(out)]
  store(out, str(trained), "native/rays/plain")
  assert "| mine | push_plate | plain | native |" in run(monkeypatch, capsys, *words)
  save(trained, 16, 1.0)
  with pytest.raises(SystemExit, match="has checkpoint_step 8 instead of 16; remove"):
    run(monkeypatch, capsys, *words)


def test_a_result_of_other_weights_is_refused(trained, tmp_path, monkeypatch, capsys):
  """Two runs whose folders have the same name."""
  out, other = tmp_path / "out", tmp_path / "elsewhere" / "mine"
  out.mkdir()
  store(out, str(trained), "native/rays/plain")
  run_folder.create(other, CONFIG)
  save(other, 8, 2.0)
  words = [str(other), "--cells", "native/rays/plain", "--out", str(out)]
  with pytest.raises(SystemExit, match="has weights_crc32 .* instead of .*; remove"):
    run(monkeypatch, capsys, *words)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"run": "mine"}', "\x00"])
def test_a_damaged_result_is_named(text, tmp_path, monkeypatch, capsys):
  path = store(tmp_path, "expert:stack_box", "native/rays/plain")
  path.write_text(text)
  for words in ([], ["expert:stack_box", "--cells", "native/rays/plain"]):
    with pytest.raises(SystemExit, match="plain.json is not a result of this script"):
      run(monkeypatch, capsys, *words, "--out", str(tmp_path))


def test_wrong_arguments_end_the_script_before_anything_is_played(
  tmp_path, monkeypatch, capsys
):
  out = ["--out", str(tmp_path / "out")]
  with pytest.raises(SystemExit, match="not a run folder"):
    run(monkeypatch, capsys, "expert:stack_box", str(tmp_path / "none"), *out)
  with pytest.raises(SystemExit, match="unknown task 'juggle'"):
    run(monkeypatch, capsys, "expert:juggle", "--cells", "native/rays/plain", *out)
  assert not list(tmp_path.iterdir())


def test_errors_of_the_command_end_the_script(tmp_path, monkeypatch, capsys):
  """A policy from states has no use for images."""
  trained = tmp_path / "mine"
  run_folder.create(trained, testing.TINY)
  save(trained, 8, 1.0, testing.TINY)
  words = [str(trained), "--cells", "mjx/rays/plain", "--out", str(tmp_path / "out")]
  with pytest.raises(SystemExit) as error:
    run(monkeypatch, capsys, *words)
  assert error.value.code == 2 and not list((tmp_path / "out").iterdir())


def test_seeds_of_a_training_are_one_sample():
  base = {
    "task": "push_plate",
    "physics": "native",
    "renderer": "rays",
    "looks": "plain",
    "trained": "plain",
    "episodes": 200,
  }
  bullet = {"physics": "bullet", "latency_ms": 60, "admittance": True}
  results = [
    base | {"run": "b-0", "successes": 10},
    base | bullet | {"run": "a-1", "successes": 200},
    base | {"run": "a-1", "successes": 190},
    base | {"run": "a-0", "successes": 170},
    {k: v for k, v in base.items() if k != "trained"} | {"run": "expert"},
  ]
  # Wilson's interval of 360 in 400 is that of the normal quantile z.
  p, n, z = 0.9, 400, 1.96
  middle = p + z**2 / (2 * n)
  spread = z * math.sqrt(p * (1 - p) / n + (z / (2 * n)) ** 2)
  low, high = ((middle + s * spread) / (1 + z**2 / n) for s in (-1, 1))
  head, _, plain, moved = transfer_results.by_training(results).splitlines()
  assert head == "| tested in | a | b |"
  both = f"170 + 190 of 400, {100 * low:.0f} to {100 * high:.0f} %"
  assert plain == f"| MuJoCo, rays, plain | {both} | 10 of 200, 3 to 9 % |"
  assert moved == (
    "| Bullet, rays, plain, 60 ms, admittance | 200 of 200, 98 to 100 % | - |"
  )


@pytest.mark.parametrize("folder", ["", "parts", "ranges"])
def test_the_documents_have_the_stored_results(folder):
  out, document = transfer_table.OUT / folder, testing.ROOT / "docs" / "transfer.md"
  found = [transfer_results.read(path) for path in out.glob("*.json")]
  table, summary = transfer_results.table(found), transfer_results.by_training(found)
  assert len(found) > 0 and (out / "table.md").read_text() == table
  assert summary in document.read_text()
