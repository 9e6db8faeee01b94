"""The limits hold for every policy and every arm."""

from __future__ import annotations

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.limits import BRAKING, TIMESTEP, Limits, MotionLimiter

NEUTRAL = np.array([-1.8957, -1.7712, 1.9888, -1.7884, -1.5708, -0.3249])
MODEL = ArmModel()
BOX = np.array([[0.35, 0.5], [-0.1, 0.1], [0.2, 0.3]])
TINY = 1e-9

seeds = st.integers(0, 2**32 - 1)


def limits(width: float = 0.4) -> Limits:
  joints = np.stack([NEUTRAL - width, NEUTRAL + width], axis=1)
  return Limits(box=BOX, joints=joints)


def started(given: Limits) -> MotionLimiter:
  limiter = MotionLimiter(given, MODEL.tool_position)
  assert limiter.start(NEUTRAL) == ""
  return limiter


def proposals(seed: int, count: int) -> np.ndarray:
  """Returns velocities f64[count, 6] that change at random, up to infinity and NaN."""
  rng = np.random.default_rng(seed)
  scale = rng.choice([0.1, 1.0, 100.0, np.inf], p=[0.3, 0.5, 0.19, 0.01], size=count)
  with np.errstate(invalid="ignore"):
    drawn = rng.uniform(-1, 1, (count, 6)) * scale[:, None]
  return np.repeat(drawn, rng.integers(1, 300), axis=0)[:count]


@settings(max_examples=30, deadline=None)
@given(seed=seeds, yielding=st.booleans())
def test_a_perfect_arm_keeps_all_limits(seed, yielding):
  limiter = started(limits())
  position, velocity = limiter.position, limiter.velocity
  most = limiter.limits.braking if yielding else limiter.limits.acceleration
  for proposed in proposals(seed, 1500):
    after = limiter.step(proposed, position, yielding=yielding)
    speed = (after - position) / TIMESTEP
    change = np.abs(speed - velocity).max() / TIMESTEP
    assert np.abs(speed).max() <= 1 + TINY
    assert change <= (most if np.isfinite(proposed).all() else BRAKING) + 1e-6
    assert (after >= limiter.limits.joints[:, 0] - TINY).all()
    assert (after <= limiter.limits.joints[:, 1] + TINY).all()
    tool = MODEL.tool_position(after)
    assert (tool >= BOX[:, 0]).all() and (tool <= BOX[:, 1]).all()
    position, velocity = after, speed


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_the_command_stays_near_an_arm_that_moves_as_it_likes(seed):
  """The arm may stall or wander at up to the speed limit."""
  limiter, rng = started(limits()), np.random.default_rng(seed)
  arm, before = NEUTRAL.copy(), NEUTRAL.copy()
  for proposed in proposals(seed, 1500):
    if rng.random() < 0.01:
      wander = rng.uniform(-1, 1, 6) * rng.integers(0, 2)
      arm = arm + TIMESTEP * wander
    after = limiter.step(proposed, arm)
    assert np.abs(after - before).max() <= TIMESTEP + TINY
    if np.isfinite(proposed).all():  # Else it brakes, and follows nothing.
      assert np.abs(after - arm).max() <= limiter.limits.deviation + TINY
    before = after


@settings(max_examples=20, deadline=None)
@given(seed=seeds, moment=st.integers(1, 1400))
def test_braking_ends_within_a_quarter_of_a_second_inside_the_boxes(seed, moment):
  limiter = started(limits())
  for proposed in proposals(seed, moment):
    limiter.step(proposed, limiter.position)
  cycles = 0
  while not limiter.at_rest:
    limiter.brake(limiter.position)
    cycles += 1
    tool = MODEL.tool_position(limiter.position)
    assert (tool >= BOX[:, 0]).all() and (tool <= BOX[:, 1]).all()
  assert cycles * TIMESTEP <= 1.0 / BRAKING + TIMESTEP


@pytest.mark.parametrize("away", [-1.0, 1.0])
def test_braking_does_not_follow_an_arm_that_runs_away(away):
  limiter = started(limits())
  for _ in range(100):
    limiter.step(0.3 * np.ones(6), limiter.position)
  arm, before, cycles = NEUTRAL.copy(), np.abs(limiter.velocity), 0
  assert before.max() > 0.1
  while not limiter.at_rest:
    arm = arm + TIMESTEP * away
    limiter.brake(arm)
    assert (np.abs(limiter.velocity) <= before + TINY).all()
    before, cycles = np.abs(limiter.velocity), cycles + 1
  assert cycles * TIMESTEP <= 1.0 / BRAKING + TIMESTEP


def test_limits_do_not_slow_what_they_allow():
  limiter = MotionLimiter(
    Limits(box=np.array([[-2.0, 2.0]] * 3), joints=np.array([[-7.0, 7.0]] * 6)),
    MODEL.tool_position,
  )
  limiter.start(NEUTRAL)
  ramp = np.minimum(1.2 * TIMESTEP * np.arange(1, 501), 1.0)
  for speed in ramp:
    limiter.step(speed * np.ones(6), limiter.position)
  moved = limiter.position - NEUTRAL
  np.testing.assert_allclose(moved, TIMESTEP * ramp.sum(), atol=1e-9)


@pytest.mark.parametrize(
  ("start", "reason"),
  [
    (NEUTRAL + 0.5 * np.eye(6)[2], "joint 3 is outside its range"),
    (NEUTRAL * np.nan, "is outside its range"),
  ],
)
def test_a_start_outside_is_refused(start, reason):
  assert reason in MotionLimiter(limits(), MODEL.tool_position).start(start)


def test_a_tool_outside_of_its_box_is_refused():
  limiter = MotionLimiter(limits(1.0), MODEL.tool_position)
  assert "outside the workspace box" in limiter.start(NEUTRAL + 0.8 * np.eye(6)[0])
