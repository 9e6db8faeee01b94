"""The report of ``apnpql doctor``, on machines that work and on broken ones."""

from __future__ import annotations

from importlib.metadata import EntryPoint
import json
import os
from pathlib import Path
import subprocess
import sys
import tomllib

import pytest

from apnpql_jax.config import files
from apnpql_jax.config.checks import PROCESS_BYTES
from apnpql_jax.doctor import machine, software, worker
from apnpql_jax.doctor.findings import checked

ROOT = Path(__file__).resolve().parents[2]


def doctor(folder: Path, *args: str, **env: str) -> tuple[int, dict, str]:
  """Returns exit code, JSON and standard error of the command in ``folder``."""
  done = subprocess.run(
    [sys.executable, "-m", "apnpql_jax", "doctor", "--json", *args],
    cwd=folder,
    env=os.environ | {"PYTHONPATH": str(ROOT)} | env,
    capture_output=True,
    text=True,
    timeout=500,
  )
  return done.returncode, json.loads(done.stdout), done.stderr


def test_a_machine_that_runs_the_tests_needs_no_change(tmp_path):
  code, report, errors = doctor(tmp_path, "--fast")
  assert (code, report["must_change"], errors) == (0, [], "")
  assert report["devices"]["JAX"].startswith(("cpu", "gpu", "cuda"))
  assert report["devices"]["engine"].split()[0] in ("native", "mjx")
  assert "writes" in report["disk"]["runs"] and "self-test" not in report
  assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_experts_images_and_an_update_pass_the_self_test(tmp_path):
  code, report, _ = doctor(tmp_path)
  assert code == 0 and len(report["self-test"]) == 6
  for name in files.preset_names():
    if name != "sim_to_real":
      assert "4 of 4 episodes" in report["self-test"][f"expert of {name}"]
  assert report["self-test"]["renderer"].startswith("global 72x96, wrist 36x64")


@pytest.mark.parametrize(
  ("env", "word"),
  [
    ({"JAX_PLATFORMS": "cuda"}, "JAX_PLATFORMS"),
    ({"JAX_ENABLE_X64": "1"}, "JAX_ENABLE_X64=1 is not supported"),
    ({"XDG_CACHE_HOME": "/proc/none"}, "not writable: set XDG_CACHE_HOME"),
  ],
)
def test_an_environment_that_cannot_work_has_a_cure(env, word, tmp_path):
  code, report, errors = doctor(tmp_path, "--fast", **env)
  assert code == 1 and errors == ""
  assert any(word in line for line in report["must_change"])


@pytest.mark.parametrize(
  ("package", "body", "found", "cure"),
  [
    ("mujoco", "raise ImportError('no libGL')", "no libGL", "MuJoCo cannot be used"),
    ("jax", "import os; os.abort()", "SIGABRT", "mend the installation"),
  ],
)
def test_a_package_that_cannot_be_imported_is_a_line(
  package, body, found, cure, tmp_path
):
  broken = tmp_path / "site" / package
  broken.mkdir(parents=True)
  (broken / "__init__.py").write_text(body)
  path = os.pathsep.join((str(tmp_path / "site"), str(ROOT)))
  code, report, errors = doctor(tmp_path, PYTHONPATH=path)
  assert code == 1 and errors == "" and "self-test" not in report
  assert found in " ".join(report["devices"].values())
  assert any(cure in line for line in report["must_change"])


def test_a_check_that_hangs_is_ended():
  found, free = worker.examine(False, lambda _: None, timeout_s=0.01)
  assert free is None and "no answer" in found[-1].text and found[-1].broken


def test_an_exception_is_a_finding():
  (found,) = checked("disk", "cache", lambda: 1 / 0)  # ty: ignore
  assert found.text == "ZeroDivisionError: division by zero" and found.cure


def test_missing_memory_names_the_presets(monkeypatch):
  broken = EntryPoint("broken", "none:CONFIG", "apnpql.presets")
  monkeypatch.setattr(files, "_installed", lambda: {"broken": broken})
  (found,) = machine.memory(1 << 50)
  assert not found.cure
  (found,) = machine.memory(0)
  own = files.own_preset_names()
  assert found.needed and all(name in found.cure for name in own)
  sizes = {name: machine.checks.replay_bytes(files.load_preset(name)) for name in own}
  largest = max(sizes, key=lambda name: sizes[name])
  (found,) = machine.memory(sizes[largest] + PROCESS_BYTES - 1)
  assert not found.needed and largest in found.cure


def test_one_core_is_advice(monkeypatch):
  monkeypatch.setattr(machine.runtime, "cores", lambda: 1)
  (found,) = machine.cores()
  assert found.cure.startswith("one core") and not found.needed


@pytest.mark.parametrize(("text", "quota"), [("150000 100000", 1.5), ("max 1", None)])
def test_the_limit_of_a_container_is_read(text, quota, tmp_path, monkeypatch):
  (tmp_path / "cpu.max").write_text(text)
  monkeypatch.setattr(machine, "_QUOTA", tmp_path / "cpu.max")
  assert machine._quota() == quota


def test_a_folder_without_a_home_is_named(monkeypatch):
  monkeypatch.setattr(machine.runtime, "cache_dir", lambda: None)
  (found,) = machine.caches()
  assert "set XDG_CACHE_HOME" in found.cure and found.needed


def test_versions_are_compared_with_the_requirements():
  assert not software._judge("numpy", "2.4.6", "numpy>=2; python_version>'3'").cure
  assert "pip install 'numpy>=2'" in software._judge("numpy", "1.26", "numpy>=2").cure
  assert software._judge("mink", None, "mink>=1.3").text == "missing"


def test_every_extra_of_users_is_explained():
  project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
  assert set(software.EXTRAS) == {*project["optional-dependencies"]} - {"peers", "test"}
