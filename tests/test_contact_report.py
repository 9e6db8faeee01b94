"""What `apnpql list --contacts` measures and prints."""

from __future__ import annotations

import mujoco
import pytest

from apnpql_jax.cli import _show_names
from apnpql_jax.contact_report import contact_report
from apnpql_jax.tasks import make_task, task_names

PLANE, SPHERE, CAPSULE, BOX = (
  int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
  for name in ("PLANE", "SPHERE", "CAPSULE", "BOX")
)
SLOTS = {
  (PLANE, SPHERE): 1,
  (PLANE, CAPSULE): 2,
  (PLANE, BOX): 4,
  (SPHERE, CAPSULE): 1,
  (SPHERE, BOX): 1,
  (CAPSULE, CAPSULE): 1,
  (CAPSULE, BOX): 2,
  (BOX, BOX): 4,
}
"""Contacts per pair of shapes (MuJoCo documentation, MJX feature parity)."""


@pytest.mark.parametrize("name", task_names())
def test_slots_are_those_of_the_pairs(name):
  task = make_task(name)
  model = task.scene.model
  pairs = [
    tuple(sorted((model.geom_type[one], model.geom_type[other])))
    for one, other in zip(model.pair_geom1, model.pair_geom2, strict=True)
  ]
  slots = [SLOTS[pair] for pair in pairs]
  rows = sum(n * dim for n, dim in zip(slots, model.pair_dim, strict=True))
  report = contact_report(task, backends=())
  assert report["pairs"] == len(pairs)
  assert report["contacts"] == sum(slots)
  # Beside contacts: the equalities of the fingers, and a limit per limited joint.
  others = report["constraint_rows"] - rows
  assert others == model.neq + model.jnt_limited.sum()


def test_speed_is_measured_per_engine_and_printed():
  report = contact_report(make_task("push_plate"), backends=("native",))
  assert report["native_steps_per_s"] > 0
  assert "mjx_steps_per_s" not in report
  line = _show_names({"push_plate": report})
  words = (
    "push_plate  28 pairs, 46 contacts, 151 constraint rows, ",
    " native steps per s",
  )
  assert line.startswith(words[0]) and line.endswith(words[1])
