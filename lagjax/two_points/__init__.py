"""Motions between two points: connected, shortest, steered. Imported on first use."""

from lagjax.two_points.answer import Connection
from lagjax.two_points.connect import ConnectWarning, connect
from lagjax.two_points.geodesic import Geodesic, exponential_map, geodesic, parallel_transport
from lagjax.two_points.optimal_control import steer
from lagjax.two_points.regulators import LQR, TrackingLQR, lqr
from lagjax.two_points.steering import Steering
