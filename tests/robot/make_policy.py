"""Exports an untrained policy of random weights to test the runtime with."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

import jax
import jax.numpy as jnp

from apnpql_jax import testing
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.deploy import contract, program
from apnpql_jax.deploy.export import VERSION
from apnpql_jax.envs.env import observation_shapes
from apnpql_jax.tasks import make_task


def export_untrained(folder: Path, *, time_limit_s: float = 3.0) -> dict:
  """Writes the folder of a policy as ``apnpql export`` does; returns its contract."""
  config = EnvConfig(time_limit_s=time_limit_s)
  agent, task = make_agent(testing.SMALL), make_task(config.task)
  seen = observation_shapes(config, task, instants=0)
  zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), seen)
  params = agent.init(jax.random.key(1), zeros).params
  shapes = contract.fields(seen)
  made = program.export(program.make_act(agent, params, acting="policy"), shapes)
  about = {
    "contract": VERSION,
    "program": {
      "file": "policy.bin",
      "sha256": hashlib.sha256(made.data).hexdigest(),
      "xla_flags": os.environ.get("XLA_FLAGS", ""),
    },
    "acting": {"rule": "policy", "needs_key": made.needs_key},
    **contract.describe(config, task.scene, shapes, instants=0),
    "origin": {
      "scene_sha256": task.scene.fingerprint,
      "exported_with": {"packages": {"jaxlib": jax.lib.__version__}},
    },
  }
  folder.mkdir(parents=True, exist_ok=True)
  (folder / "policy.bin").write_bytes(made.data)
  (folder / "contract.json").write_text(json.dumps(about))
  return about
