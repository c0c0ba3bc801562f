"""From equations of motion to trajectories."""
