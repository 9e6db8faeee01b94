"""Faults bring a lagging arm to rest in half a second, and contacts stay stable."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from rigs import NEUTRAL

from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.core import HOME_SPEED, Command, Core
from apnpql_jax.robot.limits import BRAKING, TIMESTEP, Limits, MotionLimiter
from apnpql_jax.robot.protocols import ArmState, GripperState
from apnpql_jax.robot.supervisor import JAM_S, Action, Mode
from apnpql_jax.robot.virtual_arm import LEAD, Admittance, VirtualArm

MODEL = ArmModel()
LIMITS = Limits(
  box=np.array([[0.2, 0.8], [-0.5, 0.5], [0.0, 0.6]]),
  joints=np.array([[-6.2, 6.2]] * 6),
)
PERIOD = 75  # cycles
REST = 1e-3  # rad/s


@dataclasses.dataclass
class World:
  """A lagging arm, the core, and a policy that acts every period; time in cycles."""

  lag: float = 0.03
  admittance: Admittance | None = Admittance()
  limits: Limits = LIMITS
  cycle: int = 0

  def __post_init__(self):
    self.core = Core(self.limits, model=MODEL, admittance=self.admittance)
    self.arm, self.speed, self.wrench = NEUTRAL.copy(), np.zeros(6), np.zeros(6)
    self.action: Action | None = None
    self.measured_at: float | None = None
    self.gripper_at: float | None = None
    self.fault = ""
    self.core.start(0.0, self.state())

  @property
  def now(self) -> float:
    return 100 + self.cycle * TIMESTEP

  def state(self, fault: str = "") -> ArmState:
    time = self.now if self.measured_at is None else self.measured_at
    return ArmState(time, self.arm.copy(), self.speed, self.wrench, fault or self.fault)

  def act(self, values: np.ndarray, frame_age: float = 0.03) -> None:
    number = self.action.number + 1 if self.action else 1
    frames = np.array([self.now - 0.03, self.now - frame_age])
    self.action = Action(number, self.now, np.asarray(values, float), frames)

  def step(self, fault: str = "") -> Command:
    gripper = GripperState(self.gripper_at or self.now, 0.0)
    self.core.supervisor.check_gripper(self.now, gripper)
    return self.follow(self.core.step(self.now, self.state(fault), self.action))

  def move(self, target: np.ndarray) -> Command:
    return self.follow(self.core.move(self.now, self.state(), target))

  def follow(self, command: Command) -> Command:
    before = self.arm
    self.arm = before + (TIMESTEP / self.lag) * (command.position - before)
    self.speed = (self.arm - before) / TIMESTEP
    self.cycle += 1
    return command

  def play(self, policy: Callable[[int], np.ndarray], cycles: int) -> list[Command]:
    commands = []
    for cycle in range(cycles):
      if cycle % PERIOD == 0:
        self.act(policy(cycle // PERIOD))
      commands.append(self.step())
    return commands


FAST = np.array([1.0, 0.3, -0.3, 0.2, 0.2, 1.0, 0.0])


def moving(admittance: Admittance | None = Admittance()) -> World:  # noqa: B008
  """Returns a world whose arm moves at nearly 1 rad/s, just after an action."""
  world = World(admittance=admittance)
  world.core.start(world.now, world.state())
  world.play(lambda _: FAST, 7 * PERIOD)
  world.act(FAST)
  assert world.step().mode is Mode.FOLLOW
  assert world.speed.max() > 0.95
  return world


def nan_action(world: World) -> None:
  world.act(FAST * np.nan)


def stale_frame(world: World) -> None:
  world.act(FAST, frame_age=0.101)


def frame_never_seen(world: World) -> None:
  world.act(FAST, frame_age=np.nan)


def stale_joints(world: World) -> None:
  world.measured_at = world.now - 0.021


def nan_joints(world: World) -> None:
  world.arm = world.arm * np.nan


def nan_wrench(world: World) -> None:
  world.wrench = np.full(6, np.nan)


def push(force: float) -> Callable[[World], None]:
  def cause(world: World) -> None:
    world.wrench = np.array([0, force, 0, 0, 0, 0.0])

  return cause


def silent_policy(world: World) -> None:
  world.cycle += 2 * PERIOD  # The arm coasts meanwhile, in this world without time.


def silent_gripper(world: World) -> None:
  world.gripper_at = world.now - 0.301


def dropped_arm(world: World) -> None:
  """Keeps the last measurement; the driver says why a while later."""
  world.measured_at = world.now - 0.2
  world.fault = LOST


def killed_policy(world: World) -> None:
  world.core.supervisor.stop("policy: its process has ended")


LOST = "lost the connection to the controller: check network and power"
PUSH = push(31)
FAULTS = {
  "policy: the action is not finite": (nan_action, Mode.HOLD),
  "camera wrist: frame is 101 ms old": (stale_frame, Mode.HOLD),
  "camera wrist: frame is nan ms old": (frame_never_seen, Mode.HOLD),
  "joints: measurement is 21 ms old": (stale_joints, Mode.STOP),
  "arm: a measurement is not finite": (nan_joints, Mode.STOP),
  "arm: a measurement is not finite ": (nan_wrench, Mode.STOP),
  "force: above 30 N on the tool": (PUSH, Mode.HOLD),
  "force: 51 N on the tool": (push(-51), Mode.STOP),
  "policy: a period late": (silent_policy, Mode.HOLD),
  "gripper: measurement is 301 ms old": (silent_gripper, Mode.STOP),
  f"arm: {LOST}": (dropped_arm, Mode.STOP),
  "policy: its process has ended": (killed_policy, Mode.STOP),
}


@pytest.mark.parametrize("reason", FAULTS)
def test_at_rest_within_half_a_second_of_a_fault_with_its_reason(reason):
  cause, mode = FAULTS[reason]
  # A hold because of a force gives way to it with admittance, see below.
  world = moving(None if cause is PUSH else Admittance())
  cause(world)
  first = world.step()
  assert first.mode == mode and first.reason == reason.strip()
  for _ in range(round(0.5 / TIMESTEP) - 1):
    last = world.step()
    assert np.isfinite(last.position).all()
  assert last.at_rest
  if np.isfinite(world.arm).all():
    assert np.abs(world.speed).max() < REST


def test_a_lost_measurement_does_not_stop_the_command_abruptly():
  world = moving()
  speeds, frozen = [world.core.limiter.velocity], world.arm.copy()
  while not world.core.limiter.at_rest:
    state = ArmState(world.now - 0.03, frozen, np.zeros(6), np.zeros(6))
    world.core.step(world.now, state, world.action)
    speeds.append(world.core.limiter.velocity)
    world.cycle += 1
  changes = np.abs(np.diff(speeds, axis=0)).max()
  assert changes <= BRAKING * TIMESTEP + 1e-9


def test_a_blocked_arm_ends_the_command_near_it():
  world = moving()
  push(60)(world)
  blocked = world.arm.copy()
  for _ in range(250):
    world.arm = blocked
    command = world.core.step(world.now, world.state(), world.action)
    assert np.abs(command.position - blocked).max() <= LIMITS.deviation + 1e-9
    world.cycle += 1
  assert command.at_rest


def test_a_new_episode_begins_where_the_arm_is():
  """As after a pause in which the arm was moved by hand."""
  world = moving()
  world.core.supervisor.stop("enough")
  for _ in range(250):
    world.step()
  world.arm = NEUTRAL + 0.3
  world.core.start(world.now, world.state())
  world.action = None
  world.act(np.zeros(7))
  for _ in range(10):
    np.testing.assert_allclose(world.step().position, NEUTRAL + 0.3, atol=1e-9)


def test_a_protective_stop_of_the_arm_stops():
  world = moving()
  command = world.step(fault="protective stop")
  assert (command.mode, command.reason) == (Mode.STOP, "arm: protective stop")
  assert world.step().mode is Mode.STOP  # It stays.


def test_a_period_late_holds_and_two_stop():
  world = moving()
  modes = {}
  for cycle in range(1, 4 * PERIOD):
    modes[cycle] = world.step()
  held = [c for c, x in modes.items() if x.mode is Mode.HOLD]
  stopped = [c for c, x in modes.items() if x.mode is Mode.STOP]
  assert abs(held[0] - 2 * PERIOD) <= 2 and abs(stopped[0] - 3 * PERIOD) <= 2
  assert modes[stopped[0]].reason == "policy: two periods late"


def test_a_hold_ends_with_its_cause_and_a_stop_does_not():
  world = moving()
  nan_action(world)
  assert world.step().mode is Mode.HOLD
  world.act(FAST)
  assert world.step().mode is Mode.FOLLOW
  stale_joints(world)
  assert world.step().mode is Mode.STOP
  world.measured_at = None
  world.act(FAST)
  assert world.step().mode is Mode.STOP


def test_actions_that_are_never_valid_stop():
  world = moving()
  modes = [x.mode for x in world.play(lambda _: np.full(7, np.inf), 4 * PERIOD)]
  assert modes[0] is Mode.HOLD and modes[-1] is Mode.STOP


def test_a_jam_stops_and_a_hit_only_holds():
  world = moving()
  push(35)(world)
  world.play(lambda _: FAST, 20)
  push(0)(world)
  modes = [x.mode for x in world.play(lambda _: FAST, 150)]
  assert modes[0] is Mode.HOLD and modes[-1] is Mode.FOLLOW
  push(35)(world)
  last = world.play(lambda _: FAST, 600)[-1]
  assert (last.mode, last.reason) == (Mode.STOP, "force: 35 N on the tool for 1 s")


def pressed_on_a_wall(world: World, stiffness: float, speed: float, seconds: float):
  """Moves down onto a wall; returns the force (N) and the command of each cycle."""
  dynamics = MODEL.dynamics(NEUTRAL, np.zeros(6))
  down = np.linalg.solve(dynamics.tool, [0, 0, -speed, 0, 0, 0])
  wall, found = MODEL.tool_position(NEUTRAL)[2] - 0.02, []
  for cycle in range(round(seconds / TIMESTEP)):
    if cycle % PERIOD == 0:
      world.act(np.append(down, 0.0))
    depth = wall - MODEL.tool_position(world.arm)[2]
    world.wrench = np.array([0, 0, max(0.0, stiffness * depth), 0, 0, 0.0])
    found.append((world.wrench[2], world.step()))
  return found


def test_a_hold_because_of_a_force_gives_way_to_it():
  """The force falls below the limit, and the policy has the arm again."""
  found = pressed_on_a_wall(World(), 1e4, 0.1, 2.0)
  modes = [command.mode for _, command in found]
  first = modes.index(Mode.HOLD)
  follows = modes.index(Mode.FOLLOW, first)
  assert (follows - first) * TIMESTEP < 0.4 and Mode.STOP not in modes
  assert min(force for force, _ in found[first:follows]) < 0.5 * LIMITS.hold_force
  assert max(force for force, _ in found[follows:]) < LIMITS.hold_force


def test_a_hold_brakes_once_the_force_is_gone():
  """A hit of 20 ms: the filtered wrench soon is that of a free hand."""
  world = moving()
  push(45)(world)
  for _ in range(10):
    world.step()
  push(0)(world)
  speeds, free = [], []
  while world.step().mode is Mode.HOLD:
    speeds.append(np.abs(world.core.limiter.velocity).max())
    free.append(world.core.virtual.share == 0)
  assert np.flatnonzero(free)[0] * TIMESTEP < 0.05 < 0.15 < len(free) * TIMESTEP
  slowing = -np.diff(speeds)[free[1:]] / TIMESTEP
  np.testing.assert_allclose(slowing, BRAKING, rtol=1e-6)


def test_without_admittance_a_hold_because_of_a_force_stays_pressed_and_stops():
  found = pressed_on_a_wall(World(admittance=None), 5e3, 0.05, 3.0)
  modes = [command.mode for _, command in found]
  first, stop = modes.index(Mode.HOLD), modes.index(Mode.STOP)
  assert set(modes[first:stop]) == {Mode.HOLD}
  assert (stop - first) * TIMESTEP == pytest.approx(JAM_S, abs=0.01)
  assert min(force for force, _ in found[first:]) > LIMITS.hold_force


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("force", [31.0, -45.0])
def test_giving_way_is_slow(axis, force):
  """The tool moves by the felt force over the damping per second, and then stops."""
  world = moving()
  world.wrench = force * np.eye(6)[axis]
  most = abs(force) / Admittance().damping
  for cycle in range(1, round((JAM_S + 0.3) / TIMESTEP)):
    command = world.step()
    if cycle % PERIOD == 0:
      world.act(FAST)
    limiter, time = world.core.limiter, cycle * TIMESTEP
    jacobian = MODEL.dynamics(limiter.position, np.zeros(6)).tool[:3]
    if time > 0.3:  # It brakes first.
      assert np.linalg.norm(jacobian @ limiter.velocity) < most
      if time < JAM_S - 0.01:
        assert command.mode is Mode.HOLD
  assert command.mode is Mode.STOP and command.at_rest


def test_no_first_action_holds_then_stops():
  world = World()
  world.core.start(world.now, world.state())
  assert world.step().reason == "policy: no action yet"
  world.cycle += round(5.1 / TIMESTEP)
  assert world.step().reason == "policy: no action within 5 s"


def test_an_arm_that_runs_away_stops():
  world = moving()
  world.arm = world.arm + 0.1
  command = world.step()
  assert command.mode is Mode.STOP and "rad from its command" in command.reason


TIGHT = dataclasses.replace(
  LIMITS,
  box=np.array([[0.35, 0.5], [-0.1, 0.1], [0.2, 0.3]]),
  joints=np.stack([NEUTRAL - 0.3, NEUTRAL + 0.3], axis=1),
)
WIDE = dataclasses.replace(LIMITS, box=np.array([[-2.0, 2.0]] * 3))
WILD = {"tight": TIGHT, "wide": WIDE}


class Anything:
  """A policy and contacts of any kind, from a seed."""

  def __init__(self, seed: int):
    self._rng = np.random.default_rng(seed)
    self._way, self._wrench = np.zeros(6), np.zeros(6)

  def action(self) -> np.ndarray:
    """Returns an action f64[7]; it often keeps its direction."""
    rng = self._rng
    if rng.random() < 0.1:
      self._way = rng.choice([-1, 1], 6) * rng.choice([0.3, 1.0], 6)
    scale = rng.choice([1.0, 1e3, np.nan, np.inf], p=[0.9, 0.06, 0.02, 0.02])
    return np.append(self._way * scale, rng.integers(2))

  def wrench(self) -> np.ndarray:
    """Returns a wrench f64[6] that need not fit the motion."""
    rng = self._rng
    if rng.random() < 0.005:
      size = rng.choice([0.0, 7.0, 20.0, 40.0, 60.0], p=[0.7, 0.1, 0.1, 0.07, 0.03])
      way = rng.normal(size=6) * np.repeat([1.0, 0.1], 3)
      self._wrench = size * way / np.linalg.norm(way[:3])
    return self._wrench + np.repeat([0.5, 0.05], 3) * rng.normal(size=6)


@pytest.mark.parametrize("name", WILD)
def test_commands_keep_the_limits_for_every_policy_and_contact(name):
  """They use them up, too: each limit, hold and stop occurs."""
  limits, used, reasons = WILD[name], {}, set()

  @settings(max_examples=8, deadline=None, derandomize=True)
  @given(seed=st.integers(0, 2**32 - 1), lag=st.sampled_from([0.002, 0.03, 0.08]))
  def check(seed: int, lag: float) -> None:
    anything, world = Anything(seed), World(lag, limits=limits)
    world.core.start(world.now, world.state())
    stopped = 0
    for cycle in range(16 * PERIOD):
      if cycle % PERIOD == 0:
        world.act(anything.action())
      world.wrench = anything.wrench()
      limiter, arm = world.core.limiter, world.arm
      before, speed = limiter.position, limiter.velocity
      command = world.step()
      reasons.add(f"{command.mode.name} {command.reason.partition(':')[0]}")
      note(used, limiter, before, speed, arm)
      stopped = stopped + 1 if command.mode is Mode.STOP else 0
      assert command.at_rest or stopped * TIMESTEP < 0.25
      if stopped * TIMESTEP > 0.5:
        assert np.abs(world.speed).max() < REST or lag > 0.03
        world.core.start(world.now, world.state())

  check()
  print(name, used, reasons)
  assert used["acceleration"] > 0.999
  if name == "wide":
    assert min(used["velocity"], used["gap"]) > 0.99
  else:
    assert min(used["joint"], used["box"]) > 0.95
  assert {"FOLLOW ", "HOLD force", "HOLD policy", "STOP force"} <= reasons


def note(
  used: dict[str, float],
  limiter: MotionLimiter,
  before: np.ndarray,
  speed: np.ndarray,
  arm: np.ndarray,
) -> None:
  """Checks the command of a cycle, and keeps how much of each limit it has used."""
  limits, after = limiter.limits, limiter.position
  gap = np.abs(after - arm).max() / limits.deviation
  shares = {
    "velocity": np.abs(after - before).max() / TIMESTEP / limits.velocity,
    "gap": gap,
    "joint": share(after, limits.joints),
    "box": share(MODEL.tool_position(after), limits.box),
  }
  if gap < 0.999:  # Else it may follow the arm.
    change = np.abs(limiter.velocity - speed).max() / TIMESTEP
    shares["acceleration"] = change / limits.braking
  for name, value in shares.items():
    assert value <= 1 + 1e-6, (name, value)
    used[name] = max(used.get(name, 0.0), value)


def share(values: np.ndarray, ranges: np.ndarray) -> float:
  """Returns the part of the way to the end of a range that the values have gone."""
  low, high = ranges.T
  return float((np.abs(2 * values - low - high) / (high - low)).max())


@pytest.mark.parametrize("speed", [0.2, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_way_home_is_a_straight_line_of_joints(seed, speed):
  """Also through a hold, which ends where the arm has come to rest."""
  rng = np.random.default_rng(seed)
  world = World(limits=dataclasses.replace(LIMITS, velocity=speed))
  world.arm = start = NEUTRAL + np.append(rng.uniform(-0.2, 0.2, 5), 0.4)
  world.core.start(world.now, world.state(), NEUTRAL)
  along, speeds, modes = (NEUTRAL - start) / np.linalg.norm(NEUTRAL - start), [], []
  while not world.core.has_arrived(NEUTRAL):
    push(35.0 if 400 <= world.cycle < 500 else 0.0)(world)
    command = world.move(NEUTRAL)
    modes.append(command.mode)
    speeds.append(world.core.limiter.velocity)
    away = command.position - start
    assert np.abs(away - (away @ along) * along).max() < 1e-9
    assert world.cycle < 3000
  assert Mode.HOLD in modes and Mode.STOP not in modes
  assert np.abs(speeds).max() == pytest.approx(min(HOME_SPEED, speed), rel=0.1)
  changes = np.abs(np.diff(speeds, axis=0)).max(axis=1) / TIMESTEP
  assert (changes <= LIMITS.braking + 1e-6).all()
  follows = [x is y is Mode.FOLLOW for x, y in zip(modes, modes[1:], strict=False)]
  # At last it brakes from 0.01 rad/s.
  assert changes[:-3][follows[:-3]].max() <= LIMITS.acceleration + 1e-6


def test_no_way_home_begins_that_leaves_the_box():
  """The arm would stop halfway."""
  world = World()
  over = (
    NEUTRAL + 2 * np.pi * np.eye(6)[0]
  )  # The same place, a turn of the shoulder away.
  world.core.start(world.now, world.state(), over)
  command = world.move(over)
  assert command.mode is Mode.STOP and command.at_rest
  assert "outside the workspace box" in command.reason
  np.testing.assert_array_equal(command.position, NEUTRAL)


def test_free_motion_through_the_limits_is_that_of_the_virtual_arm():
  """It is later by the lead, with which training exceeds its limit of acceleration."""
  rng = np.random.default_rng(1)
  actions = 0.5 * rng.uniform(-1, 1, (20, 7))
  world, alone = World(lag=0.01), VirtualArm(MODEL)
  world.core.start(world.now, world.state())
  alone.reset(NEUTRAL)
  for action in actions:
    world.act(action)
    for _ in range(PERIOD):
      world.step()
      alone.step(action[:6])
    delayed = alone.position - LEAD * alone.velocity
    np.testing.assert_allclose(world.core.limiter.position, delayed, atol=1e-4)
    np.testing.assert_allclose(world.core.limiter.velocity, alone.velocity, atol=1e-4)
