"""Scenes: compiled MJCF files with the names that the project relies on.

Every scene includes ``mjcf/robot.xml`` and so has the same arm, gripper, tool site and
wrist camera. Look-ups fail early; their messages list the names that exist.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import dataclasses
import hashlib
import operator
import pathlib
import warnings

import mujoco
import numpy as np

from apnpql_jax.colors import geom_rgba
from apnpql_jax.config import files
from apnpql_jax.console import print_line
from apnpql_jax.errors import ConfigError, one_line
from apnpql_jax.sim import scene_checks
from apnpql_jax.sim.names import ARM_JOINTS, GRIPPER_JOINT, TOOL_SITE
from apnpql_jax.sim.quiet_mjx import mjx


@dataclasses.dataclass(frozen=True)
class Scene:
  """A compiled model and the addresses of the robot in it."""

  name: str  # stem of the MJCF file
  path: pathlib.Path  # of the MJCF file
  model: mujoco.MjModel
  fingerprint: str  # hash of the compiled models of all variants
  arm_qpos: np.ndarray  # int[6]: addresses of the arm joints in qpos
  arm_dof: np.ndarray  # int[6]: the same in qvel
  gripper_qpos: int  # address of the driven finger joint in qpos
  gripper_dof: int  # the same in qvel
  tool_site: int  # id of the site between the closed finger tips
  variants: dict[str, np.ndarray]  # differing model fields, f32[variants, ...]

  def id(self, kind: str, name: str) -> int:
    """Returns the id of a "body", "site", "camera", "geom" or "key" by name."""
    return _named_id(self.model, self.name, kind, name)

  def free_joint(self, body: str) -> tuple[int, int]:
    """Returns the (qpos, qvel) addresses of the free joint of ``body``."""
    joint = self.model.body_jntadr[self.id("body", body)]
    if joint not in free_joints(self.model):
      raise ConfigError(f"{self.name}.xml: body '{body}' has no free joint")
    return int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])

  def mocap(self, body: str) -> int:
    """Returns the index of the mocap body ``body`` in mocap_pos."""
    index = int(self.model.body_mocapid[self.id("body", body)])
    if index < 0:
      raise ConfigError(f"{self.name}.xml: body '{body}' is not a mocap body")
    return index

  def keyframe(self, name: str) -> np.ndarray:
    """Returns the qpos of a keyframe, f64[nq]."""
    return self.model.key_qpos[self.id("key", name)].copy()


def load_scene(
  path: pathlib.Path,
  *,
  cameras: Sequence[str] = (),
  variants: Sequence[Callable[[mujoco.MjSpec], None]] = (),
) -> Scene:
  """Compiles an MJCF file that includes the robot, and checks it.

  ``cameras`` must exist. Each world has one of the ``variants``: functions that edit
  the parsed file, such as the size of an object, but keep its structure.

  Raises:
    ConfigError: The file does not compile, lacks a joint, site or camera, uses a
      feature that MJX would silently ignore, or changes the robot; or its variants
      differ in what all worlds share.
  """
  models = [compile_file(path, edit) for edit in variants or [lambda _: None]]
  model = models[0]
  scene_checks.check_supported(model, path.stem)
  joints = [_named_id(model, path.stem, "joint", name) for name in ARM_JOINTS]
  finger = _named_id(model, path.stem, "joint", GRIPPER_JOINT)
  for camera in cameras:
    _named_id(model, path.stem, "camera", camera)
  scene_checks.check_variants(models, path.stem)
  for variant in models:
    scene_checks.check_robot(variant, path.stem)
    scene_checks.check_keyframes(variant, path.stem)
  return Scene(
    name=path.stem,
    path=path,
    model=model,
    fingerprint=_fingerprint(models),
    arm_qpos=model.jnt_qposadr[joints].copy(),
    arm_dof=model.jnt_dofadr[joints].copy(),
    gripper_qpos=int(model.jnt_qposadr[finger]),
    gripper_dof=int(model.jnt_dofadr[finger]),
    tool_site=_named_id(model, path.stem, "site", TOOL_SITE),
    variants=_differences(models),
  )


def free_joints(model: mujoco.MjModel) -> np.ndarray:
  """Returns the ids of the free joints, i64[n]."""
  return np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)


def fixed_bodies(model: mujoco.MjModel) -> np.ndarray:
  """Returns a mask bool[nbody] of the world and of the bodies without joints to it."""
  return model.body_weldid == 0


def _named_id(model: mujoco.MjModel, scene: str, kind: str, name: str) -> int:
  short = {"joint": "jnt", "camera": "cam"}.get(kind, kind)
  accessor = getattr(model, short)
  try:
    return int(accessor(name).id)
  except KeyError:
    names = [accessor(i).name for i in range(getattr(model, f"n{short}"))]
    valid = ", ".join(n for n in names if n) or "none"
    raise ConfigError(f"{scene}.xml has no {kind} '{name}' (valid: {valid})") from None


def compile_file(
  path: pathlib.Path, edit: Callable[[mujoco.MjSpec], None]
) -> mujoco.MjModel:
  """Compiles an MJCF file after ``edit`` has changed what was parsed.

  Raises:
    ConfigError: It does not compile.
  """
  try:
    # A file elsewhere may include the robot and its surroundings by name.
    shared = {
      name: text
      for name, text in files.mjcf_files().items()
      if not (path.parent / name).exists()
    }
    # MuJoCo warns of odd elements with Python's warnings, of several lines each.
    with warnings.catch_warnings(record=True, action="always") as odd:
      spec = mujoco.MjSpec.from_file(str(path), include=shared)
      edit(spec)
      sizes = {key.name: len(key.qpos) for key in spec.keys}
      model = spec.compile()
  except ValueError as error:
    raise ConfigError(f"{path} does not compile: {one_line(error)}") from error
  for warning in odd:
    print_line(f"{path.name}: {one_line(Warning(warning.message))}")
  for name, size in sizes.items():  # MuJoCo would complete it silently.
    if size != model.nq:
      raise ConfigError(
        f"{path.name}: keyframe '{name}' has {size} values of qpos, not {model.nq}: "
        "the arm, the four finger joints, then the other joints in order"
      )
  return model


def _differences(models: Sequence[mujoco.MjModel]) -> dict[str, np.ndarray]:
  """Returns the model fields that differ, as far as MJX has them, f32[models, ...].

  The other fields of C MuJoCo are for collision filters, which explicit pairs bypass.
  """
  differences = {}
  for field in dataclasses.fields(mjx.Model):
    value = getattr(models[0], field.name, None)
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
      continue
    shown = geom_rgba if field.name == "geom_rgba" else operator.attrgetter(field.name)
    values = np.stack([shown(model) for model in models])
    if (values != values[0]).any():
      differences[field.name] = values.astype(np.float32)
  return differences


def _fingerprint(models: Sequence[mujoco.MjModel]) -> str:
  digest = hashlib.sha256()
  for model in models:
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    digest.update(buffer.tobytes())
  return digest.hexdigest()
