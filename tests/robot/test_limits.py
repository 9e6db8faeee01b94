"""The limits hold for every policy and every arm."""

from __future__ import annotations

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from rigs import NEUTRAL

from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.limits import BRAKING, MARGIN, TIMESTEP, Limits, MotionLimiter

MODEL = ArmModel()
BOX = np.array([[0.35, 0.5], [-0.1, 0.1], [0.2, 0.3]])
TINY = 1e-9

seeds = st.integers(0, 2**32 - 1)
EVERYWHERE = np.array([[-2.0, 2.0]] * 3)


def limits(width: float = 0.4, box: np.ndarray = BOX) -> Limits:
  joints = np.stack([NEUTRAL - width, NEUTRAL + width], axis=1)
  return Limits(box=box, joints=joints)


NARROW = {
  "joints": limits(0.15, EVERYWHERE),
  "box": limits(2.0),
  "both": limits(0.2),
  "none": limits(4.0, EVERYWHERE),
}
"""Limits that a policy meets soon; those of velocity and acceleration are the same."""


def started(given: Limits) -> MotionLimiter:
  limiter = MotionLimiter(given, MODEL.tool_position)
  assert limiter.start(NEUTRAL) == ""
  return limiter


def proposals(seed: int, count: int) -> np.ndarray:
  """Returns velocities f64[count, 6] of a policy that keeps a direction for a while.

  Any direction, straight to a face of the box, or of all joints at once; from slow to
  far beyond the limit.
  """
  rng, parts = np.random.default_rng(seed), []
  tool = np.linalg.pinv(MODEL.dynamics(NEUTRAL, np.zeros(6)).tool[:3])
  while sum(map(len, parts)) < count:
    ways = rng.normal(size=6), rng.choice([-1, 1], 6), tool[:, rng.integers(3)]
    way = ways[rng.integers(3)] * rng.choice([-1, 1])
    speed = rng.choice([0.1, 1.0, 100.0, 1e9], p=[0.1, 0.5, 0.2, 0.2])
    parts.append([speed * way / np.abs(way).max()] * rng.integers(5, 800))
  return np.concatenate(parts)[:count]


class Watch:
  """Check of each command of a limiter, with the share of each limit that was used."""

  def __init__(self, limiter: MotionLimiter):
    self.limiter, self.limits = limiter, limiter.limits
    self.used = {"velocity": 0.0, "acceleration": 0.0, "joint": 0.0, "box": 0.0}
    self._before = limiter.position, limiter.velocity

  def check(self, acceleration: float, *, dragged: bool = False) -> None:
    """Checks the newest command against all limits.

    Args:
      acceleration: The limit, rad/s^2.
      dragged: The arm may have taken the command along, which only keeps the velocity.
    """
    position, velocity = self.limiter.position, self.limiter.velocity
    before, speed = self._before
    np.testing.assert_allclose(position - before, TIMESTEP * velocity, atol=TINY)
    used = {"velocity": np.abs(velocity).max() / self.limits.velocity}
    if not dragged:
      used["acceleration"] = np.abs(velocity - speed).max() / TIMESTEP / acceleration
      used["joint"] = _share(position, self.limits.joints)
      used["box"] = _share(MODEL.tool_position(position), self.limits.box)
    for name, share in used.items():
      assert share <= 1 + 1e-6, (name, share)
    merge(self.used, used)
    self._before = position, velocity


def _share(values: np.ndarray, ranges: np.ndarray) -> float:
  """Returns the part of the way to the end of a range that the values have gone."""
  low, high = ranges.T
  return float((np.abs(2 * values - low - high) / (high - low)).max())


def merge(used: dict[str, float], more: dict[str, float]) -> None:
  """Keeps the larger share of each limit."""
  used |= {name: max(share, used.get(name, 0.0)) for name, share in more.items()}


