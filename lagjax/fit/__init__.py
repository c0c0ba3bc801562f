"""Parameters from measured motion."""
