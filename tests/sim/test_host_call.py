"""NumPy called from compiled code: arguments, results, errors and caching."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.sim import engines, host_call


def _shape(*shape: int) -> jax.ShapeDtypeStruct:
  return jax.ShapeDtypeStruct(shape, jnp.float32)


@pytest.mark.parametrize("device", ["cpu", "gpu"])
def test_arrays_of_every_rank_pass_through_a_scan(device, monkeypatch):
  """Other devices than the CPU use a callback, which works on a CPU too."""
  monkeypatch.setattr(jax, "default_backend", lambda: device)
  shapes = []

  def function(a, b, empty):
    shapes.append((a.shape, b.shape, empty.shape))
    return [a + b, np.float32(a.sum()), empty]

  name = f"test_every_rank_{device}"
  host_call.register(name, function)

  @jax.jit
  def run(a, b):
    def body(a, _):
      results = (_shape(2, 3), _shape(), _shape(2, 0, 3))
      moved, total, empty = host_call.call(name, results, a, b, jnp.zeros((2, 0, 3)))
      return moved, (total, empty)

    return jax.lax.scan(body, a, None, length=3)

  a, b = np.arange(6, dtype=np.float32).reshape(2, 3), np.ones((2, 3), np.float32)
  moved, (totals, empty) = run(a, b)
  np.testing.assert_array_equal(moved, a + 3)
  np.testing.assert_array_equal(totals, [15, 21, 27])
  assert empty.shape == (3, 2, 0, 3)
  assert shapes == 3 * [((2, 3), (2, 3), (2, 0, 3))]


def test_errors_of_the_function_reach_the_caller():
  """The function raises, returns a wrong shape, and gets an integer."""

  def function(x):
    if x < 0:
      raise ArithmeticError("below zero")
    return [np.zeros(3, np.float32)]  # Not the announced shape.

  host_call.register("test_errors", function)
  call = jax.jit(lambda x: host_call.call("test_errors", (_shape(2),), x))
  with pytest.raises(Exception, match="ArithmeticError: below zero"):
    jax.block_until_ready(call(jnp.float32(-1)))
  with pytest.raises(Exception, match="could not broadcast"):
    jax.block_until_ready(call(jnp.float32(1)))
  with pytest.raises(Exception, match="expected an f32 buffer"):
    jax.block_until_ready(call(jnp.int32(1)))


def test_programs_that_step_worlds_can_be_cached(task, resets):
  """They hold no address: engines of equal settings give equal programs."""
  worlds = resets.qpos.shape[0]
  action = jnp.zeros((worlds, 6)), jnp.zeros(worlds)

  def program(substeps: int) -> str:
    engine = engines.make_physics("native", task.scene, substeps=substeps)
    return jax.jit(engine.step).lower(resets, *action).as_text()

  assert program(30) == program(30)
  assert program(30) != program(15)
