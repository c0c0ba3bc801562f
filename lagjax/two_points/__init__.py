"""Motions between two points: connected, shortest, steered. Imported on first use."""
