"""One motion in time."""

from lagjax.integrate import arguments
from lagjax.integrate.both_modes import solve_in_both_modes
from lagjax.integrate.data import described, parts
from lagjax.integrate.dense_output import in_one_solve
from lagjax.integrate.elements import InElements, Masked, WithElements, check_linear, modes_at
from lagjax.integrate.equal_steps.loop import is_suited
from lagjax.integrate.events.event import Crossing, Crossings, EventWarning, crossings_of, traced_guard
from lagjax.integrate.integrate import integrate
from lagjax.integrate.jumps import found
from lagjax.integrate.load import check_is_system, described_system, load_trajectory, same_system, trajectory_from
from lagjax.integrate.pictures import curves, draw, drawn, film_of_lanes, still, subject_of
from lagjax.integrate.replay import Replay
from lagjax.integrate.results import ENDED_WELL, RESULTS, angle_mask, ended_well, in_words, is_among, message
from lagjax.integrate.solve.legs import JumpWarning
from lagjax.integrate.solve.phases import OfPhases, Plastic, phases_in, runs_backward, traced_phases
from lagjax.integrate.solve.programs import nystrom_for
from lagjax.integrate.solve.reports import ROUND_OFFS, Report, in_turn, reported, reporting, watched
from lagjax.integrate.solve.segments import switches_before_any
from lagjax.integrate.trajectory import AccuracyWarning, HybridTrajectory, Snapshot, Switches, Trajectory
