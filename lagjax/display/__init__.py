"""Figures, films, progress."""

from lagjax.display import plots
from lagjax.display.animation import Animation, Still, film, film_scripts
from lagjax.display.page import Page, encoded, encoded_once, fragment, in_bytes
from lagjax.display.painting import stills_in_space
from lagjax.display.plots import COLOURS, DrawnAxes
from lagjax.display.scenery import (
    CUBE,
    CYLINDER,
    DISK,
    SPHERE,
    TUBE,
    Anchor,
    Drawing,
    Faces,
    InSpace,
    Shape,
    fewer,
    poses_in_q,
    surface,
    triangles,
)
from lagjax.display.terminal import by_line, columns, is_plain, labelled, meter, printable, table, waiting
