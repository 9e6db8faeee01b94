"""Process-wide settings that must precede the start of JAX's backend.

They go through the environment, and through ``jax.config`` if JAX is already imported.
Values set by the user are kept, except for a thread count that can deadlock.
"""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import gc
from importlib import metadata
import io
import multiprocessing
import os
from pathlib import Path
import re
import sys
import threading
from typing import Any

from apnpql_jax.atomic import check_writable
from apnpql_jax.console import print_line
from apnpql_jax.errors import UserError

_UNSUPPORTED = {
  "jax_enable_x64": ("1", "true", "t", "yes", "y", "on"),
  "jax_numpy_rank_promotion": ("raise",),
  "jax_numpy_dtype_promotion": ("strict",),
}
"""Settings of JAX and their values under which this package or MJX fails."""

MIN_THREADS = 4  # XLA:CPU threads per emulated device, which share a pool
# Operations that XLA:CPU runs in the library YNNPACK; its default adds "REDUCE".
KEPT_FUSIONS = "INDIVIDUAL_CONVOLUTION", "INDIVIDUAL_DOT"
_JAX_DEFAULTS = None, 1.0  # of the settings in ``configure``
_MEMINFO = Path("/proc/meminfo")
_CGROUP = Path("/sys/fs/cgroup")
# The flag and the jaxlib versions that have it; XLA aborts on unknown flags.
_FLAG, _FLAG_VERSIONS = "xla_cpu_experimental_ynn_fusion_type", r"0\.1[01]\."


def configure() -> None:
  """Sets threads, XLA flags, cache and precision; must run before JAX runs anything.

  Raises:
    UserError: JAX has run something, so a setting that is missing would have no effect;
      or JAX has a setting that this package does not support.
  """
  jax: Any = sys.modules.get("jax")
  for name, refused in _UNSUPPORTED.items():
    given = getattr(jax.config, name) if jax else os.environ.get(name.upper(), "")
    if str(given).lower() in refused:
      raise UserError(f"{name.upper()}={given} is not supported; unset it")
  wanted = _threads() | _fusions()
  changed = {k: value for k, value in wanted.items() if os.environ.get(k) != value}
  cache = _xla_cache()
  settings: dict[str, Any] = {"jax_compilation_cache_dir": cache} if cache else {}
  settings |= {
    # Below JAX's default are programs that together delay each start by a second.
    "jax_persistent_cache_min_compile_time_secs": 0.2,
    # By default XLA multiplies f32 matrices in TF32 (10 bits of mantissa) on GPUs. Mass
    # matrices, forward kinematics and so contacts would lose three digits.
    "jax_default_matmul_precision": "highest",
  }
  bridge: Any = sys.modules.get("jax._src.xla_bridge")
  unset = [k for k in settings if jax and getattr(jax.config, k, None) in _JAX_DEFAULTS]
  if (changed or unset) and bridge and bridge.backends_are_initialized():
    names = ", ".join((*changed, *(name.upper() for name in unset)))
    raise UserError(
      f"JAX has run something, so it is too late to set {names}; restart Python and "
      "call configure() first"
    )
  os.environ.update(changed)
  for name, value in settings.items():
    os.environ.setdefault(name.upper(), str(value))
    if name in unset:
      jax.config.update(name, type(value)(os.environ[name.upper()]))


def collect_garbage_less_often() -> None:
  """Lets Python's garbage collector pass over what the imports made, and run less.

  Tracing allocates so many objects that collecting them would slow down each start.
  """
  gc.freeze()
  gc.set_threshold(50_000, 20, 20)


def cache_dir() -> Path | None:
  """Returns the user's cache folder of this package, which may not exist yet.

  None if the user has no home.
  """
  root = os.environ.get("XDG_CACHE_HOME", "")
  if os.path.isabs(root):
    return Path(root) / "apnpql_jax"
  try:
    return Path.home() / ".cache" / "apnpql_jax"
  except RuntimeError:
    return None


def _xla_cache() -> str | None:
  """Returns the folder for compiled programs; prints a line if there is none."""
  if given := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
    return given
  try:
    if (cache := cache_dir()) is None:
      raise UserError("you have no home folder")
    check_writable(cache / "xla")
    return str(cache / "xla")
  except UserError as error:
    print_line(f"{error}; compiled programs are not kept (set XDG_CACHE_HOME)")
    return None


