"""The wheel and the lock files, as users install them."""

from __future__ import annotations

from importlib import metadata
import json
import os
from pathlib import Path
import re
import subprocess
import sys
import tomllib
import zipfile

from hatchling.builders.wheel import WheelBuilder
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
import pytest

from apnpql_jax import runtime
from apnpql_jax.config import files
from apnpql_jax.errors import ConfigError

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
  """Builds the wheel like an installer, without the network."""
  folder = tmp_path_factory.mktemp("wheel")
  return Path(next(WheelBuilder(str(ROOT)).build(directory=str(folder))))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
  """Unpacks the wheel like an installer."""
  folder = tmp_path_factory.mktemp("site")
  with zipfile.ZipFile(wheel) as archive:
    archive.extractall(folder)
  return folder


def python(site: Path, cwd: Path, *args: str) -> str:
  """Returns the output of Python in ``cwd`` with ``site`` first on the path."""
  done = subprocess.run(
    [sys.executable, *args],
    cwd=cwd,
    env=dict(os.environ, PYTHONPATH=str(site)),
    capture_output=True,
    text=True,
    check=False,
  )
  assert done.returncode == 0, done.stderr
  return done.stdout


def locked(name: str) -> dict[str, Requirement]:
  """Returns normalized name -> requirement of a lock file."""
  lines = (ROOT / name).read_text().splitlines()
  return {canonicalize_name(x.name): x for x in map(Requirement, lines)}


def test_wheel_holds_scenes_presets_and_the_whole_package(wheel):
  with zipfile.ZipFile(wheel) as archive:
    names = set(archive.namelist())
  expected = {str(x.relative_to(ROOT)) for x in ROOT.glob("apnpql_jax/**/*.py")}
  for folder, pattern in (("mjcf", "*.xml"), ("experiments", "*.py")):
    found = {
      f"apnpql_jax/{x.relative_to(ROOT)}" for x in ROOT.glob(f"{folder}/{pattern}")
    }
    assert found
    expected |= found
  assert expected <= names
  tops = {name.split("/")[0] for name in names}
  assert tops == {"apnpql_jax", next(x for x in tops if x.endswith(".dist-info"))}
  assert not any("/results/" in name or name.endswith(".pyc") for name in names)


def test_wheel_works_from_another_directory(installed, tmp_path):
  code = (
    "import apnpql_jax; print(apnpql_jax.__file__);"
    "from apnpql_jax.config import files;"
    "print(files.mjcf_path('push_plate')); files.load_preset('push_plate')"
  )
  for line in python(installed, tmp_path, "-c", code).splitlines():
    assert Path(line).is_relative_to(installed)
  out = python(installed, tmp_path, "-m", "apnpql_jax", "list", "--json")
  names = json.loads(out)
  assert names["presets"] == files.preset_names()
  assert set(names["presets"]) == {*names["tasks"], "sim_to_real"}


def test_scenes_in_the_wheel_compile(installed, tmp_path):
  code = (
    "from apnpql_jax.tasks import make_task, task_names;"
    "[print(make_task(name).scene.model.ncam) for name in task_names()]"
  )
  assert python(installed, tmp_path, "-c", code).split() == ["3"] * 4


def test_command_is_declared(installed):
  (entry,) = installed.glob("*.dist-info/entry_points.txt")
  assert "apnpql = apnpql_jax.cli.main:main" in entry.read_text()


@pytest.mark.parametrize("name", sorted(p.name for p in ROOT.glob("*.lock")))
def test_lock_is_plain_names_and_versions(name):
  for line in (ROOT / name).read_text().splitlines():
    assert re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.]+(; python_version .+)?", line)


@pytest.mark.parametrize(
  ("lock", "wanted"),
  [
    ("requirements.lock", PROJECT["dependencies"]),
    ("requirements-dev.lock", PROJECT["optional-dependencies"]["test"]),
  ],
)
def test_lock_satisfies_the_requirements_of_the_project(lock, wanted):
  versions = locked("requirements.lock") | locked(lock)
  for requirement in map(Requirement, wanted):
    found = versions[canonicalize_name(requirement.name)]
    (version,) = (x.version for x in found.specifier)
    assert requirement.specifier.contains(version, prereleases=True), requirement
    assert found.marker == requirement.marker


EXPORT = """
import sys
sys.modules.update(dict.fromkeys(sys.argv[1:]))  # As if they were not installed.
import jax
made = jax.export.export(jax.jit(lambda x: 2 * x))(1.0).serialize()
print(jax.export.deserialize(made).call(3.0))
"""


def test_the_lock_of_the_runtime_suffices_for_exported_programs(tmp_path):
  """``robot run`` plays them after ``make``, without an extra."""
  runtime_has = locked("requirements.lock").keys()
  others = [
    module
    for module, packages in metadata.packages_distributions().items()
    if runtime_has.isdisjoint(map(canonicalize_name, packages))
  ]
  assert "pytest" in others
  assert python(ROOT, tmp_path, "-c", EXPORT, *others) == "6.0\n"


def test_the_workflow_caches_what_the_tests_compile():
  workflow = (ROOT / ".github" / "workflows" / "checks.yml").read_text()
  cache = runtime.cache_dir()
  assert cache is not None and f"path: {cache.relative_to(ROOT)}\n" in workflow


def make(folder: Path, *args: str) -> subprocess.CompletedProcess[str]:
  """Calls make with the Makefile of the project in another folder."""
  command = ["make", "-f", str(ROOT / "Makefile"), "-C", str(folder), *args]
  return subprocess.run(command, capture_output=True, text=True)


def test_make_leaves_an_environment_alone_that_it_has_not_made(tmp_path):
  mine = tmp_path / ".venv" / "mine.txt"
  mine.parent.mkdir()
  mine.touch()
  made = make(tmp_path, ".venv/.python", f"PYTHON={sys.executable}")
  first = made.stderr.splitlines()[0]
  assert made.returncode == 2 and first.startswith(".venv was not made by make")
  make(tmp_path, "clean")
  assert [*mine.parent.iterdir()] == [mine]


def test_make_replaces_an_environment_that_it_has_not_finished(tmp_path):
  python, venv = tmp_path / "python", tmp_path / ".venv"
  python.write_text(
    '#!/bin/sh\n[ "$1" = -c ] && exit\ntouch "$3/half"\nkill -9 $PPID\n'
  )
  python.chmod(0o755)
  assert make(tmp_path, ".venv/.python", f"PYTHON={python}").returncode == 2
  assert (venv / "half").exists()
  made = make(tmp_path, ".venv/.python", f"PYTHON={sys.executable}")
  assert made.returncode == 0, made.stderr
  assert (venv / ".python").exists() and not (venv / "half").exists()
  make(tmp_path, "clean")
  assert not venv.exists()


def test_mujoco_and_mjx_are_a_matched_pair():
  versions = locked("requirements.lock")
  assert versions["mujoco"].specifier == versions["mujoco-mjx"].specifier


@pytest.mark.parametrize(
  "name",
  ["", "..", "../cli", "push_plate/../push_plate", "/etc/passwd", "push_plate\n"],
)
def test_names_cannot_leave_their_folder(name):
  with pytest.raises(ConfigError, match="push_plate"):
    files.load_preset(name)
  with pytest.raises(ConfigError, match="push_plate"):
    files.mjcf_path(name)
