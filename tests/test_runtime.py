"""Process settings: those that ``configure`` makes, and that importing makes none."""

from __future__ import annotations

import json
import os
from pathlib import Path
import re
import subprocess
import sys

import pytest

from apnpql_jax import runtime

ROOT = Path(__file__).resolve().parents[1]
NAMES = (
  "NPROC",
  "PJRT_NPROC",
  "JAX_COMPILATION_CACHE_DIR",
  "JAX_DEFAULT_MATMUL_PRECISION",
  "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
  "XLA_FLAGS",
)
IMPORTS_MJX = r"(?m)^\s*(from mujoco import mjx|(import|from) mujoco\.mjx)"
CONFIGURE = "import apnpql_jax; apnpql_jax.configure()"


def run(code: str, **env: str) -> str:
  """Returns the output of ``code`` in a process that has only the settings ``env``."""
  base = {k: v for k, v in os.environ.items() if k not in NAMES}
  done = subprocess.run(
    [sys.executable, "-c", code],
    env=base | {"PYTHONPATH": str(ROOT)} | env,
    capture_output=True,
    text=True,
    check=True,
  )
  return done.stdout


def settings(before: str = "", **env: str) -> dict[str, str]:
  """Returns the environment after ``apnpql_jax.configure()`` in a new process."""
  report = f"{CONFIGURE}; print(json.dumps(dict(os.environ)))"
  return json.loads(run(f"import json, os\n{before}\n{report}", **env))


def threads(env: dict[str, str], cores: int) -> int:
  """Returns the size of XLA's thread pool: the first variable set, else the cores."""
  return int(env.get("PJRT_NPROC") or env.get("NPROC") or cores)


def test_import_changes_no_variable_and_starts_no_backend():
  code = (
    "import json, os, pkgutil; import jax, mujoco.mjx, flax, distrax, mink;"
    "import orbax.checkpoint, imageio, matplotlib, gymnasium;"
    "before = dict(os.environ);"
    "import apnpql_jax;"
    "[__import__(m.name) for m in pkgutil.walk_packages(apnpql_jax.__path__,"
    " 'apnpql_jax.') if not m.name.endswith(('__main__', 'stable_baselines', 'sac'))"
    " and '.templates.' not in m.name];"
    "from jax._src import xla_bridge;"
    "print([n for n in os.environ if os.environ[n] != before.get(n)],"
    " xla_bridge.backends_are_initialized())"
  )
  assert run(code).splitlines()[-1] == "[] False"


def test_no_import_prints_about_the_optional_warp():
  """MJX prints when it is imported; only the module that hides that may import it."""
  modules = [p for x in ("apnpql_jax", "benchmarks") for p in (ROOT / x).rglob("*.py")]
  users = {p.stem for p in modules if re.search(IMPORTS_MJX, p.read_text())}
  assert users == {"quiet_mjx"}
  assert run("import apnpql_jax.tasks.contact_report") == ""


@pytest.mark.parametrize(
  ("given", "minimum"),
  [
    ({}, 4),
    ({"NPROC": "2"}, 4),
    ({"PJRT_NPROC": "1"}, 4),
    ({"NPROC": "1", "PJRT_NPROC": "2"}, 4),
    ({"NPROC": "8"}, 8),
    ({"XLA_FLAGS": "--xla_force_host_platform_device_count=3", "NPROC": "8"}, 12),
    ({"JAX_NUM_CPU_DEVICES": "2"}, 8),
  ],
)
def test_pool_has_at_least_four_threads_per_device(given, minimum):
  one_core = "os.sched_setaffinity(0, {0}) if hasattr(os, 'sched_setaffinity') else 0"
  assert threads(settings(one_core, **given), cores=1) >= minimum


def test_settings_of_the_user_are_kept(tmp_path):
  given = {
    "JAX_COMPILATION_CACHE_DIR": str(tmp_path),
    "JAX_DEFAULT_MATMUL_PRECISION": "float32",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "3",
    "NPROC": "6",
    "XLA_FLAGS": runtime.fusions_flag("INDIVIDUAL_DOT", "REDUCE"),
  }
  env = settings(**given)
  assert {name: env[name] for name in given} == given


def test_sums_stay_inside_xla_next_to_flags_of_the_user():
  code = "print(jax.jit(lambda x: (x * x).sum(1)).lower(jax.numpy.ones((32, 64, 3)))"
  fused = [
    "ynn_fusion" in run(f"{start}; {code}.compile().as_text())", **flags)
    for start, flags in (
      ("import jax", {}),
      (f"{CONFIGURE}; import jax", {}),
      (f"import jax; {CONFIGURE}", {"XLA_FLAGS": "--xla_cpu_enable_fast_math=false"}),
    )
  ]
  assert fused == [True, False, False]


def test_an_untested_version_of_xla_gets_no_flag(monkeypatch):
  monkeypatch.delenv("XLA_FLAGS", raising=False)
  monkeypatch.setattr(runtime.metadata, "version", lambda _: "0.12.0")
  runtime.configure()
  assert "XLA_FLAGS" not in os.environ


