"""Motions between two points: connected, shortest, steered. Imported on first use."""

from lagjax.two_points.connect import ConnectWarning, connect
from lagjax.two_points.geodesic import Geodesic, exponential_map, geodesic
from lagjax.two_points.optimal_control import steer
from lagjax.two_points.regulator import LQR, lqr
from lagjax.two_points.result import Connection
from lagjax.two_points.steering import Steering
from lagjax.two_points.tracking import TrackingLQR
from lagjax.two_points.transport import parallel_transport
