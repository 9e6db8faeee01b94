"""Checks of compiled scenes: features of MJX, the robot, contacts that hold bodies up.

A scene may be anything that MuJoCo compiles, but the engines, the inverse kinematics
and the reset states rely on the robot of ``mjcf/robot.xml``.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import functools
import operator
from typing import Any

import mujoco
import numpy as np

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.errors import ConfigError
from apnpql_jax.sim.quiet_mjx import mjx

_FIXED = {
  "joint": (
    "jnt_type jnt_axis jnt_pos jnt_limited jnt_range jnt_stiffness jnt_actfrclimited "
    "jnt_actgravcomp dof_damping dof_armature dof_frictionloss"
  ),
  "actuator": (
    "actuator_trntype actuator_gaintype actuator_gainprm actuator_biastype "
    "actuator_biasprm actuator_gear actuator_ctrllimited actuator_ctrlrange "
    "actuator_forcelimited"
  ),
  "body": (
    "body_pos body_quat body_mass body_inertia body_ipos body_iquat body_gravcomp"
  ),
  "site": "site_pos site_quat",
}
"""Kind of the robot's elements -> fields of the model that scenes must not change."""

_RANGE_CURE = (
  'a <compiler> of the scene also applies to the robot and must keep angle="radian"'
)
_CURE = "remove the attribute, default or <compiler> setting that changes it"

_UNUSED = ("name", "signature", "stat", "_", "opt._")
"""Prefixes of fields that no world reads."""

_SHARED = ("opt.", "mesh_", "hfield_")
"""Prefixes of numbers that MJX makes constants of its program."""

_FLAGS = "actuation clampctrl constraint contact equality gravity limit spring damper"


def check_supported(model: mujoco.MjModel, name: str) -> None:
  """Checks for features that MJX rejects, or accepts without simulating them.

  Source: the MJX-JAX engine of mujoco-mjx 3.17.0 has no code for these. The integrator
  is the one that ``sim.mjx`` calls.

  Raises:
    ConfigError: The scene ``name`` uses such features; the message lists them.
  """
  option, implicit = model.opt, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
  pgs = mujoco.mjtSolver.mjSOL_PGS
  sleep = getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0)
  found = {
    "option/noslip_iterations": option.noslip_iterations > 0,
    "option/integrator (valid: implicitfast)": option.integrator != implicit,
    "option/solver PGS (valid: CG, Newton)": option.solver == pgs,
    "option/flag sleep": bool(option.enableflags & int(sleep)),
    "geom/surfacevel": bool(np.any(getattr(model, "geom_surfacevel", 0))),
    "actuators with activation (not part of PhysicsState)": model.na > 0,
    "geom/adhesion": bool(np.any(getattr(model, "geom_adhesion", 0))),
  }
  names = [feature for feature, used in found.items() if used]
  if names:
    raise ConfigError(f"{name}.xml uses unsupported features: {', '.join(names)}")
  try:
    mjx.put_model(model, impl="jax")
  except NotImplementedError as error:
    raise ConfigError(f"{name}.xml uses a feature MJX lacks: {error}") from error


def check_robot(model: mujoco.MjModel, name: str) -> None:
  """Checks that the robot and gravity are those of ``mjcf/robot.xml``.

  Raises:
    ConfigError: The scene ``name`` changes them, or has further actuators.
  """
  robot = _robot()
  found, known = ([m.actuator(i).name for i in range(m.nu)] for m in (model, robot))
  if extra := [f"'{x}'" for x in found if x not in known]:
    raise ConfigError(
      f"{name}.xml has actuators that are not the robot's: {', '.join(extra)}; remove "
      "them, because actions drive only the robot"
    )
  if found != known:
    raise ConfigError(
      f"{name}.xml has the actuators {', '.join(found)}; they must be "
      f"{', '.join(known)}, in this order"
    )
  for kind, fields in _FIXED.items():
    counts = {"joint": robot.njnt, "body": robot.nbody, "site": robot.nsite}
    for index in range(counts.get(kind, robot.nu)):
      _compare(model, name, kind, getattr(robot, kind)(index).name, fields.split())
  if not np.allclose(model.opt.gravity, robot.opt.gravity):
    raise ConfigError(
      f"{name}.xml: option gravity is {_show(model.opt.gravity)}, not "
      f"{_show(robot.opt.gravity)}; remove it"
    )
  for flag in _FLAGS.split():
    if model.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag.upper()}"):
      raise ConfigError(f"{name}.xml: option flag {flag} is disabled; remove it")


