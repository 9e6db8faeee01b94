"""Table of transfer: cells as options, stored results, no cell played twice."""

from __future__ import annotations

import json
import sys

import pytest
import transfer_table

from apnpql_jax.cli import transfer as command
from apnpql_jax.cli.options import parse
from apnpql_jax.transfer.cell import Cell

RESULT = {
  "run": "expert",
  "task": "stack_box",
  "physics": "bullet",
  "renderer": "rays",
  "looks": "plain",
  "latency_ms": 60,
  "admittance": True,
  "episodes": 200,
  "successes": 190,
  "ci95": [0.91, 0.972],
}


def test_cells_are_options_of_the_command():
  words = transfer_table.options_of("runs/mine", "bullet/tiny/unseen/60/admittance")
  args = parse(command.Transfer, "transfer", words)
  assert (args.physics, args.renderer, args.looks) == ("bullet", "tiny", "unseen")
  assert (args.run, args.latency_ms, args.admittance) == ("runs/mine", 60, True)
  words = transfer_table.options_of("expert:stack_box", "native/rays/plain")
  args = parse(command.Transfer, "transfer", words)
  assert (args.run, args.task, args.latency_ms) == ("expert", "stack_box", None)


def test_default_cells_are_valid():
  pytest.importorskip("pybullet")
  cells = transfer_table.CELLS + transfer_table.EXPERT_CELLS
  assert len(set(transfer_table.CELLS)) == len(transfer_table.CELLS) == 16
  for cell in cells:
    physics, renderer, looks = cell.split("/")
    Cell(physics, renderer, looks).check()


def run(monkeypatch, capsys, *words: str) -> str:
  monkeypatch.setattr(sys, "argv", ["transfer_table.py", *words])
  transfer_table.main()
  return capsys.readouterr().out


def test_stored_results_become_a_table_and_are_not_played(
  tmp_path, monkeypatch, capsys
):
  cell, who = "bullet/rays/plain/60/admittance", "expert:stack_box"
  path = transfer_table.path_of(tmp_path, who, cell)
  assert path.name == "expert-stack_box-bullet-rays-plain-60-admittance.json"
  path.write_text(json.dumps(RESULT))
  words = [who, "--cells", cell, "--out", str(tmp_path)]
  shown = run(monkeypatch, capsys, *words)
  row = "| expert | stack_box | - | bullet | rays | plain | 60 ms | on | 190 of 200 |"
  assert f"{row} 91.0 to 97.2 % |" in shown
  assert (tmp_path / "table.md").read_text() in shown
  with pytest.raises(SystemExit, match="has 200 episodes; remove it to play 50"):
    run(monkeypatch, capsys, *words, "--episodes", "50")


def test_errors_of_the_command_end_the_script(tmp_path, monkeypatch, capsys):
  words = [str(tmp_path / "none"), "--cells", "mjx/rays/plain", "--out", str(tmp_path)]
  with pytest.raises(SystemExit) as error:
    run(monkeypatch, capsys, *words)
  assert error.value.code == 2 and not list(tmp_path.iterdir())
