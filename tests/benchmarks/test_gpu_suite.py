"""The GPU suite in small, on a CPU: its report, its budget, failures in it."""

from __future__ import annotations

import importlib
import json
import time

import pytest

from benchmarks.gpu import suite

SLOTS = ["speed.growth", "--quick", "--axes", "slots"]


def test_its_sections_are_benchmarks():
  for args in suite.SECTIONS.values():
    importlib.import_module(f"benchmarks.{args.split()[0]}")
  assert list(suite.SECTIONS)[0] == "training from pixels"


@pytest.mark.slow
def test_sections_end_with_results_or_with_a_reason(tmp_path):
  out = tmp_path / "gpu.json"
  whole = suite.Suite(out, str(tmp_path), time.monotonic() + 300)
  assert whole.run("growth", SLOTS).startswith("growth: done, 1 results")
  (line,) = [whole.run("wrong", ["speed.growth", "--axes", "nothing"])]
  assert "failed" in line and "invalid choice: 'nothing'" in line
  late = suite.Suite(tmp_path / "late.json", str(tmp_path), time.monotonic())
  assert late.run("growth", SLOTS) == "growth: out of time, 0 results []"
  sections = json.loads(out.read_text())["sections"]
  assert sections["growth"]["report"]["benchmark"] == "growth"
  assert sections["growth"]["report"]["results"][0]["seconds"] > 0
  assert sections["wrong"]["report"]["results"] == []


@pytest.mark.slow
def test_every_section_ends_on_a_cpu(tmp_path, capsys):
  out = tmp_path / "gpu.json"
  suite.main(["--quick", "--out", str(out), "--budget", "3000"])
  sections = json.loads(out.read_text())["sections"]
  assert list(sections) == list(suite.SECTIONS)
  for name, section in sections.items():
    assert section["status"] == "done" and section["report"]["results"], name
  training = sections["training from pixels"]["report"]["results"][0]
  assert training["first_iteration_s"] > 0 and training["faults/updates"] == 0
  assert capsys.readouterr().out.startswith("training from pixels: done, 1 results")
