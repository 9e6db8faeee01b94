"""Loads an exported policy and prints the action for an empty observation."""

from importlib.metadata import version
import json
import os
from pathlib import Path

import numpy as np

folder = Path(__file__).parent
contract = json.loads((folder / "contract.json").read_text())
if version("jaxlib") == contract["origin"]["exported_with"]["packages"]["jaxlib"]:
  # The last bits depend on these flags; other versions of XLA may not have them.
  os.environ.setdefault("XLA_FLAGS", contract["program"]["xla_flags"])
from jax import export, jit  # noqa: E402 (after the flags)

act = jit(export.deserialize(bytearray((folder / "policy.bin").read_bytes())).call)
fields = contract["observation"]["fields"]  # In place of zeros: robot and cameras.
observation = {k: np.zeros((1, *f["shape"]), f["dtype"]) for k, f in fields.items()}
print(np.asarray(act(observation, np.zeros(2, np.uint32)))[0])
