"""The folder of an exported policy: program, contract and example."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from apnpql_jax import devices, tasks
from apnpql_jax.atomic import check_writable, replacing
from apnpql_jax.config.checks import ACTING
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.deploy import contract, program
from apnpql_jax.envs.env import observation_shapes
from apnpql_jax.errors import FileError, check_name
from apnpql_jax.runs import checkpoint_reader, provenance, run_folder
from apnpql_jax.training.evaluate import load_agent

PROGRAM, CONTRACT, EXAMPLE = "policy.bin", "contract.json", "example.py"
_TEMPLATE = Path(__file__).resolve().parents[1] / "templates" / "use_policy.py"

VERSION = 1
"""Version of the contract; it increases if readers of the old one would misread it."""


def export(
  run_dir: Path | str,
  folder: Path | str,
  *,
  step: int | None = None,
  acting: str | None = None,
  overwrite: bool = False,
) -> dict[str, Any]:
  """Writes the policy of a run to a folder that needs only JAX, flatbuffers and NumPy.

  The contract is written last: a folder without one is not complete.

  Args:
    run_dir: The run folder.
    folder: Folder to make.
    step: Step of the checkpoint; the newest if None.
    acting: Rule that chooses actions, see ``agents/acting.py``; that of the run's
      evaluations if None.
    overwrite: Replace an earlier export.

  Returns:
    The folder and what it holds.

  Raises:
    ConfigError: An argument is invalid.
    FileError: Not a run folder, no readable checkpoint, or the folder exists.
    UserError: The policy cannot be exported.
  """
  run_dir, folder = Path(run_dir), Path(folder)
  if acting is not None:
    check_name("acting", acting, ACTING)
  check_free(folder, overwrite=overwrite)
  config = run_folder.open_run(run_dir).config
  acting = acting or config.eval_acting
  checkpoint_reader.restore(run_dir, step, {}, config=config)  # Fails early.
  devices.start()
  task = tasks.make_task(config.env.task)
  agent, params, step = load_agent(run_dir, config, task, step=step)
  lstm_instants = config.agent.lstm_instants
  seen = observation_shapes(config.env, task, lstm_instants=lstm_instants)
  shapes = seen.present()
  act = program.make_act(agent, params, acting=acting)
  exported = program.export(act, shapes)
  about = {
    "contract": VERSION,
    "program": {
      "file": PROGRAM,
      "sha256": hashlib.sha256(exported.data).hexdigest(),
      "platforms": list(program.PLATFORMS),
      "calling_convention": exported.calling_convention,
      "arguments": "observation: dict of fields with a batch axis; key: uint32[2]",
      "result": "actions float32[1, 7]",
      "xla_flags": os.environ.get("XLA_FLAGS", ""),
    },
    "acting": {"rule": acting, "needs_key": exported.needs_key},
    **contract.describe(config.env, task.scene, shapes, lstm_instants=lstm_instants),
    "origin": _origin(run_dir, config, step)
    | {
      "params_sha256": contract.hash_of(params),
      "scene_sha256": task.scene.fingerprint,
    },
  }
  _write(folder, exported.data, about)
  return {
    "folder": str(folder),
    "task": config.env.task,
    "checkpoint_step": step,
    "acting": acting,
    "needs_key": exported.needs_key,
    "bytes": len(exported.data),
  }


def check_free(folder: Path, *, overwrite: bool) -> None:
  """Checks that an export can be written to a folder.

  Raises:
    FileError: It exists and must not be replaced, is not an export, or cannot be made.
  """
  check_writable(folder)
  if not folder.exists():
    return
  known = folder.is_dir() and {x.name for x in folder.iterdir()}
  if known is False or known - {PROGRAM, CONTRACT, EXAMPLE}:
    raise FileError(f"{str(folder)!r} is not an exported policy; name another folder")
  if known and not overwrite:
    raise FileError(
      f"{str(folder)!r} exists; replace it with --overwrite, or name another folder"
    )


def _origin(run_dir: Path, config: TrainConfig, step: int) -> dict[str, Any]:
  """Returns what the policy was made from, and with which versions."""
  now = provenance.describe_versions(1, config.env.task_file)
  began = provenance.read(run_dir) or {}
  return {
    "run": run_dir.absolute().name,
    "checkpoint_step": step,
    "seed": config.seed,
    "algorithm": config.agent.algorithm,
    "task_file_sha256": now["task_file"],
    "trained_with": {k: began.get(k) for k in ("python", "packages", "git", "device")},
    "exported_with": {k: now[k] for k in ("created", "python", "packages", "git")},
  }


def _write(folder: Path, data: bytes, about: dict[str, Any]) -> None:
  folder.mkdir(parents=True, exist_ok=True)
  (folder / CONTRACT).unlink(missing_ok=True)
  texts = {EXAMPLE: _TEMPLATE.read_text(encoding="utf-8")}
  texts[CONTRACT] = json.dumps(about, indent=2) + "\n"
  with replacing(folder / PROGRAM) as part:
    part.write_bytes(data)
  for name, text in texts.items():
    with replacing(folder / name) as part:
      part.write_text(text, encoding="utf-8")