def check_variants(models: Sequence[mujoco.MjModel], name: str) -> None:
  """Checks that the variants of a scene differ only in what each world has for itself.

  Those are numbers, such as sizes, positions, masses and colors.

  Raises:
    ConfigError: Variants of the scene ``name`` differ in anything else that MJX reads.
  """
  fields = [f"opt.{field.name}" for field in dataclasses.fields(mjx.Option)]
  fields += [field.name for field in dataclasses.fields(mjx.Model)]
  for field in fields:
    if field.startswith(_UNUSED):
      continue
    values = [operator.attrgetter(field)(model) for model in models]
    own = isinstance(values[0], np.ndarray) and values[0].dtype.kind == "f"
    if own and not field.startswith(_SHARED):
      continue
    if not all(np.array_equal(values[0], value) for value in values):
      raise ConfigError(
        f"{name}.xml: variants differ in {field}, which all worlds share; let them "
        "differ in numbers only, such as sizes, positions, masses and colors"
      )


def check_keyframes(model: mujoco.MjModel, name: str) -> None:
  """Checks that hinges and slides are within their limits in every keyframe.

  Raises:
    ConfigError: A joint of the scene ``name`` is outside of them.
  """
  kinds = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
  limited = np.flatnonzero(model.jnt_limited & np.isin(model.jnt_type, kinds))
  for index in range(model.nkey):
    key, qpos = model.key(index).name, model.key_qpos[index]
    for joint in limited:
      address, where = model.jnt_qposadr[joint], f"joint '{model.joint(joint).name}'"
      low, high = model.jnt_range[joint]
      angle = qpos[address]
      if not low - 1e-6 <= angle <= high + 1e-6:
        raise ConfigError(
          f"{name}.xml: keyframe '{key}' has {where} at {angle:g}, outside of its "
          f"range {_show(model.jnt_range[joint])}; correct its qpos"
        )


def check_support(model: mujoco.MjModel, name: str) -> None:
  """Checks that contacts can hold up every free body.

  Raises:
    ConfigError: A body of the scene ``name`` would fall out of the world.
  """
  roots, robot = model.body_rootid, model.body_rootid[model.body("base").id]
  free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
  falling = {int(b) for b in model.jnt_bodyid[free] if not model.body_gravcomp[b]}
  # Each geom counts for the free body that it belongs to, all others for the world.
  owner = [int(roots[body]) for body in model.geom_bodyid]
  owner = [body if body in falling or body == robot else 0 for body in owner]
  masks = model.geom_contype[:, None] & model.geom_conaffinity
  listed = np.stack([model.pair_geom1, model.pair_geom2], axis=-1)
  pairs = np.concatenate([listed, np.argwhere(masks)]).tolist()
  links = [{owner[a], owner[b]} - {robot} for a, b in pairs]
  held = {0}
  while new := {body for link in links if link & held for body in link - held}:
    held |= new
  if falls := sorted(falling - held):
    raise ConfigError(
      f"{name}.xml: nothing holds up body '{model.body(falls[0]).name}': list a <pair> "
      "of one of its geoms and of the table, or of what it stands on, in <contact>"
    )


@functools.cache
def _robot() -> mujoco.MjModel:
  return mujoco.MjModel.from_xml_path(str(mjcf_path("robot")))


def _compare(
  model: mujoco.MjModel, scene: str, kind: str, name: str, fields: list[str]
) -> None:
  """Raises ``ConfigError`` if an element differs from the robot's of this name."""
  for field in fields:
    expected = _value(_robot(), kind, name, field)
    try:
      now = _value(model, kind, name, field)
    except KeyError:
      raise ConfigError(
        f"{scene}.xml lacks the robot's {kind} '{name}'; include robot.xml unchanged"
      ) from None
    if not np.allclose(now, expected, rtol=1e-6, atol=1e-9):
      cure = _RANGE_CURE if field == "jnt_range" else _CURE
      raise ConfigError(
        f"{scene}.xml: {kind} '{name}' has {field.partition('_')[2]} {_show(now)}, not "
        f"{_show(expected)} as in robot.xml; {cure}"
      )


def _value(model: mujoco.MjModel, kind: str, name: str, field: str) -> Any:
  """Returns a field of an element; raises ``KeyError`` if there is no such element."""
  index = getattr(model, kind)(name).id
  if field.startswith("dof_"):  # Of a joint with one degree of freedom.
    index = model.jnt_dofadr[index]
  return getattr(model, field)[index]


def _show(value: Any) -> str:
  numbers = np.trim_zeros(np.ravel(value).astype(float), "b")
  return ", ".join(f"{x:.6g}" for x in numbers) or "0"
