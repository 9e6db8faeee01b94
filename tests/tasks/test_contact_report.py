"""Measurements and output of `apnpql list --contacts`."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from apnpql_jax.cli.main import _show
from apnpql_jax.tasks import make_task, task_names
from apnpql_jax.tasks.contact_report import contact_report

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
def test_slots_are_those_of_the_pairs_up_to_the_scenes_limit(name):
  task = make_task(name)
  model = task.scene.model
  names = [model.numeric(i).name for i in range(model.nnumeric)]
  slots = dict.fromkeys(np.unique(model.pair_dim), 0)
  for one, other, dim in zip(
    model.pair_geom1, model.pair_geom2, model.pair_dim, strict=True
  ):
    slots[dim] += SLOTS[tuple(sorted((model.geom_type[one], model.geom_type[other])))]
  if "max_contact_points" in names:
    limit = int(model.numeric("max_contact_points").data[0])
    assert any(slot > limit for slot in slots.values())  # The limit applies.
    slots = {dim: min(slot, limit) for dim, slot in slots.items()}
  report = contact_report(task, backends=())
  assert report["pairs"] == model.npair
  assert report["contacts"] == sum(slots.values())
  # Rows other than contacts: the fingers' equalities, one limit per limited joint.
  others = report["constraint_rows"] - sum(dim * slot for dim, slot in slots.items())
  assert others == model.neq + model.jnt_limited.sum()


def test_speed_is_measured_per_engine_and_printed():
  report = contact_report(make_task("push_plate"), backends=("native",))
  assert report["native_steps_per_s"] > 0
  assert "mjx_steps_per_s" not in report
  line = _show({"push_plate": report})
  expected = (
    "push_plate  28 pairs, 12 contacts, 49 constraint rows, ",
    " native steps per s",
  )
  assert line.startswith(expected[0]) and line.endswith(expected[1])
