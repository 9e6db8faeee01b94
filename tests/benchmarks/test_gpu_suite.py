"""The GPU suite in small, on a CPU: its report, its budget, what fails in it."""

from __future__ import annotations

import json

import gpu_sections
import gpu_suite
import pytest

from apnpql_jax.tasks import task_names


def run(tmp_path, *args: str) -> dict:
  """The report of a quick run."""
  out = tmp_path / "report.json"
  gpu_suite.main(["--quick", "--jobs", "1", "--out", str(out), *args])
  return json.loads(out.read_text())["sections"]


def test_its_tasks_and_sections_exist():
  assert set(gpu_suite.TASKS) <= set(task_names())  # Not a task of your own.
  known = {name.partition("/")[0] for name in gpu_suite.SECTIONS}
  assert known == set(gpu_sections.SECTIONS)


def test_figures_are_in_the_report(tmp_path):
  section = run(tmp_path, "--sections", "device", "--budget", "300")["device"]
  assert section["status"] == "done" and not section["missing"]
  found = {result["what"]: result for result in section["results"]}
  assert set(section["plan"]) < set(found)
  assert found["copy"]["gib_per_s"] > 0 and found["copy"]["quiet"]
  assert found["product float32"]["compile_s"] > 0
  lines = list(gpu_suite.rows({"sections": {"device": section}}))
  assert [line[1] for line in lines] == list(found)


@pytest.mark.slow
def test_every_section_comes_to_its_end_on_a_cpu(tmp_path):
  sections = run(tmp_path, "--budget", "1500", "--train", "5")
  assert set(gpu_suite.SECTIONS) < set(sections)
  for name in gpu_suite.SECTIONS:
    assert sections[name]["status"] == "done" and not sections[name]["missing"], name
  failed = [
    line[1] for line in gpu_suite.rows({"sections": sections}) if "Error" in line[-1]
  ]
  assert set(failed) <= {"warp"}  # It may not be installed.
  period = next(r for r in sections["engines"]["results"] if "finite" in r)
  assert period["finite"] and period["qpos_differs"] < 1e-4


def test_what_does_not_fit_into_the_budget_is_named(tmp_path):
  sections = run(tmp_path, "--sections", "device", "engines", "--budget", "0")
  assert sections["device"]["status"] == "skipped: no time was left"
  assert sections["engines"]["status"] == "skipped: no time was left"


def test_a_section_that_fails_or_is_late_keeps_its_place(tmp_path):
  report = gpu_suite.Report(tmp_path / "report.json")
  env = gpu_suite._environment(gpu_suite._arguments(["--quick"]), tmp_path)
  settings = gpu_suite.QUICK | {"folder": str(tmp_path), "threads": 1}
  running = [
    gpu_suite.Running(name, settings, env, report)
    for name in ("worlds/nothing", "device")
  ]
  running[1].finish(deadline=0.0)
  running[0].finish(deadline=float("inf"))
  sections = report.content["sections"]
  assert sections["device"]["status"] == "stopped: its time was over"
  assert sections["worlds/nothing"]["status"].startswith("failed: ")
  lines = {line[0]: line[-1] for line in gpu_suite.rows(report.content)}
  assert "nothing" in lines["worlds/nothing"]
