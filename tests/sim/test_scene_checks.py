"""Scenes that change the robot, or let an object fall, are refused by name and cure."""

from __future__ import annotations

from pathlib import Path
import re

import mujoco
import pytest

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.errors import ConfigError
from apnpql_jax.sim import scene_checks
from apnpql_jax.sim.scene import Scene, load_scene

INCLUDE = '<include file="arena.xml"/>'


def load(folder: Path, text: str, **robot: str) -> Scene:
  """Loads a scene that is stored next to the robot's files, with changed attributes."""
  for name in ("arena", "robot"):
    content = mjcf_path(name).read_text()
    for attribute, value in robot.items():
      content = re.sub(rf'{attribute}="[^"]*"', f'{attribute}="{value}"', content)
    (folder / f"{name}.xml").write_text(content)
  (folder / "mine.xml").write_text(text)
  return load_scene(folder / "mine.xml")


@pytest.fixture
def text() -> str:
  return mjcf_path("push_plate").read_text()


@pytest.mark.parametrize(
  ("added", "message"),
  [
    (
      '<default><joint frictionloss="5"/></default>',
      "joint 'shoulder_pan' has frictionloss 5, not 0 as in robot.xml; remove",
    ),
    (
      '<compiler angle="degree"/>',
      r"joint 'shoulder_pan' has range -0\.109662, 0\.109662, .* angle=.radian",
    ),
    ('<compiler autolimits="false"/>', "joint .* has limited 0, not 1|autolimits"),
    (
      '<default><motor gear="2"/></default>',
      "actuator 'shoulder_pan' has gear 2, not 1",
    ),
    ('<compiler inertiafromgeom="true"/>', "body 'base' has mass"),
    ('<option gravity="0 0 -1.6"/>', "gravity is 0, 0, -1.6, not 0, 0, -9.81; remove"),
    ('<option><flag gravity="disable"/></option>', "flag gravity is disabled; remove"),
    ('<option><flag contact="disable"/></option>', "flag contact is disabled; remove"),
    (
      '<actuator><motor name="fan" joint="finger_r2"/></actuator>',
      "actuators that are not the robot's: 'fan'; remove them",
    ),
    ("", None),
    ('<option timestep="0.0025"/><default><geom rgba="1 0 0 1"/></default>', None),
    ('<worldbody><camera name="side" pos="0 1 1"/></worldbody>', None),
  ],
)
def test_a_scene_must_not_change_the_robot(tmp_path, text, added, message):
  # What follows the robot does not change the classes that it defines.
  before = "frictionloss" in added
  changed = text.replace(INCLUDE, added + INCLUDE if before else INCLUDE + added)
  if message is None:
    load(tmp_path, changed)
    return
  with pytest.raises(ConfigError, match=f"mine.xml.*({message})") as error:
    load(tmp_path, changed)
  assert "\n" not in str(error.value)


def test_a_robot_of_its_own_must_be_the_same(tmp_path, text):
  load(tmp_path, text)
  with pytest.raises(
    ConfigError, match="'shoulder_pan' has damping 5, not 0 as in rob"
  ):
    load(tmp_path, text, damping="5")
  short = mjcf_path("robot").read_text().replace("attachment_site", "flange")
  (tmp_path / "robot.xml").write_text(short)
  with pytest.raises(ConfigError, match="lacks the robot's site 'attachment_site'"):
    load_scene(tmp_path / "mine.xml")


@pytest.mark.parametrize(
  ("qpos", "message"),
  [
    ("-9 -1.7712", "'neutral' has 2 values of qpos, not 17: the arm"),
    ("", "'neutral' has 0 values of qpos"),
    ("1 -1.7712 4.2 -1.7884 -1.5708 -0.3249 0 0 0 0 0.5 0 0 1 0 0 0", "'elbow' at 4.2"),
    ("0 0 0 0 0 0 0 0 0 1.2 0.5 0 0 1 0 0 0", "'finger_l2' at 1.2, outside of .* 1.1"),
  ],
)
def test_a_keyframe_must_be_complete_and_within_the_limits(
  tmp_path, text, qpos, message
):
  changed = re.sub(r'qpos="[^"]*"', f'qpos="{qpos}"', text)
  with pytest.raises(ConfigError, match=f"keyframe .*{message}"):
    load(tmp_path, changed)


def test_the_range_of_a_ball_joint_is_an_angle(tmp_path):
  """Which is no number of qpos: w is 1 at rest."""
  lamp = """<worldbody><body><joint type="ball" range="0 0.5"/><geom size="0.1"/></body>
    </worldbody><keyframe><key qpos="0 0 0 0 0 0 0 0 0 0 1 0 0 0"/></keyframe>"""
  load(tmp_path, f"<mujoco>{INCLUDE}{lamp}</mujoco>")


