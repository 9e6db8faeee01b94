"""Episodes of the scripted expert as a dataset of LeRobot, with images."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.data import demonstrations, lerobot
from apnpql_jax.data.demonstrations import Demonstrations
from apnpql_jax.data.lerobot import conversion
from apnpql_jax.envs.cameras import make_cameras
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.sim.names import ARM_JOINTS, GRIPPER_JOINT
from apnpql_jax.tasks.task import Task

ROBOT = "ur5e_rh_p12_rn"
CAMERAS = ("global", "wrist")
_CHUNK = 32  # instants that are drawn at once


def write_dataset(
  folder: Path, demos: Demonstrations, task: Task, config: EnvConfig
) -> dict[str, Any]:
  """Writes demonstrations as a dataset with the images of both cameras.

  The images are those of the plain scene, without randomization.

  Returns:
    The folder and its counts.

  Raises:
    ConfigError: pyarrow is missing.
    FileError: The folder exists or cannot be written.
  """
  scene = task.scene
  robot = [*scene.arm_qpos, scene.gripper_qpos]
  states = conversion.states(
    demos.qpos, demos.qvel, demos.mocap_pos, demos.mocap_quat, demos.variant
  )
  solved = demonstrations.solved(demos, task, config)
  ends = np.append(demos.first[1:], True)
  episode = 0
  with lerobot.Writer(
    folder,
    fps=1 / config.control_period_s,
    vectors={
      lerobot.STATE: (*ARM_JOINTS, GRIPPER_JOINT),
      lerobot.ACTION: (*ARM_JOINTS, "gripper"),
      lerobot.ENVIRONMENT: conversion.state_names(scene),
    },
    images={
      f"{lerobot.IMAGES}{name}": getattr(config, f"{name}_size") for name in CAMERAS
    },
    robot_type=ROBOT,
    about={"task": task.name, "scene_sha256": scene.fingerprint},
  ) as writer:
    for i, images in enumerate(_images(demos, task, config)):
      frame: dict[str, np.ndarray] = {
        lerobot.STATE: demos.qpos[i, robot],
        lerobot.ACTION: demos.action[i],
        lerobot.ENVIRONMENT: states[i],
      }
      for name, image in zip(CAMERAS, images, strict=True):
        frame[f"{lerobot.IMAGES}{name}"] = image
      writer.add(frame)
      if ends[i]:
        writer.end_episode(task.name, bool(solved[episode]))
        episode += 1
  return {
    "folder": str(folder),
    "instants": demos.instants,
    "demonstrations": episode,
    "solved_demonstrations": int(solved.sum()),
  }


def _images(
  demos: Demonstrations, task: Task, config: EnvConfig
) -> Generator[tuple[np.ndarray, ...], None, None]:
  """Yields the images of both cameras at each instant, u8[H, W, 3]."""
  kinematics = make_kinematics(task.scene)
  cameras = make_cameras(config, task.scene)
  draw = jax.jit(lambda state: [camera(kinematics(state)) for camera in cameras])
  for begin in range(0, demos.instants, _CHUNK):
    # Chunks of one size, which compile once.
    rows = np.arange(begin, begin + _CHUNK) % demos.instants
    views = [np.asarray(x) for x in draw(demos.rows(rows).states(task.scene))]
    count = min(_CHUNK, demos.instants - begin)
    yield from zip(*(view[:count] for view in views), strict=True)
