"""The registry of tasks, and the protocol that they must follow."""

from __future__ import annotations

from collections.abc import Callable
import sys
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.errors import ConfigError
from apnpql_jax.tasks import make_task, task
from apnpql_jax.tasks.push_plate import PushPlate
from apnpql_jax.tasks.task import register_task


def test_a_name_belongs_to_one_class():
  """Only a reload, the same class by module and qualified name, may replace it."""
  other = type("Other", (PushPlate,), {})
  with pytest.raises(
    ConfigError, match=r"'push_plate' .*Other is taken by .*PushPlate"
  ):
    register_task(other)
  assert type(make_task("push_plate")) is PushPlate
  reloaded = type("PushPlate", (PushPlate,), {"__module__": PushPlate.__module__})
  try:
    register_task(reloaded)
    assert type(make_task("push_plate")) is reloaded
  finally:
    register_task(PushPlate)


def _draw(**changes: Callable[[np.ndarray], Any]) -> Callable[..., Any]:
  """Returns ``sample_resets`` of push_plate with changed arrays."""

  def sample_resets(self: PushPlate, rng: np.random.Generator, count: int) -> Any:
    draw = PushPlate.sample_resets(self, rng, count)
    return draw._replace(**{k: f(getattr(draw, k)) for k, f in changes.items()})

  return sample_resets


def _fails(*_: Any) -> Any:
  raise KeyError("cup")


WRONG: list[tuple[str, Any, str]] = [
  (
    "expert",
    lambda s, *x: PushPlate.expert(s, *x)[:, :6],
    r"float[5, 6] .* float[5, 7]",
  ),
  ("expert", lambda *_: None, "returns NoneType .* not float[5, 7]"),
  ("expert", _fails, "fails with KeyError: 'cup'"),
  ("success", lambda s, *x: PushPlate.success(s, *x).any(), "bool[] .* not bool[5]"),
  ("success", lambda s, *x: 1.0 * PushPlate.success(s, *x), "float[5] .* not bool[5]"),
  (
    "objects",
    lambda s, x: PushPlate.objects(s, x)[:, :5],
    "float[5, 5] .* float[5, 3]",
  ),
  ("objects", lambda s, x: PushPlate.objects(s, x)[0], "float[6] .* not float[5, 3]"),
  (
    "tool_targets",
    lambda s, *x: PushPlate.tool_targets(s, *x)[:2],
    "returns (float[5, 3, 3], float[5, 3, 3, 3]) .* not (.*, float[5, 3])",
  ),
  (
    "tool_targets",
    lambda s, *x: (*PushPlate.tool_targets(s, *x)[:2], jnp.ones((3, 5))),
    "float[3, 5]) .* float[5, 3])",
  ),
  (
    "sample_resets",
    lambda s, *x: tuple(PushPlate.sample_resets(s, *x)),
    "returns tuple, not ResetDraw",
  ),
  ("sample_resets", _draw(qpos=lambda x: x[:, :10]), "(float[5, 10], .* (float[5, 17]"),
  ("sample_resets", _draw(variant=lambda x: x * 1.0), "float[5]) .* int[5])"),
  ("sample_resets", _draw(variant=lambda x: x + 1), "variant that is not from 0 to 0"),
  (
    "sample_resets",
    _draw(mocap_quat=lambda x: 0 * x),
    "quaternion .* not of unit length",
  ),
  ("sample_resets", _draw(mocap_pos=lambda x: x * np.nan), "value that is not finite"),
]


@pytest.mark.parametrize(
  ("method", "body", "message"), WRONG, ids=[f"{x[0]} {i}" for i, x in enumerate(WRONG)]
)
def test_a_method_that_breaks_the_protocol_is_named_in_one_line(
  method, body, message, monkeypatch
):
  def init(self: PushPlate) -> None:
    self.name = "push_plate"  # That of its scene.
    PushPlate.__init__(self)
    self.name = "wrong"

  members = {"name": "wrong", "__init__": init, method: body}
  wrong: Any = type("Wrong", (PushPlate,), members)
  monkeypatch.setattr(task, "_REGISTRY", dict(task._REGISTRY))
  register_task(wrong)
  message = message.replace("[", r"\[").replace("(", r"\(").replace(")", r"\)")
  with pytest.raises(ConfigError, match=f"task 'wrong'.*{method}.*{message}") as error:
    make_task("wrong")
  assert "\n" not in str(error.value)


def test_a_task_that_cannot_be_built_is_named_in_one_line(monkeypatch):
  monkeypatch.setattr(task, "_REGISTRY", dict(task._REGISTRY))
  wrong: Any = type("Wrong", (PushPlate,), {"name": "wrong", "__init__": _fails})
  register_task(wrong)
  with pytest.raises(ConfigError, match="task 'wrong': __init__ fails with KeyError"):
    make_task("wrong")


def test_a_task_that_is_not_in_a_file_is_refused_with_a_cure(monkeypatch):
  """As in a notebook, whose ``__main__`` has no file."""
  monkeypatch.setattr(task, "_REGISTRY", dict(task._REGISTRY))
  monkeypatch.delattr(sys.modules["__main__"], "__file__", raising=False)
  typed: Any = type("Typed", (PushPlate,), {"name": "typed", "__module__": "__main__"})
  register_task(typed)
  with pytest.raises(ConfigError, match="'typed' is not in a file.* load_preset"):
    make_task("typed")