def becomes_a_cylinder(spec: mujoco.MjSpec) -> None:
  spec.geom("yellow").type = mujoco.mjtGeom.mjGEOM_CYLINDER


def has_another_condim(spec: mujoco.MjSpec) -> None:
  spec.pairs[-1].condim = 6


def has_another_geom(spec: mujoco.MjSpec) -> None:
  spec.worldbody.add_geom(size=[0.1, 0, 0])


def has_other_options(spec: mujoco.MjSpec) -> None:
  spec.option.timestep = 0.0025


@pytest.mark.parametrize(
  ("edit", "field"),
  [
    (becomes_a_cylinder, "geom_type"),
    (has_another_condim, "pair_dim"),
    (has_another_geom, "ngeom"),
    (has_other_options, "opt.timestep"),
  ],
)
def test_variants_must_not_differ_in_what_all_worlds_share(edit, field):
  variants = [lambda spec: None, edit]
  with pytest.raises(ConfigError, match=f"stack_box.xml: variants differ in {field}, "):
    load_scene(mjcf_path("stack_box"), variants=variants)


BOX = """<body name="{name}" pos="0.4 0 0.1">{joint}<inertial pos="0 0 0" mass="0.1"
diaginertia="1e-4 1e-4 1e-4"/><geom name="{name}" type="box" size="0.02 0.02 0.02"
{masks}/></body>"""


def scene_of(*bodies: str, pairs: str = "") -> str:
  boxes, listed = "".join(bodies), [pair.split("-") for pair in pairs.split()]
  contacts = "".join(f'<pair geom1="{a}" geom2="{b}"/>' for a, b in listed)
  return (
    f"<mujoco>{INCLUDE}<worldbody>{boxes}</worldbody><contact>{contacts}</contact>"
    "</mujoco>"
  )


def box(name: str, joint: str = "<freejoint/>", masks: str = "") -> str:
  return BOX.format(name=name, joint=joint, masks=masks)


@pytest.mark.parametrize(
  ("text", "falls"),
  [
    (scene_of(box("a")), "a"),
    (scene_of(box("a"), pairs="r_pad-a l_pad-a"), "a"),
    (scene_of(box("a"), pairs="table-a"), None),
    (scene_of(box("a"), box("b"), pairs="b-a table-b"), None),
    (scene_of(box("a"), box("b"), pairs="b-a"), "a"),
    (scene_of(box("a"), box("shelf", ""), pairs="shelf-a"), None),
    (scene_of(box("a"), box("door", '<joint type="hinge"/>'), pairs="door-a"), None),
    (scene_of(box("a"), box("b"), pairs="table-a"), "b"),
    (scene_of(box("a", masks='contype="1"'), box("shelf", "")), "a"),
    (
      scene_of(
        box("a", masks='contype="1"'), box("shelf", "", masks='conaffinity="1"')
      ),
      None,
    ),
    (scene_of(box("a").replace("<body", '<body gravcomp="1"')), None),
  ],
)
def test_a_free_body_must_not_fall_out_of_the_world(tmp_path, text, falls):
  scene = load(tmp_path, text)
  if falls is None:
    scene_checks.check_support(scene.model, scene.name)
    return
  with pytest.raises(
    ConfigError, match=f"mine.xml: nothing holds up body '{falls}': li"
  ):
    scene_checks.check_support(scene.model, scene.name)


def test_what_mujoco_says_of_a_file_is_one_line_with_the_element(tmp_path, capsys):
  twice = '<worldbody><geom name="table" size="0.1"/></worldbody>'
  words = "mine.xml does not compile: .*repeated name 'table' in geom.* line [0-9]+"
  with pytest.raises(ConfigError, match=words) as error:
    load(tmp_path, f"<mujoco>{INCLUDE}{twice}</mujoco>")
  assert "\n" not in str(error.value)
  with pytest.raises(ConfigError, match="mine.xml does not compile: .* Line number=1"):
    load(tmp_path, "no XML")
  # A warning of several lines, with the path of this package.
  cloth = """<worldbody><body name="c"><flexcomp name="cloth" type="grid" mass="0.1"
    count="3 3 1" spacing="0.1 0.1 0.1" dim="2"/></body></worldbody>"""
  with pytest.raises(ConfigError, match="Flex not implemented"):
    load(tmp_path, f"<mujoco>{INCLUDE}{cloth}</mujoco>")
  (line,) = capsys.readouterr().err.splitlines()
  assert line.startswith("mine.xml: flex 'cloth' is not rigid")