@pytest.mark.parametrize("yielding", [False, True])
@pytest.mark.parametrize("name", NARROW)
def test_a_perfect_arm_uses_and_keeps_all_limits(name, yielding):
  used: dict[str, float] = {}

  @settings(max_examples=6, deadline=None, derandomize=True)
  @given(seed=seeds)
  def check(seed: int) -> None:
    limiter = started(NARROW[name])
    watch, given = Watch(limiter), limiter.limits
    for proposed in proposals(seed, 800):
      limiter.step(proposed, limiter.position, yielding=yielding)
      watch.check(given.braking if yielding else given.acceleration)
    merge(used, watch.used)

  check()
  print(name, used)
  assert used["acceleration"] > 0.999
  assert used["velocity"] > 0.999 or name != "none"
  assert used["joint"] > 0.99 or name != "joints"
  assert used["box"] > 0.95 or name != "box"  # It keeps 2 of 50 mm.


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", NARROW)
def test_what_is_not_finite_brakes(name, bad):
  """In one joint or in more; within the limits, and at 4 rad/s^2."""
  speeds = []
  for seed in range(6):
    rng, limiter = np.random.default_rng(seed), started(NARROW[name])
    for proposed in proposals(seed, 300):
      limiter.step(proposed, limiter.position)
    speeds.append(np.abs(limiter.velocity).max())
    watch, cycles = Watch(limiter), 0
    while not limiter.at_rest:
      proposed = np.where(rng.random(6) < 0.5, bad, 1.0)
      proposed[rng.integers(6)] = bad
      limiter.step(proposed, limiter.position, yielding=bool(seed % 2))
      watch.check(BRAKING)
      cycles += 1
    assert cycles * TIMESTEP <= speeds[-1] / BRAKING + 2 * TIMESTEP
  assert max(speeds) > (0.6 if name == "none" else 0.2)


def wandering(seed: int, count: int) -> np.ndarray:
  """Returns joint velocities f64[count, 6] of an arm that stalls or goes its way."""
  rng, parts = np.random.default_rng(seed), []
  while sum(map(len, parts)) < count:
    way = rng.uniform(-1, 1, 6) * rng.integers(0, 2)
    parts.append([way] * rng.integers(20, 200))
  return np.concatenate(parts)[:count]


def test_the_command_stays_near_an_arm_that_moves_as_it_likes():
  """It is up to the speed limit; then the command is dragged along or held back."""
  gaps, changes = [], []

  @settings(max_examples=15, deadline=None, derandomize=True)
  @given(seed=seeds)
  def check(seed: int) -> None:
    limiter, arm = started(NARROW["none"]), NEUTRAL.copy()
    watch, before = Watch(limiter), limiter.velocity
    for proposed, way in zip(proposals(seed, 800), wandering(seed, 800), strict=True):
      arm = arm + TIMESTEP * way
      limiter.step(proposed, arm)
      watch.check(limiter.limits.acceleration, dragged=True)
      gaps.append(np.abs(limiter.position - arm).max())
      assert gaps[-1] <= limiter.limits.deviation + TINY
      changes.append(np.abs(limiter.velocity - before).max() / TIMESTEP)
      before = limiter.velocity

  check()
  at_limit = np.array(gaps) > NARROW["none"].deviation - 1e-6
  assert 0.05 < at_limit.mean() < 0.95  # Often, but not always.
  assert max(changes) > 2 * NARROW["none"].acceleration


def test_an_arm_that_jumps_is_followed_at_the_speed_limit():
  limiter = started(NARROW["none"])
  watch, rng, used = Watch(limiter), np.random.default_rng(0), []
  for cycle in range(600):
    if cycle % 100 == 0:
      arm = limiter.position + rng.uniform(-0.2, 0.2, 6)
    limiter.step(np.zeros(6), arm)
    watch.check(limiter.limits.acceleration, dragged=True)
    used.append(watch.used["velocity"])
  assert np.abs(limiter.position - arm).max() <= limiter.limits.deviation + TINY
  assert used[0] == pytest.approx(1.0)


@pytest.mark.parametrize("name", NARROW)
def test_braking_ends_within_a_quarter_of_a_second_inside_the_boxes(name):
  used: dict[str, float] = {}
  speeds = []

  @settings(max_examples=8, deadline=None, derandomize=True)
  @given(seed=seeds, moment=st.integers(100, 700))
  def check(seed: int, moment: int) -> None:
    limiter = started(NARROW[name])
    for proposed in proposals(seed, moment):
      limiter.step(proposed, limiter.position)
    speeds.append(np.abs(limiter.velocity).max())
    watch, cycles = Watch(limiter), 0
    while not limiter.at_rest:
      limiter.brake(limiter.position)
      watch.check(BRAKING)
      cycles += 1
    assert cycles * TIMESTEP <= speeds[-1] / BRAKING + 2 * TIMESTEP
    merge(used, watch.used)

  check()
  print(name, max(speeds), used)
  assert max(speeds) > (0.9 if name == "none" else 0.2)
  assert used["acceleration"] > 0.999


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
