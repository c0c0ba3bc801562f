"""Figures, films, progress."""

from lagjax.display import plots
from lagjax.display.animation import Animation, film, film_scripts
from lagjax.display.in_space import (
    CUBE,
    CYLINDER,
    DISK,
    SPHERE,
    TUBE,
    Anchor,
    Drawing,
    InSpace,
    Shape,
    poses_in_q,
    stills_in_space,
    surface,
)
from lagjax.display.in_space.surfaces import Faces, fewer, triangles
from lagjax.display.plots import COLOURS, DrawnAxes
from lagjax.display.printable import by_line, is_plain, printable
from lagjax.display.progress import meter, waiting
from lagjax.display.still import Still
from lagjax.display.web_page.page import Page, encoded, fragment, in_bytes
