"""One motion in time."""

from lagjax.integrate import arguments
from lagjax.integrate.adjoint.both_modes import solve_in_both_modes
from lagjax.integrate.adjoint.replay import Replay
from lagjax.integrate.contacts.contacts import releases, slips, sticks, touches
from lagjax.integrate.elements.in_modes import Masked, WithElements
from lagjax.integrate.equal_steps.loop import is_suited
from lagjax.integrate.events.event import Crossing, Crossings, EventWarning, crossings_of, traced_guard
from lagjax.integrate.integrate import integrate
from lagjax.integrate.jumps.find import found
from lagjax.integrate.load import check_is_system, described_system, load_trajectory, same_system, trajectory_from
from lagjax.integrate.settings import PATIENCE
from lagjax.integrate.solve.assembly import InElements, modes_at
from lagjax.integrate.solve.backward_time import runs_backward
from lagjax.integrate.solve.error_estimate import ROUND_OFFS
from lagjax.integrate.solve.harvest import Report, in_turn, reported, reporting, watched
from lagjax.integrate.solve.over_jumps import JumpWarning
from lagjax.integrate.solve.phases import phases_in, traced_phases
from lagjax.integrate.solve.programs import nystrom_for
from lagjax.integrate.solve.segments import switches_before_any
from lagjax.integrate.trajectory.dense_output import in_one_solve
from lagjax.integrate.trajectory.drawing import curves
from lagjax.integrate.trajectory.error_report import angle_mask
from lagjax.integrate.trajectory.films import film_of_lanes
from lagjax.integrate.trajectory.hybrid_trajectory import HybridTrajectory, Switches
from lagjax.integrate.trajectory.results import ENDED_WELL, RESULTS, ended_well, in_words, is_among, message
from lagjax.integrate.trajectory.save import described, parts
from lagjax.integrate.trajectory.subject import draw, drawn, still, subject_of
from lagjax.integrate.trajectory.trajectory import AccuracyWarning, Snapshot, Trajectory