def test_cache_is_in_the_cache_folder_of_the_user(tmp_path):
  env = settings(XDG_CACHE_HOME=str(tmp_path))
  assert env["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "apnpql_jax" / "xla")
  env = settings(XDG_CACHE_HOME="relative", HOME=str(tmp_path))
  expected = tmp_path / ".cache" / "apnpql_jax" / "xla"
  assert env["JAX_COMPILATION_CACHE_DIR"] == str(expected)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_without_home_and_passwd_entry_commands_work_but_nothing_is_kept():
  line = "you have no home folder; compiled programs are not kept (set XDG_CACHE_HOME)"
  code = (
    "import os, sys, pwd; sys.stderr = sys.stdout; del os.environ['HOME'];"
    "from apnpql_jax.cli import main;"
    "from apnpql_jax.cli.list_names import List, list_names;"
    "list_names(List()); os.setuid(54321);"
    "main.main(['--help']); main.main(['list'])"
  )
  _, _, shown = run(code, XDG_CACHE_HOME="").partition("usage: apnpql COMMAND")
  assert shown.count(line) == 1 and "ap_npql" in shown.partition(line)[2]


def test_a_cache_that_cannot_be_written_costs_one_line(tmp_path):
  (tmp_path / "file").write_text("")
  code = f"{CONFIGURE}; import jax; print(jax.config.jax_compilation_cache_dir)"
  report = "import sys; sys.stderr = sys.stdout"
  shown = run(f"{report}; {code}", XDG_CACHE_HOME=str(tmp_path / "file"))
  line, cache = shown.splitlines()
  assert line.startswith(f"cannot write to '{tmp_path}/file/apnpql_jax/xla': Not a dir")
  assert cache == "None"


@pytest.mark.parametrize(
  "order",
  [f"{CONFIGURE}; import jax", f"import jax; {CONFIGURE}"],
  ids=["first", "after"],
)
def test_jax_has_the_settings_whichever_is_imported_first(order, tmp_path):
  code = (
    f"{order}; c = jax.config;"
    "print(c.jax_compilation_cache_dir, c.jax_persistent_cache_min_compile_time_secs,"
    " c.jax_default_matmul_precision)"
  )
  cache = tmp_path / "apnpql_jax" / "xla"
  shown = run(code, XDG_CACHE_HOME=str(tmp_path)).split()
  assert shown == [str(cache), "0.2", "highest"]


@pytest.mark.parametrize("also", ["", f"{CONFIGURE};"], ids=["late", "again"])
def test_settings_that_come_too_late_are_an_error(also):
  code = (
    f"import jax, os; os.environ['NPROC'] = '2'; {also} jax.numpy.ones(1)\n"
    f"before = dict(os.environ)\ntry: {CONFIGURE}\n"
    "except apnpql_jax.UserError as error: print(error)\n"
    "assert os.environ == before"
  )
  output = run(code)
  if also:
    assert output == ""
  else:
    assert "too late to set NPROC, XLA_FLAGS, JAX_COMPILATION_CACHE_DIR" in output
    assert output.endswith("call configure() first\n")


@pytest.mark.parametrize(
  ("name", "value"),
  [
    ("jax_enable_x64", True),
    ("jax_numpy_rank_promotion", "raise"),
    ("jax_numpy_dtype_promotion", "strict"),
  ],
)
def test_unsupported_settings_of_jax_are_refused(name, value):
  refused = f"try: {CONFIGURE}\nexcept apnpql_jax.UserError as error: print(error)"
  line = f"{name.upper()}={value} is not supported; unset it\n"
  assert run(refused, **{name.upper(): str(value)}) == line
  assert run(f"import jax; jax.config.update({name!r}, {value!r})\n{refused}") == line


def test_quiet_warp_drops_only_its_two_lines(capsys):
  with runtime.quiet_warp():
    print("Failed to import warp: No module named 'warp'")
    print("something else")
    print("Failed to import mujoco_warp: No module named 'warp'")
  assert capsys.readouterr().out == "something else\n"


def test_quiet_warp_passes_errors_through(capsys):
  with pytest.raises(ImportError), runtime.quiet_warp():
    print("a hint")
    raise ImportError
  assert capsys.readouterr().out == "a hint\n"


def test_a_container_leaves_what_it_does_not_use(tmp_path, monkeypatch):
  """Cached files count as free, since the kernel drops them first."""
  monkeypatch.setattr(runtime, "_CGROUP", tmp_path)
  (tmp_path / "memory.current").write_text("12000000\n")
  (tmp_path / "memory.stat").write_text("anon 9000000\ninactive_file 3000000\n")
  (tmp_path / "memory.max").write_text("16000000\n")
  assert runtime.host_memory() == 7_000_000
  (tmp_path / "memory.max").write_text("max\n")
  assert (runtime.host_memory() or 0) > 7_000_000
