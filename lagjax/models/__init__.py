"""Models from files: URDF and MJCF in, as bodies, joints and shapes, with what is not taken said."""

from lagjax.models.mjcf import read_mjcf
from lagjax.models.robot_model import RobotModel
from lagjax.models.urdf import read_urdf

__all__ = ["RobotModel", "read_mjcf", "read_urdf"]
