"""Models from files: URDF and MJCF in, as bodies, joints and shapes, with what is not taken said."""

from lagjax.models.readers import read_mjcf, read_urdf
from lagjax.models.robot_model import RobotModel

__all__ = ["RobotModel", "read_mjcf", "read_urdf"]
