"""Process-wide settings that must be in place before JAX starts its backend.

Called once by ``import apnpql_jax``. Nothing here imports JAX: the settings go
through the environment, and through ``jax.config`` where the caller imported JAX
first. A value the user has set is kept, except for a thread count that can hang.
"""

from __future__ import annotations

from collections.abc import Generator
import contextlib
from importlib import metadata
import io
import os
from pathlib import Path
import re
import sys

MIN_THREADS = 4
"""Smallest XLA:CPU thread pool in which two batched Cholesky calls cannot lock; the
devices of a CPU that has been told to be several share one pool."""

_DEFAULTS = {
  # On a GPU, XLA multiplies f32 matrices in TF32 (10 bits of mantissa) unless told
  # otherwise. Mass matrices and forward kinematics then lose three digits, and
  # contacts with them. No effect on a CPU.
  "jax_default_matmul_precision": "highest",
}

KEPT_FUSIONS = "INDIVIDUAL_CONVOLUTION", "INDIVIDUAL_DOT"
"""What XLA:CPU hands over to the library YNNPACK. By default also "REDUCE"."""

_FLAG, _FLAG_VERSIONS = "xla_cpu_experimental_ynn_fusion_type", r"0\.1[01]\."
"""And the versions of jaxlib: XLA ends a process that names a flag it does not know."""


def configure() -> None:
  """Sets threads, flags, compilation cache and precision; safe to call again."""
  _set_threads()
  _keep_sums()
  defaults = dict(_DEFAULTS, jax_compilation_cache_dir=str(cache_dir() / "xla"))
  for name, value in defaults.items():
    os.environ.setdefault(name.upper(), value)
    jax = sys.modules.get("jax")
    if jax is not None and getattr(jax.config, name, None) is None:
      jax.config.update(name, os.environ[name.upper()])


def cache_dir() -> Path:
  """The user's cache folder of this package; made by whoever writes into it."""
  root = os.environ.get("XDG_CACHE_HOME", "")
  base = Path(root) if os.path.isabs(root) else Path.home() / ".cache"
  return base / "apnpql_jax"


@contextlib.contextmanager
def quiet_warp() -> Generator[None, None, None]:
  """Drops the lines MJX prints when it is imported without the optional Warp.

  They go to standard output and look like errors. Anything else printed inside is
  passed on.
  """
  captured = io.StringIO()
  try:
    with contextlib.redirect_stdout(captured):
      yield
  finally:
    for line in captured.getvalue().splitlines():
      if not line.startswith(("Failed to import warp", "Failed to import mujoco_warp")):
        print(line)


def _set_threads() -> None:
  # The batched Cholesky of XLA:CPU waits inside a pool thread for other pool
  # threads. With a pool of two, two such calls wait for each other for ever (seen
  # from 128 worlds upwards); with four they do not. XLA sizes the pool from these
  # variables, or from the number of cores.
  least, pinned = MIN_THREADS * _cpu_devices(), False
  for name in ("PJRT_NPROC", "NPROC"):
    text = os.environ.get(name, "")
    if text.isdigit():
      pinned = True
      if int(text) < least:
        os.environ[name] = str(least)
  if not pinned and cores() < least:
    os.environ["NPROC"] = str(least)


def _keep_sums() -> None:
  # The sums of MJX's line search are so small that handing them over takes longer than
  # adding up: a step of physics then takes 1.3 to 1.8 times as long. Updates of the
  # presets gain too, while those of batch 32 with 30 candidates lose 8 %.
  flags = os.environ.get("XLA_FLAGS", "")
  flag = fusions_flag(*KEPT_FUSIONS)
  if flag and _FLAG not in flags:
    os.environ["XLA_FLAGS"] = f"{flags} {flag}".lstrip()


def fusions_flag(*kinds: str) -> str:
  """The flag by which XLA:CPU hands over these alone; "" if it may not know it."""
  if not re.match(_FLAG_VERSIONS, metadata.version("jaxlib")):
    return ""
  return f"--{_FLAG}=" + ",".join(f"LIBRARY_FUSION_TYPE_{kind}" for kind in kinds)


def _cpu_devices() -> int:
  """How many devices JAX is to take the CPU for; one if nobody has asked for more."""
  flag = r"xla_force_host_platform_device_count=(\d+)"
  found = re.search(flag, os.environ.get("XLA_FLAGS", ""))
  text = found[1] if found else os.environ.get("JAX_NUM_CPU_DEVICES", "")
  return max(1, int(text)) if text.isdigit() else 1


def cores() -> int:
  """CPU cores this process may use."""
  if hasattr(os, "sched_getaffinity"):  # Not on macOS.
    return len(os.sched_getaffinity(0))
  return os.cpu_count() or 1
