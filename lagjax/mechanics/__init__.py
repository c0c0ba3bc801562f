"""From a Lagrangian to equations of motion."""
