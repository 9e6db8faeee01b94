"""Names of the robot's parts in ``mjcf/robot.xml``."""

from __future__ import annotations

ARM_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
GRIPPER_JOINT = "finger_r1"  # the driven one
TOOL_SITE = "tool"  # between the closed finger tips
FLANGE_SITE = "attachment_site"  # the tool flange of the arm
BASE_SITE = "base_frame"  # the frame of the arm's controller
