"""A scene: one compiled MJCF file with the names that the project relies on.

Every scene includes ``mjcf/robot.xml``, hence has the same arm, gripper, tool
site and wrist camera. Look-ups fail early and name what exists.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import dataclasses
import hashlib
import pathlib

import mujoco
from mujoco import mjx
import numpy as np

from apnpql_jax.errors import ConfigError

ARM_JOINTS = (
  "shoulder_pan",
  "shoulder_lift",
  "elbow",
  "wrist_1",
  "wrist_2",
  "wrist_3",
)
GRIPPER_JOINT = "finger_r1"
TOOL_SITE = "tool"


@dataclasses.dataclass(frozen=True)
class Scene:
  """A compiled model and the addresses of the robot in it.

  Attributes:
    name: stem of the MJCF file.
    model: the compiled model.
    fingerprint: hash of the compiled model, for caches keyed by the scene.
    arm_qpos: int[6], addresses of the arm joints in qpos.
    arm_dof: int[6], addresses of the arm joints in qvel.
    gripper_qpos: address of the driven finger joint in qpos.
    gripper_dof: address of the driven finger joint in qvel.
    tool_site: site id of the tool point between the closed finger tips.
    cameras: names of the cameras found.
    variants: model fields that differ between the variants of the scene, and their
      values f32[variants, ...]; empty if there is only one.
  """

  name: str
  model: mujoco.MjModel
  fingerprint: str
  arm_qpos: np.ndarray
  arm_dof: np.ndarray
  gripper_qpos: int
  gripper_dof: int
  tool_site: int
  cameras: tuple[str, ...]
  variants: dict[str, np.ndarray]

  def id(self, kind: str, name: str) -> int:
    """Id of a named object of ``kind`` ("body", "site", "camera", "geom", "key").

    Raises:
      ConfigError: the MJCF has no such name; the message lists those it has.
    """
    return _named_id(self.model, self.name, kind, name)

  def free_joint(self, body: str) -> tuple[int, int]:
    """(qpos, qvel) addresses of the free joint of ``body``."""
    joint = self.model.body_jntadr[self.id("body", body)]
    if joint not in free_joints(self.model):
      raise ConfigError(f"{self.name}.xml: body '{body}' has no free joint")
    return int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])

  def mocap(self, body: str) -> int:
    """Index of the mocap body ``body`` in mocap_pos."""
    index = int(self.model.body_mocapid[self.id("body", body)])
    if index < 0:
      raise ConfigError(f"{self.name}.xml: body '{body}' is not a mocap body")
    return index

  def keyframe(self, name: str) -> np.ndarray:
    """f64[nq], the qpos of a keyframe."""
    return self.model.key_qpos[self.id("key", name)].copy()


def load_scene(
  path: pathlib.Path,
  *,
  cameras: Sequence[str] = (),
  variants: Sequence[Callable[[mujoco.MjSpec], None]] = (),
) -> Scene:
  """Compiles ``path`` and checks it.

  Args:
    path: an MJCF file that includes the robot.
    cameras: camera names that must exist.
    variants: each makes another scene of the same structure by editing the parsed
      file, such as one more shape of an object. A world can then be any of them.

  Raises:
    ConfigError: the file does not compile, lacks a joint, site or camera, or
      uses a feature that MJX would silently ignore.
  """
  models = [_compile(path, edit) for edit in variants] or [_compile(path)]
  model = models[0]
  refuse_unsupported(model, path.stem)
  joints = [_named_id(model, path.stem, "joint", name) for name in ARM_JOINTS]
  finger = _named_id(model, path.stem, "joint", GRIPPER_JOINT)
  for camera in cameras:
    _named_id(model, path.stem, "camera", camera)
  return Scene(
    name=path.stem,
    model=model,
    fingerprint=_fingerprint(models),
    arm_qpos=model.jnt_qposadr[joints].copy(),
    arm_dof=model.jnt_dofadr[joints].copy(),
    gripper_qpos=int(model.jnt_qposadr[finger]),
    gripper_dof=int(model.jnt_dofadr[finger]),
    tool_site=_named_id(model, path.stem, "site", TOOL_SITE),
    cameras=tuple(model.camera(i).name for i in range(model.ncam)),
    variants=_differences(models),
  )


def refuse_unsupported(model: mujoco.MjModel, name: str) -> None:
  """Raises ConfigError where MJX refuses, or accepts but does not simulate.

  Source: the MJX-JAX engine of mujoco-mjx 3.17.0 has no code for these.
  """
  option = model.opt
  integrators = (
    mujoco.mjtIntegrator.mjINT_EULER,
    mujoco.mjtIntegrator.mjINT_RK4,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
  )
  sleep = getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0)
  found = {
    "option/noslip_iterations": option.noslip_iterations > 0,
    "option/integrator (valid: Euler, RK4, implicitfast)": (
      option.integrator not in [int(kind) for kind in integrators]
    ),
    "option/solver PGS (valid: CG, Newton)": (
      option.solver == mujoco.mjtSolver.mjSOL_PGS
    ),
    "option/flag sleep": bool(option.enableflags & int(sleep)),
    "geom/surfacevel": bool(np.any(getattr(model, "geom_surfacevel", 0))),
    "actuators with activation (not part of PhysicsState)": model.na > 0,
    "geom/adhesion": bool(np.any(getattr(model, "geom_adhesion", 0))),
  }
  names = [feature for feature, used in found.items() if used]
  if names:
    raise ConfigError(f"{name}.xml uses what is not simulated: {', '.join(names)}")
  try:
    mjx.put_model(model, impl="jax")
  except NotImplementedError as error:
    raise ConfigError(f"{name}.xml uses what MJX cannot simulate: {error}") from error


def _named_id(model: mujoco.MjModel, scene: str, kind: str, name: str) -> int:
  accessor = getattr(model, "cam" if kind == "camera" else kind)
  try:
    return int(accessor(name).id)
  except KeyError:
    count = getattr(
      model, {"body": "nbody", "joint": "njnt", "camera": "ncam"}.get(kind, f"n{kind}")
    )
    names = [accessor(i).name for i in range(count)]
    valid = ", ".join(n for n in names if n) or "none"
    raise ConfigError(f"{scene}.xml has no {kind} '{name}' (valid: {valid})") from None


def _compile(
  path: pathlib.Path, edit: Callable[[mujoco.MjSpec], None] | None = None
) -> mujoco.MjModel:
  try:
    spec = mujoco.MjSpec.from_file(str(path))
    if edit is not None:
      edit(spec)
    return spec.compile()
  except ValueError as error:
    reason = str(error).splitlines()[0]
    raise ConfigError(f"{path.name} does not compile: {reason}") from error


def _differences(models: Sequence[mujoco.MjModel]) -> dict[str, np.ndarray]:
  """The fields in which the models differ, of those that MJX has too.

  What C MuJoCo has beyond them serves collision filters that explicit pairs bypass.
  """
  differences = {}
  for field in dataclasses.fields(mjx.Model):
    value = getattr(models[0], field.name, None)
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
      continue
    values = np.stack([getattr(model, field.name) for model in models])
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


def free_joints(model: mujoco.MjModel) -> np.ndarray:
  """Returns the ids of the free joints, i64[n]."""
  return np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