@contextlib.contextmanager
def quiet_warp() -> Generator[None, None, None]:
  """Drops the error-like lines that MJX prints when imported without optional Warp."""
  captured = io.StringIO()
  try:
    with contextlib.redirect_stdout(captured):
      yield
  finally:
    for line in captured.getvalue().splitlines():
      if not line.startswith(("Failed to import warp", "Failed to import mujoco_warp")):
        print(line)


def _threads() -> dict[str, str]:
  """Returns the variables that give XLA:CPU enough threads."""
  # The batched Cholesky of XLA:CPU waits in a pool thread for other pool threads. In a
  # pool of two, two such calls deadlock (seen from 128 worlds on); in a pool of four
  # they do not. XLA sizes the pool by these variables or the number of cores.
  minimum = MIN_THREADS * _cpu_devices()
  given = [x for x in ("PJRT_NPROC", "NPROC") if os.environ.get(x, "").isdecimal()]
  if not given and cores() < minimum:
    return {"NPROC": str(minimum)}
  return {name: str(max(minimum, int(os.environ[name]))) for name in given}


def _fusions() -> dict[str, str]:
  """Returns the variable that keeps sums out of YNNPACK, with the flags of the user."""
  # The sums of MJX's line search are too small for YNNPACK: with "REDUCE", a physics
  # step takes 1.3 to 1.8 times as long. Updates of the presets become faster without it
  # too; those with batch 32 and 30 candidates become 8 % slower.
  flags = os.environ.get("XLA_FLAGS", "")
  flag = fusions_flag(*KEPT_FUSIONS)
  if not flag or _FLAG in flags:
    return {}
  return {"XLA_FLAGS": f"{flags} {flag}".lstrip()}


def fusions_flag(*kinds: str) -> str:
  """Returns the XLA flag that limits YNNPACK to these kinds; "" if unsupported."""
  if not re.match(_FLAG_VERSIONS, metadata.version("jaxlib")):
    return ""
  return f"--{_FLAG}=" + ",".join(f"LIBRARY_FUSION_TYPE_{kind}" for kind in kinds)


def _cpu_devices() -> int:
  """Returns the number of devices that JAX is set to emulate on the CPU."""
  flag = r"xla_force_host_platform_device_count=(\d+)"
  found = re.search(flag, os.environ.get("XLA_FLAGS", ""))
  text = found[1] if found else os.environ.get("JAX_NUM_CPU_DEVICES", "")
  return max(1, int(text)) if text.isdecimal() else 1


def end_with_parent() -> None:
  """Ends this worker process of ``multiprocessing`` as soon as its parent has died.

  Call it first thing in the worker. A killed parent cannot end its workers itself.
  """
  parent = multiprocessing.parent_process()

  def wait() -> None:
    if parent is not None:
      parent.join()
      os._exit(1)

  threading.Thread(target=wait, daemon=True).start()


def cores() -> int:
  """Returns the number of CPU cores this process may use."""
  if hasattr(os, "sched_getaffinity"):  # Not on macOS.
    return len(os.sched_getaffinity(0))
  return os.cpu_count() or 1


def host_memory() -> int | None:
  """Returns the bytes of RAM that this process may still use; None if unknown."""
  bounds = [b for b in (_free_memory(), _left_in_container()) if b is not None]
  return min(bounds, default=None)


def _free_memory() -> int | None:
  with contextlib.suppress(OSError, KeyError, ValueError):
    lines = dict(x.split(":", 1) for x in _MEMINFO.read_text().splitlines())
    return int(lines["MemAvailable"].split()[0]) * 1024
  with contextlib.suppress(AttributeError, OSError, ValueError):
    # Outside Linux: total memory, free or not.
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
  return None


def _left_in_container() -> int | None:
  with contextlib.suppress(OSError, KeyError, ValueError):  # No limit, or "max".
    limit = int((_CGROUP / "memory.max").read_text())
    used = int((_CGROUP / "memory.current").read_text())
    lines = (_CGROUP / "memory.stat").read_text().splitlines()
    cached = int(dict(line.split() for line in lines)["inactive_file"])
    return max(limit - used + cached, 0)  # The kernel frees what it has only cached.
  return None
