"""Bodies, points and lines in space: as a film that can be turned, and as a figure."""

from lagjax.display.in_space.figure import stills_in_space
from lagjax.display.in_space.scenery import InSpace
from lagjax.display.in_space.shapes import Anchor, Drawing, Shape, poses_in_q
from lagjax.display.in_space.surfaces import CUBE, CYLINDER, DISK, SPHERE, TUBE, surface
