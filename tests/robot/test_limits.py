"""The limits hold for every policy and every arm."""

from __future__ import annotations

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.limits import BRAKING, MARGIN, TIMESTEP, Limits, MotionLimiter

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
    (NEUTRAL * np.nan, "joint 1, 2, 3, 4, 5, 6 is outside its range"),
  ],
)
def test_a_start_outside_is_refused(start, reason):
  assert reason in MotionLimiter(limits(), MODEL.tool_position).start(start)


def test_a_tool_outside_of_its_box_is_refused():
  limiter = MotionLimiter(limits(1.0), MODEL.tool_position)
  assert "outside the workspace box" in limiter.start(NEUTRAL + 0.8 * np.eye(6)[0])


def pose_at(tool: np.ndarray) -> np.ndarray:
  """Returns joint angles near the neutral pose with the tool at a place, m."""
  pose = NEUTRAL.copy()
  for _ in range(20):
    jacobian = MODEL.dynamics(pose, np.zeros(6)).tool[:3]
    pose = pose + np.linalg.pinv(jacobian) @ (tool - MODEL.tool_position(pose))
  np.testing.assert_allclose(MODEL.tool_position(pose), tool, atol=1e-9)
  return pose


FACES = [(axis, side) for axis in range(3) for side in range(2)]


def at_face(axis: int, side: int, depth: float) -> np.ndarray:
  """Returns a pose with the tool inside of a face of the box by ``depth`` m."""
  tool = BOX.mean(axis=1)
  tool[axis] = BOX[axis, side] + (depth if side == 0 else -depth)
  return pose_at(tool)


@pytest.mark.parametrize(("axis", "side"), FACES)
@pytest.mark.parametrize("depth", [-0.0019, 0.0, 0.0019])
def test_from_the_border_of_the_box_the_arm_moves_only_inwards(axis, side, depth):
  """As after a stop there, where the arm itself rests beyond its command."""
  start = at_face(axis, side, depth)
  limiter = MotionLimiter(limits(2.0), MODEL.tool_position)
  assert limiter.start(start) == ""
  inwards = BOX.mean(axis=1) - MODEL.tool_position(start)
  way = np.linalg.pinv(MODEL.dynamics(start, np.zeros(6)).tool[:3]) @ inwards
  rng = np.random.default_rng(0)
  for _ in range(300):  # Whatever is proposed first.
    limiter.step(rng.choice([-1, 1]) * way + rng.normal(size=6), limiter.position)
    tool = MODEL.tool_position(limiter.position)
    beyond = (BOX[axis, side] - tool[axis]) * (1 if side == 0 else -1)
    assert beyond <= -depth + 2e-4
  while not limiter.at_rest:
    limiter.brake(limiter.position)
  outwards = MotionLimiter(limits(2.0), MODEL.tool_position)
  for again, velocity in ((limiter, way), (outwards, -way)):
    if again is outwards:
      assert outwards.start(start) == ""
    for _ in range(150):
      again.step(0.3 * velocity / np.abs(velocity).max(), again.position)
  inside = MODEL.tool_position(limiter.position)
  assert (inside > BOX[:, 0] + MARGIN).all() and (inside < BOX[:, 1] - MARGIN).all()
  np.testing.assert_allclose(outwards.position, start, atol=2e-4)


@pytest.mark.parametrize(("axis", "side"), FACES)
def test_a_start_further_outside_is_refused(axis, side):
  limiter = MotionLimiter(limits(2.0), MODEL.tool_position)
  refused = limiter.start(at_face(axis, side, -0.0021))
  assert "outside the workspace box" in refused


@pytest.mark.parametrize("sign", [-1, 1])
def test_from_beyond_a_joint_range_the_joint_moves_only_back(sign):
  """As after a stop at its end, with the error of the arm."""
  given = Limits(box=np.array([[-2.0, 2.0]] * 3), joints=limits().joints)
  end = given.joints[3, 0 if sign < 0 else 1]
  start = NEUTRAL.copy()
  start[3] = end + sign * 0.002
  limiter = MotionLimiter(given, MODEL.tool_position)
  assert limiter.start(start) == ""
  for _ in range(100):
    limiter.step(sign * np.eye(6)[3], limiter.position)
  np.testing.assert_array_equal(limiter.position, start)
  for _ in range(100):
    limiter.step(-sign * np.eye(6)[3], limiter.position)
  assert sign * (end - limiter.position[3]) > 0.01


def test_the_arm_starts_again_where_it_has_come_to_rest():
  """Wherever the limits have stopped it, with an error of 1 mrad."""
  rng, given = np.random.default_rng(0), limits(2.0)
  for _ in range(8):
    limiter = started(given)
    velocity = rng.choice([-1.0, 1.0], 6)
    for _ in range(1000):
      limiter.step(velocity, limiter.position)
    error = 1e-3 * rng.uniform(-1, 1, 6)
    assert (
      MotionLimiter(given, MODEL.tool_position).start(limiter.position + error) == ""
    )


def test_an_arm_that_something_pushes_out_of_the_box_may_come_back():
  limiter, start = MotionLimiter(limits(2.0), MODEL.tool_position), at_face(0, 1, 0.003)
  assert limiter.start(start) == ""
  way = np.linalg.pinv(MODEL.dynamics(start, np.zeros(6)).tool[:3])[:, 0]  # rad per m
  out = (limiter.limits.deviation + 0.03) * way / np.abs(way).max()
  for part in np.linspace(0, 1, 200):
    limiter.step(np.zeros(6), start + part * out)
  assert MODEL.tool_position(limiter.position)[0] > BOX[0, 1] + 1e-3
  pushed = limiter.position
  for velocity, inwards in ((way, False), (-way, True)):
    for _ in range(100):
      limiter.step(0.2 * velocity / np.abs(way).max(), limiter.position)
    assert ((pushed - limiter.position) @ way > 0.01 * np.linalg.norm(way)) == inwards
  assert MODEL.tool_position(limiter.position)[0] < BOX[0, 1]


def test_a_way_is_looked_at_before_it_begins():
  """Turning the shoulder takes the tool on an arc, which leaves the box in between."""
  left, right = NEUTRAL + 0.25 * np.eye(6)[0], NEUTRAL - 0.25 * np.eye(6)[0]
  ends = [MODEL.tool_position(pose) for pose in (left, right)]
  reach = max(end[0] for end in ends) + 0.005
  wide = np.array([[-2.0, reach], [-2.0, 2.0], [-2.0, 2.0]])
  limiter = MotionLimiter(Limits(box=wide, joints=limits().joints), MODEL.tool_position)
  assert limiter.start(left) == ""
  found = limiter.obstruction(right)
  assert (
    "on the straight way the tool at (" in found and "outside the workspace" in found
  )
  assert limiter.obstruction(left) == ""
  wide[0, 1] = 2.0
  limiter = MotionLimiter(Limits(box=wide, joints=limits().joints), MODEL.tool_position)
  assert limiter.start(left) == "" and limiter.obstruction(right) == ""
  beyond = NEUTRAL + 0.5 * np.eye(6)[2]
  assert limiter.obstruction(beyond) == (
    "at the end of the way joint 3 is outside its range"
  )
